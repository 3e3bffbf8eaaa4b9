"""Stages of guards: methods to find a better plan, one method per file.

A guard names its stages (`stlc.controller.guard.kind.GuardKind`) and runs them in order. Each stage proposes
plans for the agents whose plan it may still improve. Of all plans of an agent, the highest-ranked one is kept
(`stlc.controller.guard.candidates.rank`). A file holds a class `STAGE`; files whose names begin with `_` hold
shared code.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from stlc.controller.guard.candidates import TARGET_SHARE, Candidates, Deadline, Limits
from stlc.registry import PackageRegistry

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.runtime.prefixes import PrefixGrid

STAGES: PackageRegistry[type[GuardStage]] = PackageRegistry(
    "stage",
    "stlc.controller.guard.stages",
    "STAGE",
    group="stlc.stages",
    accepts="stlc.controller.guard.stages:is_stage",
)


def is_stage(entry: object) -> bool:
    """True of a class of stages."""
    return isinstance(entry, type) and issubclass(entry, GuardStage)


@dataclass(frozen=True, slots=True)
class Setup:
    """Objects shared by the stages of one guard.

    Attributes:
        task: specification and system.
        policy: policy that completes plans: it plans from the state after a prefix (sampled first actions).
        grid: values of the controls in prefixes, and lengths of prefixes.
        limits: computational limits of a decision.
        stages: classes of the guard's stages in order.
        generator: source of the random numbers for the searches of all stages.
    """

    task: Task
    policy: Policy
    grid: PrefixGrid
    limits: Limits
    stages: tuple[type[GuardStage], ...]
    generator: torch.Generator

    @property
    def target(self) -> float:
        """Robustness at which the search for a plan ends.

        It is a small share of gamma, the robustness at which training aims.
        """
        return TARGET_SHARE * self.task.system.decl.objective.gamma


@dataclass(slots=True)
class Rejected:
    """Agents whose plans the guard has rejected, and the best plans found for them until now.

    Attributes:
        x: states, (agents, n) float64.
        plan: the policy's plans, (agents, T, m); finite.
        previous: remainders of the previous plans, (agents, T, m), or None.
        best: the best plans of the stages that have run, (agents,).
        tried: plans that the previous stage judged and stored for the next stage, in groups of agents; empty
            if no plans were stored.
    """

    x: Tensor
    plan: Tensor
    previous: Tensor | None
    best: Candidates
    tried: list[Tried] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Tried:
    """Judged plans of a group of agents.

    Attributes:
        rows: indices of these agents in `Rejected`, (k,).
        candidates: the plans with their verdicts, (k, choices).
    """

    rows: Tensor
    candidates: Candidates

    @property
    def rho(self) -> Tensor:
        """Robustness of the specification, (choices, k)."""
        return self.candidates.rho.t()

    @property
    def safe(self) -> Tensor:
        """Robustness of phi_safe (the requirements tagged `@safety`), (choices, k)."""
        return self.candidates.safe.t()

    @property
    def cost(self) -> Tensor:
        """Performance costs, (choices, k)."""
        return self.candidates.cost.t()


class GuardStage(ABC):
    """Stage of a guard: one method to find a better plan."""

    @abstractmethod
    def __init__(self, setup: Setup) -> None:
        """Prepare everything that does not depend on the agents' states."""

    @abstractmethod
    def wanted(self, best: Candidates) -> Tensor:
        """Mask of the agents for which the stage is to search, (agents,), given their best plans so far."""

    @abstractmethod
    def propose(self, rejected: Rejected, rows: Tensor, deadline: Deadline) -> Candidates:
        """Search for a plan for each rejected agent with an index in `rows`, (k,); return candidates (k,).

        The stage may store the plans that it judged in `rejected.tried` for the next stage.
        """
