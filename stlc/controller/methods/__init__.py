"""Training methods and planners, one per file, named as in `--method` and `train: {method: …}`.

A file holds an object `METHOD` with the attributes of `Method`; `stlc.registry.METHODS` finds it.
Schema, command line and tables read the names from there, without torch. Code shared by several methods lies
in files whose names begin with `_`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import torch

    from stlc.controller.parallel.ddp import Ranks
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.controller.training.config import ResolvedConfig, TrainConfig
    from stlc.controller.training.learner import Trainer
    from stlc.rundir import RunDir


class Method(Protocol):
    """A training method or planner."""

    def resolve(self, task: Task, config: TrainConfig) -> ResolvedConfig:
        """Resolve all options of a run from those of the user and the system file.

        `stlc.controller.training.config.base_config` gives those that do not depend on the method.
        """

    def learner(
        self, task: Task, config: ResolvedConfig, *, steps: int, device: torch.device, ranks: Ranks
    ) -> Trainer | None:
        """The initial state of a training; None for a planner, which has nothing to learn."""

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> Policy:
        """Load the policy of a run.

        Raises:
            RunError: R101, the run is damaged or has no checkpoint yet; R102, it is of another task.
        """
