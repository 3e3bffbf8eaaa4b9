"""Training methods and planners: a file each, whose name is that of `--method` and `train: {method: …}`.

A file holds an object `METHOD` with the attributes of `Method`; `stlc.registry.METHODS` finds it by the name
of the file. Schema, command line and tables read the names from there, without torch. Code that several
methods share lies in files whose names begin with `_`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from stlc.native import never

if TYPE_CHECKING:
    from collections.abc import Mapping

    import torch
    from torch import Tensor

    from stlc.controller.parallel.ddp import Ranks
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.controller.training.config import ResolvedConfig, TrainConfig
    from stlc.controller.training.learner import Validation
    from stlc.diagnostics import StlcError
    from stlc.native import Stop
    from stlc.rundir import RunDir


class Method(Protocol):
    """A way to a policy."""

    def resolve(self, task: Task, config: TrainConfig) -> ResolvedConfig:
        """All numbers of a run, from what the user and the system file say.

        `stlc.controller.training.config.base_config` gives those that do not depend on the method.
        """

    def learner(
        self, task: Task, config: ResolvedConfig, *, steps: int, device: torch.device, ranks: Ranks
    ) -> Learner | None:
        """The state of a training before its first step; None for a planner, which has nothing to learn."""

    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> Policy:
        """The policy of a run.

        Raises:
            RunError: R101, the run is damaged or has no checkpoint yet; R102, it is of another task.
        """


class Learner(Protocol):
    """A training: the loop gives it time, asks for checkpoints, and judges the policy in the end.

    Attributes:
        task: what is trained for.
        config: numbers of the run.
        device: of torch.
        ranks: that train together.
        step: gradient steps made.
        steps: of the whole run, as planned now.
        next_validation: step of the next validation.
        margin: robustness beyond which nothing more is earned.
        loss: of the last step; NaN before the first.
    """

    task: Task
    config: ResolvedConfig
    device: torch.device
    ranks: Ranks
    step: int
    steps: int
    next_validation: int
    margin: float
    loss: float

    @property
    def policy(self) -> Policy:
        """The policy that is handed out, on the processor."""

    @property
    def rate(self) -> float:
        """Learning rate of the next step."""

    @property
    def searches(self) -> bool:
        """Whether plans are searched for beside the steps."""

    @property
    def searching(self) -> bool:
        """Whether such a search goes on at this moment."""

    @property
    def solved(self) -> bool:
        """Whether a satisfying plan was ever found by a search."""

    @property
    def exhausted(self) -> bool:
        """Whether the search has spent all the effort that it may."""

    def torch_reasons(self) -> Mapping[str, str]:
        """Part of the training -> why torch does its work, or "" where it runs as C."""

    def advance(self) -> float:
        """Make a step and return its loss; NaN, and no step, where that or its gradient is not finite."""

    def explore(self, stop: Stop = never) -> bool:
        """Search before a validation; False where `stop` came first, and then nothing has changed."""

    def validate(self) -> Validation:
        """Judge fresh states, and begin the next search beside the steps."""

    def wait(self, stop: Stop = never) -> bool:
        """Let the search beside the steps come to its end; False where `stop` came first."""

    def diagnose(self) -> tuple[StlcError, bool]:
        """Cause of a step that was not finite, and whether the weights before it are."""

    def tensors(self) -> dict[str, Tensor]:
        """Everything that a resumed run needs, with `facts`."""

    def facts(self) -> dict[str, float | int]:
        """The plain numbers that go with `tensors`."""

    def restore(self, tensors: dict[str, Tensor], facts: dict[str, float | int]) -> None:
        """Go on where `tensors` and `facts` were taken."""

    def close(self) -> None:
        """End the search beside the steps."""
