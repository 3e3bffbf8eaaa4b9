"""Search and distil: plans of failing states are repaired by local search and imitated.

Every few dozen steps the policy's plans from newly drawn states are judged; failing plans are repaired by a
search that starts from them, and repaired plans are imitated for as long as the policy fails at their state
(docs/decisions/0007-training-engine.md).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from stlc.controller.training.config import base_config
from stlc.controller.training.learner import NetworkMethod
from stlc.controller.training.objective import guided_objective

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.controller.training.config import ResolvedConfig, TrainConfig
    from stlc.controller.training.learner import Trainer
    from stlc.controller.training.objective import Objective


class Guided(NetworkMethod):
    """Gradient descent on exact robustness, supported by local search.

    The network proposes several plans per state, of which the policy selects the best.
    """

    searches = True
    mirrored = True

    def resolve(self, task: Task, config: TrainConfig) -> ResolvedConfig:
        """Resolve the options.

        By default the network proposes four plans. Half of the states of a step are newly drawn, the other
        half are states at which the policy failed before and for which the search found a plan.
        """
        found = base_config(task, config, kind=self.options, batch=256, plans=4, searches=True)
        return replace(found, hard=found.batch)

    def objective(self, learner: Trainer) -> Objective:
        """Objective with exact min and max, and a saturating hinge at `learner.margin`.

        This margin is a robustness that the search for plans reaches on most states.
        """
        return guided_objective(
            learner.margin, slope=learner.config.slope, performance_weight=learner.config.performance
        )


METHOD = Guided()
