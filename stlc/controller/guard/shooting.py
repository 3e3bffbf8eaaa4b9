"""The paper's backup policy: sampled prefixes, finished by the policy (section "MPC-based Deployment").

For T0 = 1, 2, … every sequence of T0 actions on a grid of L values a control, M = L^(m T0), or a sample of
them where they are too many, is followed from the state at hand, and the policy plans on from where it ends.
The first T0 with a plan that satisfies phi, or else phi_safe, decides; where none has, the plan with the
longest safe prefix at the last T0. One thing goes beyond the paper (decision 37): what is left of the plan
followed before is one more choice, so that a safe plan is not lost because its first action was taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from time import perf_counter
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.guard.safe_prefix import prefix_robustness
from stlc.runtime.prefixes import Grid

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task


def grid_of(task: Task) -> Grid:
    """What the system declares: the `levels` of its backup, or of a control, else evenly over its range."""
    decl = task.system.decl
    values = tuple(
        decl.backup.levels.get(control.name)
        or control.levels
        or tuple(torch.linspace(control.low, control.high, decl.backup.bins).tolist())
        for control in decl.controls
    )
    lengths = tuple(length for length in decl.backup.lengths if 0 < length < task.horizon)
    return Grid(values, lengths, decl.backup.batch, decl.backup.samples, decl.backup.sampling)


@dataclass(frozen=True, slots=True)
class Found:
    """The plans that the backup chose.

    Attributes:
        plan: (agents, horizon, controls) float64.
        source: (agents,) int64, 1 where phi or phi_safe holds, 2 where the longest safe prefix decided.
        t0: (agents,) int64, length of the prefix.
        rho: (agents,) float64, robustness of phi.
        safe: (agents,) bool, whether phi_safe holds.
    """

    plan: Tensor
    source: Tensor
    t0: Tensor
    rho: Tensor
    safe: Tensor

    def of(self, rows: Tensor) -> Found:
        """Those of some agents, (k,) indices."""
        return Found(*(getattr(self, name)[rows] for name in Found.__slots__))

    def put(self, rows: Tensor, other: Found) -> None:
        """Take over what `other` has for some agents, (k,) indices."""
        for name in Found.__slots__:
            getattr(self, name)[rows] = getattr(other, name)


@dataclass(frozen=True, slots=True)
class Candidates:
    """Plans of several agents: (agents, choices, …); choice 0 begins as the policy's own plan does."""

    plans: Tensor
    rho: Tensor
    safe: Tensor
    cost: Tensor

    def with_one_more(self, plans: tuple[Tensor, Tensor, Tensor, Tensor]) -> Candidates:
        """These, and behind them one more choice an agent: plan, robustness, whether it is safe, cost."""
        mine = (self.plans, self.rho, self.safe, self.cost)
        pairs = zip(mine, plans, strict=True)
        return Candidates(*(torch.cat((old, new[:, None]), 1) for old, new in pairs))


class Clock:
    """When the time of a decision for some agents is over; never without a limit."""

    def __init__(self, seconds: float | None, agents: int) -> None:
        self._until = inf if seconds is None else perf_counter() + seconds * agents

    @property
    def over(self) -> bool:
        """Whether it is."""
        return perf_counter() >= self._until


