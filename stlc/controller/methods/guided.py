"""Search and distil: plans of failing states are repaired by local search and imitated.

Every few dozen steps the policy's plans from newly drawn states are judged; failing plans are repaired by a
search that starts from them, and repaired plans are imitated for as long as the policy fails at their state
(decision 7).
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
    """Gradient descent on exact robustness, supported by local search; the best of several plans is used."""

    searches = True
    mirrored = True

    def resolve(self, task: Task, config: TrainConfig) -> ResolvedConfig:
        """Resolve the options.

        By default the policy proposes four plans, and a step uses as many states at which it failed before as
        new states.
        """
        found = base_config(task, config, batch=256, plans=4, searches=True)
        return replace(found, hard=found.batch)

    def objective(self, learner: Trainer) -> Objective:
        """Objective with exact min and max and a saturating hinge, at a margin that search can reach."""
        return guided_objective(
            learner.margin, slope=learner.config.slope, performance_weight=learner.config.performance
        )


METHOD = Guided()
