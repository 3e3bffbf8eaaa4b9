"""The full guard where plans must have something to spare: if none has, what comes closest is followed.

A plan that is safe by less than was asked for is worth more than a prefix that keeps the whole margin for as
long as it can and then does not: a rover beside a wall can stay there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.guard.feasibility import safely
from stlc.controller.guard.plan_repair import POLISHED, SEED, FullBackup, Limits
from stlc.controller.guard.safe_prefix import robustness_until
from stlc.controller.guard.shooting import Found, finite, nothing
from stlc.controller.training.local_search import Searcher

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.runtime.prefixes import Grid


class Closest:
    """A full guard for a task that is stricter than the one that counts.

    Args:
        task: the one that counts.
        strict: the same with margins.
        policy: who finishes prefixes.
        grid: values of the controls; by default what the system file says.
        limits: of a decision.
    """

    def __init__(
        self, task: Task, strict: Task, policy: Policy, *, grid: Grid | None = None, limits: Limits
    ) -> None:
        seconds = None if limits.seconds is None else limits.seconds / 2
        half = replace(limits, seconds=seconds)
        self.task, self.limits = strict, half
        self._strict = FullBackup(strict, policy, grid=grid, limits=half)
        self._plain = FullBackup(task, policy, grid=grid, limits=half)
        generator = torch.Generator().manual_seed(SEED)
        self._searcher = Searcher(safely(strict), generator, enough=0.0)
        self._formulas = [rule.formula for rule in strict.compiled.safety]

    @torch.no_grad()
    def search(self, x: Tensor, plan: Tensor, rest: Tensor | None = None) -> Found:
        """Better plans for states whose own plan was found wanting; verdicts are those of the strict task.

        Args:
            x: (agents, n) float64.
            plan: (agents, T, m), what the policy would do.
            rest: (agents, T, m), what is left of the plans that were followed until now.

        Returns:
            One plan an agent: what the full guard finds; where that has not enough to spare, the plan that
            is safe and has the most, in so far as one was found. Where already the present state has not
            enough, no plan has, and what satisfies or is safe without a margin is begun with.
        """
        plan = finite(plan.to(x.dtype), self.task)
        rest = plan if rest is None else finite(rest.to(x.dtype), self.task)
        lacking = self._lacking(x, plan)
        found = self._plain_found(x, plan, rest, lacking)
        far = (~lacking).nonzero()[:, 0]
        if len(far):
            strict = self._strict.search(x[far], plan[far], rest[far])
            found.put(far, strict)
            short = far[~strict.safe]
            close = self._closer(found, short, x, rest[short])
            self._closer(found, close, x, self._plain.search(x[close], plan[close]).plan)
        return found

    def _lacking(self, x: Tensor, plan: Tensor) -> Tensor:
        """Who has not enough to spare where it is, (agents,)."""
        columns = self.task.system.rollout_columns(x, plan)
        return ~(robustness_until(self._formulas, columns, 0) >= -TOLERANCE)

    def _plain_found(self, x: Tensor, plan: Tensor, rest: Tensor, lacking: Tensor) -> Found:
        """For those who lack a margin now what is found without one, and comes closer; nothing for others."""
        found = nothing(plan)
        rows = lacking.nonzero()[:, 0]
        if len(rows):
            plain = self._plain.search(x[rows], plan[rows], rest[rows])
            found.put(rows, plain)
            found.rho[rows] = self.task.judge(x[rows], plain.plan, states=False).rho
            found.safe[rows] = False
            safe = rows[plain.safe]
            self._closer(found, safe, x, plain.plan[plain.safe])
        return found

    def _closer(self, found: Found, rows: Tensor, x: Tensor, start: Tensor) -> Tensor:
        """Climb from `start`, (rows, T, m), and enter what is safe; returns the rows where it is not."""
        if not len(rows):
            return rows
        climbed = self._searcher.at_once(x[rows], start, tries=self.limits.tries).plans.to(x.dtype)
        safe = self._plain.task.judge(x[rows], climbed, states=False).safe >= -TOLERANCE
        done = rows[safe]
        found.plan[done] = climbed[safe]
        found.rho[done] = self.task.judge(x[done], climbed[safe], states=False).rho
        found.source[done], found.t0[done] = POLISHED, 0
        return rows[~safe]