class Backup:
    """The backup policy of a task.

    Args:
        task: specification and system.
        policy: who finishes the prefixes.
        grid: what is tried; by default what the system file says.
        seconds: that a decision may take per agent; then the best that was found counts. None: no limit.
    """

    def __init__(
        self, task: Task, policy: Policy, *, grid: Grid | None = None, seconds: float | None = None
    ) -> None:
        self.task, self.policy, self.seconds = task, policy, seconds
        self.grid = grid or grid_of(task)
        self._formulas = [rule.formula for rule in task.compiled.safety]

    @torch.no_grad()
    def search(self, x: Tensor, plan: Tensor, rest: Tensor | None = None) -> Found:
        """Better plans for states whose own plan was found wanting.

        Among plans of the same rank robustness decides, then the performance terms of the objective, because
        robustness is flat where a deadline cannot be met, and then closeness to the policy.

        Args:
            x: (agents, n) float64.
            plan: (agents, T, m), what the policy would do; entries that are not finite are replaced.
            rest: (agents, T, m), what is left of the plans that were followed until now.

        Returns:
            One plan an agent; `found.source` says by which rank.
        """
        clock = Clock(self.seconds, len(x))
        plan = finite(plan.to(x.dtype), self.task)
        rest = None if rest is None else finite(rest.to(x.dtype), self.task)
        found = nothing(plan)
        todo = torch.arange(len(x), device=x.device)
        for length in self.grid.lengths:
            prefixes = torch.from_numpy(self.grid.prefixes(length)).to(x)
            left = []
            for group in _pieces(todo, max(self.grid.batch // (len(prefixes) + 1), 1)):
                tried = prefixes[:0] if clock.over else prefixes
                candidates = self.candidates(x[group], plan[group], tried, clock)
                if rest is not None:
                    candidates = candidates.with_one_more(self._judged(x[group], rest[group]))
                done = self._enter(found, candidates, group, length)
                last = clock.over or length == self.grid.lengths[-1]
                if last and not bool(done.all()):
                    self._enter_safest(found, _at(candidates, ~done), (x[group[~done]], group[~done]), length)
                left.append(group[~done])
            todo = torch.cat(left) if left else todo
            if clock.over:
                break
        return found

    def candidates(self, x: Tensor, own: Tensor, prefixes: Tensor, clock: Clock | None = None) -> Candidates:
        """All plans of one T0 for some agents, judged; at most `grid.batch` trajectories at a time.

        For one agent alone those that there was time for, and at least as many as are judged at a time.
        """
        agents, (count, length, _) = len(x), prefixes.shape
        heads = torch.cat((own[:, None, :length], prefixes.expand(agents, -1, -1, -1)), 1).flatten(0, 1)
        starts = x.repeat_interleave(count + 1, 0)
        parts = []
        for start, head in zip(self._parts(starts), self._parts(heads), strict=True):
            parts.append(self._finish(start, head))
            if agents == 1 and clock is not None and clock.over:
                break
        columns = [torch.cat(column) for column in zip(*parts, strict=True)]
        return Candidates(*(column.view(agents, -1, *column.shape[1:]) for column in columns))

    def _finish(self, x: Tensor, head: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Plans that begin with `head` and go on as the policy plans from its end, and their verdicts."""
        reached = self.task.rollout(x, head)[:, -1]
        tail = finite(self.policy.plan(reached).to(x.dtype), self.task)
        plans = torch.cat((head, tail[:, : self.task.horizon - head.shape[1]]), 1)
        return self._judged(x, plans)

    def _judged(self, x: Tensor, plans: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Plans (B, T, m), their robustness, whether they are safe, and their cost."""
        judged = self.task.judge(x, plans)
        return plans, judged.rho, judged.safe >= -TOLERANCE, self.task.cost(judged)

    def _parts(self, rows: Tensor) -> list[Tensor]:
        return _pieces(rows, self.grid.batch)

    def _enter(self, found: Found, candidates: Candidates, group: Tensor, length: int) -> Tensor:
        """Take the best plan where one satisfies phi, or else phi_safe; returns where that was so."""
        good = candidates.rho >= -TOLERANCE
        allowed = torch.where(good.any(1, keepdim=True), good, candidates.safe)
        done = allowed.any(1)
        chosen = _at(candidates, done)
        _take(found, chosen, best(allowed[done], (chosen.rho, -chosen.cost)), group[done], (1, length))
        return done

    def _enter_safest(
        self, found: Found, candidates: Candidates, where: tuple[Tensor, Tensor], length: int
    ) -> None:
        """Take the plan with the longest safe prefix; of several the most robust, the latest to fail."""
        x, group = where
        agents, choices = candidates.rho.shape
        starts = x.repeat_interleave(choices, 0)
        size = max(self.grid.batch // self.task.horizon, 1)  # as every prefix is a trajectory of its own
        falls = torch.cat(
            [
                prefix_robustness(self._formulas, self.task.system.rollout_columns(start, plan))
                for start, plan in zip(
                    _pieces(starts, size), _pieces(candidates.plans.flatten(0, 1), size), strict=True
                )
            ],
            1,
        )
        samples = (falls >= -TOLERANCE).sum(0).view(agents, choices)
        depth = falls.clamp(max=0.0).mean(0).view(agents, choices)
        longest = samples == samples.amax(1, keepdim=True)
        pick = best(longest, (candidates.rho, depth, -candidates.cost))
        _take(found, candidates, pick, group, (2, length))


def finite(plan: Tensor, task: Task) -> Tensor:
    """Plans (B, T, m) with every entry that is no number replaced by the control's value nearest to 0."""
    low, high = task.system.control_low.to(plan), task.system.control_high.to(plan)
    return torch.where(torch.isfinite(plan), plan, torch.zeros_like(plan).clamp(low, high))


def best(allowed: Tensor, keys: Sequence[Tensor]) -> Tensor:
    """Per row the first allowed choice that is best by the keys in order; (rows, choices) each -> (rows,)."""
    for key in keys:
        value = torch.where(allowed & ~key.isnan(), key, -torch.inf)
        allowed = allowed & (value >= value.amax(1, keepdim=True) - TOLERANCE)
    return allowed.to(torch.uint8).argmax(1)


def _pieces(rows: Tensor, size: int) -> list[Tensor]:
    return [rows[at : at + size] for at in range(0, len(rows), size)]


def nothing(plan: Tensor) -> Found:
    """Plans (agents, T, m) that nobody has judged."""
    agents = len(plan)
    number = torch.zeros(agents, dtype=torch.int64, device=plan.device)
    return Found(
        plan.clone(),
        number + 2,
        number.clone(),
        torch.full((agents,), -torch.inf, dtype=plan.dtype, device=plan.device),
        torch.zeros(agents, dtype=torch.bool, device=plan.device),
    )


def _at(candidates: Candidates, rows: Tensor) -> Candidates:
    return Candidates(
        candidates.plans[rows], candidates.rho[rows], candidates.safe[rows], candidates.cost[rows]
    )


def _take(found: Found, candidates: Candidates, pick: Tensor, group: Tensor, how: tuple[int, int]) -> None:
    """Enter the picked candidates for the agents of a group."""
    row = torch.arange(len(group), device=group.device)
    found.plan[group] = candidates.plans[row, pick]
    found.source[group], found.t0[group] = how
    found.rho[group], found.safe[group] = candidates.rho[row, pick], candidates.safe[row, pick]
