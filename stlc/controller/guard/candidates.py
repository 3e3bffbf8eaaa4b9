"""Candidate plans with their verdicts, and the order in which guards prefer them.

A guard judges each plan of the policy at run time. If it rejects a plan, it chooses another candidate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from time import perf_counter
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.rows import Rows
from stlc.runtime.prefixes import PrefixGrid

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

SOURCES = ("policy", "backup", "safest", "polished")
TARGET_SHARE = 0.05
"""Target robustness of plan repair, as a share of gamma (the robustness at which training aims)."""
POLICY, BACKUP, SAFEST, REPAIRED = range(len(SOURCES))
"""Sources of a plan: the policy; a prefix continued by the policy; the longest safe prefix; plan repair."""


@dataclass(frozen=True, slots=True)
class Candidates(Rows):
    """Plans with their verdicts.

    The leading dimensions (…) are (agents,), or (agents, choices) if every agent has several plans to choose
    from.

    Attributes:
        plans: (…, T, m) float64, physical units.
        rho: robustness of the specification phi, (…).
        safe: robustness of phi_safe (the requirements tagged `@safety`), (…); +inf where no requirement is
            tagged `@safety`.
        cost: performance cost of the objective, (…); 0 where not computed.
        source: method that made the plan, an index into `SOURCES`, (…) int64; negative for plans not judged.
        prefix_length: T0, the length of the plan's prefix, (…) int64. The prefix consists of the first
            actions of a plan, which a guard chose from fixed control values; 0 without prefix.
    """

    plans: Tensor
    rho: Tensor
    safe: Tensor
    cost: Tensor
    source: Tensor
    prefix_length: Tensor

    @classmethod
    def judged(
        cls, task: Task, x: Tensor, plans: Tensor, source: int, prefix_length: int = 0, *, cost: bool = False
    ) -> Candidates:
        """Judge plans (agents, …, T, m) from states (agents, n) float64.

        `source` and `prefix_length` apply to all plans; see `Candidates`. `cost`: whether to compute
        performance costs.
        """
        shape, rows = plans.shape[:-2], plans.flatten(0, -3)
        starts = x.repeat_interleave(len(rows) // max(len(x), 1), 0)
        found = task.judge(starts, rows, states=cost)
        number = torch.zeros(shape, dtype=torch.int64, device=plans.device)
        return cls(
            plans,
            found.rho.view(shape),
            found.safe.view(shape),
            task.cost(found).view(shape) if cost else torch.zeros_like(found.rho).view(shape),
            number + source,
            number + prefix_length,
        )

    @classmethod
    def unjudged(cls, plans: Tensor) -> Candidates:
        """Wrap plans (agents, T, m) without judging them; they have source -1 and rank below judged plans."""
        worst = torch.full(plans.shape[:-2], -torch.inf, dtype=plans.dtype, device=plans.device)
        number = torch.zeros(worst.shape, dtype=torch.int64, device=plans.device)
        return cls(plans.clone(), worst, worst.clone(), torch.zeros_like(worst), number - 1, number)

    @property
    def satisfies(self) -> Tensor:
        """Mask of the plans that satisfy the specification phi, (…) booleans."""
        return TOLERANCE.satisfied(self.rho)

    @property
    def is_safe(self) -> Tensor:
        """Mask of the plans that satisfy phi_safe (the requirements tagged `@safety`), (…) booleans."""
        return TOLERANCE.satisfied(self.safe)

    @property
    def standing(self) -> Tensor:
        """Standing of the plans among those of a guard, (…); larger is better.

        A plan is safe if it satisfies phi_safe (the requirements tagged `@safety`). The order, from best to
        worst:

        1. plans that satisfy phi; among these, a higher robustness is better
        2. safe plans that begin with actions tried by the guard (a prefix) and that the policy continues:
           they lead back to states on which the policy was trained
        3. other safe plans
        4. unsafe plans that a guard chose because they stay safe for the longest time
        5. other unsafe plans, by the smaller of the robustness of phi and that of phi_safe
        6. plans that were not judged
        """
        good, safe = self.satisfies, self.is_safe
        within = torch.where(good | safe, self.rho, torch.minimum(self.rho, self.safe)).nan_to_num(
            -1e9, 1e9, -1e9
        )
        finished = self.source == BACKUP
        tier = torch.where(good, 8.0, torch.where(safe, torch.where(finished, 4.0, 2.0), -2.0))
        tier = torch.where(~good & ~safe & (self.source == SAFEST), 0.0, tier)
        tier = torch.where(self.source < 0, -4.0, tier)
        return tier + within / (1.0 + within.abs())

    def pick(self, choice: Tensor) -> Candidates:
        """Select one of the several plans of each agent: (agents, choices) -> (agents,).

        `choice`: for each agent the index of its plan, (agents,).
        """
        rows = torch.arange(len(choice), device=choice.device)
        return self.each(lambda part: part[rows, choice])

    def improve(self, rows: Tensor, other: Candidates) -> None:
        """Replace the plans of the agents `rows`, (k,), by those of `other`, (k,), if the latter rank higher.

        Each agent is decided separately.
        """
        better = (other.standing > self.of(rows).standing).nonzero()[:, 0]
        self.put(rows[better], other.of(better))

    @classmethod
    def concatenated(cls, parts: Sequence[Candidates], dim: int = 0) -> Candidates:
        """Join sets of plans along the dimension of the agents, 0, or that of the choices, 1."""
        return cls(*(torch.cat(pieces, dim) for pieces in zip(*(part.parts for part in parts), strict=True)))


def first(chosen: Tensor) -> Tensor:
    """Index of the first chosen plan of each agent: masks (choices, agents) -> (agents,)."""
    return chosen.to(torch.uint8).argmax(0)


def finite(plan: Tensor, task: Task) -> Tensor:
    """Return plans (B, T, m) in which each non-finite entry is replaced by the admissible value nearest 0."""
    low, high = task.system.control_low.to(plan), task.system.control_high.to(plan)
    return torch.where(torch.isfinite(plan), plan, torch.zeros_like(plan).clamp(low, high))


def completed(
    x: Tensor,
    heads: Tensor,
    task: Task,
    rollout: Callable[[Tensor, Tensor], Tensor],
    continuation: Callable[[Tensor], Tensor],
) -> Tensor:
    """Return plans that begin with prefixes, and that the policy continues from where a prefix leads.

    Args:
        x: states, (B, n).
        heads: prefixes of each state, (B, C, T0, m).
        task: specification and system.
        rollout: (states, controls) -> trajectories, (rows, T0 + 1, n).
        continuation: states (rows, n) -> plans of the policy, (rows, T, m).

    Returns:
        Plans, (B, C, T, m), in the dtype of `x`; all of their later controls are finite.
    """
    count, length = heads.shape[1:3]
    starts = x[:, None].expand(-1, count, -1).reshape(-1, x.shape[1])
    head = heads.reshape(-1, *heads.shape[2:])
    tail = finite(continuation(rollout(starts, head)[:, -1]).to(x.dtype), task)
    plans = torch.cat((head, tail[:, : task.horizon - length]), 1)
    return plans.reshape(-1, count, *plans.shape[1:])


# ------------------------------------------------------------------------------------ limits of a search


class Deadline:
    """Deadline for a decision that is made for `agents` agents together.

    It lies `agents` times `seconds` in the future; without `seconds` there is no deadline.
    """

    def __init__(self, seconds: float | None = None, agents: int = 1) -> None:
        self.until = inf if seconds is None else perf_counter() + seconds * agents

    @property
    def over(self) -> bool:
        """True once the time limit is exceeded."""
        return perf_counter() >= self.until


@dataclass(frozen=True, slots=True)
class Limits:
    """Computational limits of a decision.

    A guard searches by stages. A prefix is a sequence of first actions that a stage tries; the policy plans
    the rest.

    Attributes:
        seconds: time limit of timed guards per agent, after which the best plan found is taken. None: no
            limit.
        tries: number of plans that the stage "local search" judges per starting plan.
        prefixes: maximum number of prefixes of one length in the stage "prefix shooting" where other stages
            run before it; lengths with more prefixes are skipped.
        drawn: maximum number of prefixes of one length in the stage "sampled shooting"; if there are more, a
            random sample is used.
        guesses: number of plans of the stage "sampled shooting", the best ones, from which local searches
            start.
        again: number of plans that each of these local searches judges.
        rescue: whether the stage "restarts" also searches for a safe plan without the policy. It does so only
            if no earlier stage found a safe plan; the search ignores all requirements that are not tagged
            `@safety`.
        margin: name of a safety requirement -> robustness margin in the unit of the requirement. Guards
            accept a plan only if it satisfies the requirement by this margin.
        paper: time limit of the other guards, in seconds per agent; None: no limit.
    """

    seconds: float | None = 0.1
    tries: int = 2000
    prefixes: int = 1000
    drawn: int = 256
    guesses: int = 8
    again: int = 2000
    rescue: bool = True
    margin: Mapping[str, float] = field(default_factory=dict)
    paper: float | None = None


def grid_of(task: Task) -> PrefixGrid:
    """Prefixes that the backup policy tries, as the system file declares them.

    A prefix is a sequence of actions with which a plan begins; the policy plans the rest. The prefixes are
    given by their lengths, and by the values that each control takes in them. If the system file does not
    list the values (`levels`), they are evenly spaced over the range of the control.
    """
    decl = task.system.decl
    values = tuple(
        decl.backup.levels.get(control.name)
        or control.levels
        or tuple(torch.linspace(control.low, control.high, decl.backup.bins).tolist())
        for control in decl.controls
    )
    lengths = tuple(length for length in decl.backup.lengths if 0 < length < task.horizon)
    return PrefixGrid(values, lengths, decl.backup.batch, decl.backup.samples, decl.backup.sampling)
