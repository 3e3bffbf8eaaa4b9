"""Stages of guards, one per file; each declares the guards it belongs to and its place in their order.

A guard runs its stages in order. Each proposes plans for the agents that it may still help, and the
highest-ranked plan (`stlc.controller.guard.candidates.rank`) is kept. A file holds a class `STAGE`; files
whose names begin with `_` hold none.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from stlc.controller.guard.candidates import TO_SPARE, Candidates, Deadline, Limits
from stlc.registry import PackageRegistry

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.runtime.prefixes import PrefixGrid

STAGES: PackageRegistry[type[GuardStage]] = PackageRegistry(
    "stage", "stlc.controller.guard.stages", "STAGE", default=""
)


@dataclass(frozen=True, slots=True)
class Setup:
    """Objects shared by the stages of one guard.

    Attributes:
        task: specification and system.
        policy: continues prefixes.
        grid: values of the controls, and lengths of prefixes.
        limits: of a decision.
        guard: name of the guard.
        generator: random numbers for the searches of all stages.
    """

    task: Task
    policy: Policy
    grid: PrefixGrid
    limits: Limits
    guard: str
    generator: torch.Generator

    @property
    def enough(self) -> float:
        """Target robustness at which the search for a plan ends."""
        return TO_SPARE * self.task.system.decl.objective.gamma


@dataclass(slots=True)
class Rejected:
    """Agents whose plans the monitor has rejected, and the best plans so far.

    Attributes:
        x: states, (agents, n) float64.
        plan: the policy's plans, (agents, T, m); finite.
        previous: remainders of the previous plans, (agents, T, m), or None.
        best: the best plans so far, (agents,).
        tried: plans judged by the previous stage, by groups of agents, where it keeps them.
    """

    x: Tensor
    plan: Tensor
    previous: Tensor | None
    best: Candidates
    tried: list[Tried] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Tried:
    """Judged plans of a group of agents: rows (k,) among the rejected ones, candidates (k, choices)."""

    rows: Tensor
    candidates: Candidates


class GuardStage(ABC):
    """A stage of a guard: one method to find a better plan.

    Attributes:
        turns: name of a guard -> place of the stage in its order.
    """

    turns: ClassVar[Mapping[str, int]]

    @abstractmethod
    def __init__(self, setup: Setup) -> None:
        """Prepare everything that is independent of the state."""

    @abstractmethod
    def wanted(self, best: Candidates) -> Tensor:
        """Agents that the stage may help, given their best plans so far: (agents,) booleans."""

    @abstractmethod
    def propose(self, rejected: Rejected, rows: Tensor, deadline: Deadline) -> Candidates:
        """Propose a plan for some of the rejected agents: rows (k,) -> candidates (k,).

        Judged plans may be left in `rejected.tried` for the next stage.
        """


def stages_of(guard: str) -> tuple[type[GuardStage], ...]:
    """The stages of a guard in order."""
    found = [stage for stage in map(STAGES.get, STAGES) if guard in stage.turns]
    return tuple(sorted(found, key=lambda stage: stage.turns[guard]))
