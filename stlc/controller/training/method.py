"""Interfaces of training: a method, the learner that it makes, and the validation of a learner."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.parallel.ddp import ALONE, Ranks
from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.training.config import TrainConfig, base_config
from stlc.diagnostics import RunError, StlcError
from stlc.native import Stop, never

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from stlc.controller.policies.policy import Policy
    from stlc.controller.training.failures import FailureStates
    from stlc.rundir import RunDir


class Method(ABC):
    """Interface of a training method, or of planning without training.

    A method determines ("resolves") the options of a run from the command line, the system file and defaults.
    It makes the learner (the state of a training run), and loads the policy of a run.

    Attributes:
        options: class of the resolved options. A method with options of its own declares a subclass of
            `ResolvedConfig`, whose added fields are int, float or str and have defaults.
        learns: class of the learner; None if the method plans without training, or if the subclass defines
            the function `learner` itself.
        falsifies: whether the method can train on states of failing closed-loop drives (`--falsify`).
        whole: whether plans of its policies reach to the end of a mission that has deadlines.
        version: number that rises with every change of the policies that the method trains; measurements of
            older versions are repeated.
    """

    falsifies: ClassVar[bool] = False
    whole: ClassVar[bool] = False
    version: ClassVar[int] = 0
    options: ClassVar[type[ResolvedConfig]] = ResolvedConfig
    learns: ClassVar[type[Learner] | None] = None

    @property
    def trains(self) -> bool:
        """True if there is something to train; False if the method plans without training."""
        return self.learns is not None or type(self).learner is not Method.learner

    def resolve(self, task: Task, config: TrainConfig) -> ResolvedConfig:
        """Determine the options of a run, and return them.

        A value that the user gave is taken first, then the value in the system file, then the default of the
        method.
        """
        return base_config(task, config, kind=self.options)

    def learner(
        self, task: Task, config: ResolvedConfig, *, steps: int, device: torch.device, ranks: Ranks
    ) -> Learner | None:
        """Make the learner, in its state before the first step; None if the method plans without training.

        Raises:
            UsageError: U101, the method cannot train for the task or with these options, device or ranks.
        """
        if self.learns is None:
            return None
        return self.learns(task, config, steps=steps, device=device, ranks=ranks)

    @abstractmethod
    def load(self, task: Task, run: RunDir, config: ResolvedConfig, device: str) -> Policy:
        """Load the policy of a run.

        Raises:
            RunError: R101, the run is damaged or has no checkpoint yet; R102, its checkpoint belongs to
                another task.
        """


@dataclass(frozen=True, slots=True)
class Validation:
    """Result of a validation: verdicts on the policy's plans from newly drawn states.

    At every validation, some methods start a search for satisfying plans from the states where the policy's
    plans fail. The search ends before the next validation, which reports what the search found.

    Attributes:
        accuracy: share of states whose plan satisfies the specification.
        requirements: for each requirement, in the order of `task.rules`, the share of states whose plan
            satisfies it.
        feasible: estimated share of states for which a satisfying plan is known, from the policy or from the
            last search; None if no search has ended.
        failing: number of states from which the last search started; 0 without a search.
        repaired: number of states for which the last search found a satisfying plan.
        explored: number of plans that the planner `search` has found since the previous validation.
            If the remainder of a plan found satisfies the specification from a later state, it is counted
            too.
    """

    accuracy: float
    requirements: tuple[float, ...]
    feasible: float | None = None
    failing: int = 0
    repaired: int = 0
    explored: int = 0

    @classmethod
    def of(cls, judged: PlanVerdicts) -> Validation:
        """Make the result of a validation without search, from the verdicts `judged` on the plans."""
        shares = TOLERANCE.satisfied(judged.requirements).double().mean(0)
        return cls(float(judged.satisfied.double().mean()), tuple(float(share) for share in shares))

    def mean(self, ranks: Ranks) -> Validation:
        """Combine the results of all ranks: shares are averaged, counts are summed.

        All ranks (processes that train together) must call this at the same time.
        """
        counts = (self.failing, self.repaired, self.explored)
        own = (self.feasible or 0.0, *counts, self.accuracy, *self.requirements)
        feasible, failing, repaired, explored, accuracy, *shares = ranks.mean(own)
        return Validation(
            accuracy,
            tuple(shares),
            None if self.feasible is None else feasible,
            round(failing * ranks.size),
            round(repaired * ranks.size),
            round(explored * ranks.size),
        )


class Learner(ABC):
    """State of a training run; the training loop advances, validates and saves it step by step.

    A subclass supplies the steps, the policy and the contents of a checkpoint. Some subclasses also search
    for better plans, concurrently with the steps and before validations (see `explore`). This class does
    not.

    Attributes:
        task: the specification and system for which a policy is trained.
        config: options of the run.
        steps: planned total number of steps, which the training loop adapts to a time budget.
        device: torch device.
        ranks: processes that train together.
        step: number of completed steps.
        next_validation: step of the next validation.
        generator: source of all random numbers of this rank (process).
        margin: robustness that training aims at (gamma of the objective).
        loss: loss of the last step; NaN before the first.
        searches: whether the learner searches for better plans, concurrently with the steps.
        searching: whether such a search is running now.
        solved: whether any search has found a satisfying plan.
        exhausted: whether the longest search before a validation has found no plan.
        settles_rarely: whether `settle` has nothing to do after most steps.
        failures: states of failing closed-loop drives, which are mixed into the training; None without
            `--falsify`.
    """

    failures: FailureStates | None = None

    settles_rarely: bool = True
    searches: bool = False
    searching: bool = False
    solved: bool = False
    exhausted: bool = False

    def __init__(
        self, task: Task, config: ResolvedConfig, *, steps: int, device: torch.device, ranks: Ranks = ALONE
    ) -> None:
        self.task, self.config, self.steps, self.device, self.ranks = task, config, steps, device, ranks
        self.step = 0
        self.next_validation = config.every
        self.generator = torch.Generator().manual_seed(ranks.seed(config.seed))
        self.margin = task.system.decl.objective.gamma
        self.loss = math.nan

    @abstractmethod
    def advance(self) -> float:
        """Make one training step and return its loss.

        If the loss or its gradient is not finite, NaN is returned, and `step` does not count the step.
        """

    def settle(self) -> bool:
        """Do the work that is due after some steps only; the default does nothing.

        If `settles_rarely`, its duration is no part of the pace from which the number of steps is planned.

        Returns:
            False if a number was not finite, which ends the training, else True.
        """
        return True

    @property
    @abstractmethod
    def policy(self) -> Policy:
        """Policy with the weights after the latest step, on the CPU."""

    @property
    def rate(self) -> float:
        """Learning rate of the next gradient step."""
        return self.config.lr

    def validate(self) -> Validation:
        """Judge the policy's plans from newly drawn states; set `next_validation`."""
        x0 = self.task.sample(self.config.pool, generator=self.generator)
        self.next_validation = self.step + self.config.every
        return Validation.of(self.policy.plan_judged(x0)[1]).mean(self.ranks)

    def tensors(self) -> dict[str, Tensor]:
        """Tensors from which training resumes exactly, bit for bit.

        All ranks (processes that train together) must call this at the same time. Only the result on the
        first rank is complete: it contains the tensors of all ranks, and is stored in a checkpoint.
        """
        return {"generator": self.generator.get_state()}

    def facts(self) -> dict[str, float | int]:
        """Numbers that a checkpoint stores in addition to `tensors`, by name."""
        last = {"loss": self.loss} if math.isfinite(self.loss) else {}
        facts = {"step": self.step, "steps": self.steps, "margin": self.margin}
        return last | facts | {"next_look": self.next_validation}

    def restore(self, tensors: dict[str, Tensor], facts: dict[str, float | int]) -> None:
        """Restore the state from `tensors` and `facts`, which the methods of these names returned."""
        self.step, self.steps = int(facts["step"]), int(facts["steps"])
        self.margin, self.next_validation = float(facts["margin"]), int(facts["next_look"])
        self.loss = float(facts.get("loss", math.nan))
        self.generator.set_state(tensors["generator"].cpu())

    def diagnose(self) -> tuple[StlcError, bool]:
        """Find the cause of a step whose loss or gradient was not finite on at least one rank (process).

        Returns:
            The error that describes the cause; and whether the present weights are those before the step and
            give finite plans, so that they may be saved. By default they may not: a step of several updates
            has made some of them by the time its loss is known.
        """
        message = f"training diverged: the loss or its gradient is not finite at step {self.step}"
        return RunError.of("R401", message, help=("try a smaller --lr",)), False

    def torch_reasons(self) -> Mapping[str, str]:
        """For each part of the training, the reason why this part runs in torch; "" if it runs in C.

        The keys of the mapping are `verdicts` (on plans), `search` (for better plans), and `gradient` (of the
        robustness).
        """
        return self.task.torch_reasons(self.device.type, searches=False, smooth=True)

    def explore(self, stop: Stop = never) -> bool:  # noqa: ARG002
        """Search for plans by the planner `search`, if the last search found too few.

        By default nothing is done.

        Returns:
            False if `stop` ended the search early, else True.
        """
        return True

    def wait(self, stop: Stop = never) -> bool:  # noqa: ARG002
        """Wait for the end of the concurrent search; return False if `stop` ended the wait, else True."""
        return True

    def close(self) -> None:  # noqa: B027
        """End the work that runs concurrently with the training steps."""
