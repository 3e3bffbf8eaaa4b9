"""Search and distil: failing states are repaired by local search, and the repaired plans are imitated.

Every few dozen steps fresh states are judged; the failing ones are repaired by a search that starts at the
policy's own plan, and repaired plans are imitated for as long as their state still fails (decision 7).
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
    """Gradient steps on exact robustness, with local search beside them; several plans, the best is taken."""

    searches = True
    mirrored = True

    def resolve(self, task: Task, config: TrainConfig) -> ResolvedConfig:
        """Four plans, and as many hard states a step as fresh ones."""
        found = base_config(task, config, batch=256, plans=4, searches=True)
        return replace(found, hard=found.batch)

    def objective(self, learner: Trainer) -> Objective:
        """Exact operators and a saturating hinge at a margin that plans can reach."""
        return guided_objective(
            learner.margin, slope=learner.config.slope, performance_weight=learner.config.performance
        )


METHOD = Guided()
