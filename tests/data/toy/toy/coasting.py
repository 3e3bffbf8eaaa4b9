"""Method `coasting`: the least force at every step; nothing is learnt."""

from stlc.controller.policies.policy import ModelRollout
from stlc.controller.training.method import Method


class Coasting(Method):
    """A method without a learner."""

    def load(self, task, run, config, device):
        """Return the policy."""
        low = task.system.control_low
        return ModelRollout(lambda x: low.to(x).expand(len(x), -1), task)


METHOD = Coasting()
