"""Search and distil: a local search repairs the policy's bad plans, and the policy imitates the results.

Every few dozen steps the policy's plans from newly drawn states are judged. A search starts from the plans
that violate the specification and tries to repair them. The policy imitates a repaired plan for as long as
its own plan from the same state violates the specification (docs/decisions/0007-training-engine.md).
"""

from __future__ import annotations

from dataclasses import replace

from stlc.controller.problem.task import Task
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.training.config import TrainConfig, base_config
from stlc.controller.training.learner import NetworkMethod, Trainer
from stlc.controller.training.objective import Objective, guided_objective

LEARNING_RATE = 3e-3
"""Default peak learning rate."""


class Guided(NetworkMethod):
    """Gradient descent on exact robustness, supported by local search.

    The network proposes several plans per state, of which the policy selects the best.
    """

    searches = True
    whole = True
    mirrored = True

    def resolve(self, task: Task, config: TrainConfig) -> ResolvedConfig:
        """Determine the options.

        By default the network proposes four plans per state. Half of the states of a training step are newly
        drawn. The other half are states from which the policy failed before, but the search found a plan.
        """
        found = base_config(
            task, config, kind=self.options, batch=256, plans=4, rate=LEARNING_RATE, searches=True
        )
        return replace(found, hard=found.batch, varied=True)

    def objective(self, learner: Trainer) -> Objective:
        """Objective on exact robustness; robustness above `learner.margin` does not reduce the loss.

        The search for plans can reach this margin from most states. Far below the margin the loss grows only
        slowly, so that states without a satisfying plan do not dominate.
        """
        return guided_objective(
            learner.margin, slope=learner.config.slope, performance_weight=learner.config.performance
        )


METHOD = Guided()
