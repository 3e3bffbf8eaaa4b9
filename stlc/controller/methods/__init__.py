"""Training methods and planners: a file each, whose name is that of `--method` and `train: {method: …}`.

A file holds an object `METHOD` with the attributes of `Method`; `stlc.registry.METHODS` finds it by the name
of the file. Schema, command line and tables read the names from there, without torch. Code that several
methods share lies in files whose names begin with `_`.
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
    """A way to a policy."""

    def resolve(self, task: Task, config: TrainConfig) -> ResolvedConfig:
        """All numbers of a run, from what the user and the system file say.

        `stlc.controller.training.config.base_config` gives those that do not depend on the method.
        """

    def learner(
        self, task: Task, config: ResolvedConfig, *, steps: int, device: torch.device, ranks: Ranks
    ) -> Trainer | None:
        """The state of a training before its first step; None for a planner, which has nothing to learn."""

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> Policy:
        """The policy of a run.

        Raises:
            RunError: R101, the run is damaged or has no checkpoint yet; R102, it is of another task.
        """
