"""Robustness margins of pending goals of a mission.

A goal is a requirement `eventually@[a, b]`, whose times count from the start of the mission. It is pending
until it is satisfied or violated.

Example: the goal `eventually@[0 s, 18 s] [x, y] in b` (be in the region b once). At the first sample in b
the margin is almost 0. From then on, the guidance cost (distance to the next goal) would draw plans out of b.
Therefore plans that reach a pending goal are compared by the margin with which they reach it, up to gamma,
the margin that plans should have. While the margin still increases along the previous plan, this plan is
retained.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.lower import lower
from stlc.compile.ir.support import Reach, reach

if TYPE_CHECKING:
    from collections.abc import Mapping

    from stlc.compile.ir.discretize import Grid
    from stlc.compile.pipeline import Compiled

HELD = 0.5
"""Magnitude of a status below which the goal is pending."""


@dataclass(frozen=True, slots=True)
class PendingGoal:
    """Goal `eventually@[a, b]`: a state formula to be satisfied once in steps a to b of a mission.

    Attributes:
        status: name of the state that records the status of the goal; it is near 0 while the goal is pending.
        body: the state formula.
        first: first step of the mission at which satisfaction counts.
        last: last step of the mission at which satisfaction counts.
    """

    status: str
    body: ir.Formula
    first: float
    last: float


class PendingGoals:
    """Goals `eventually@[a, b]` of a mission, and the margins of those that are pending.

    Attributes:
        clock: name of the state that counts the steps since the start of the mission; "" if there is none.
        items: goals that are requirements by themselves; goals nested in other formulas are left out.
    """

    def __init__(self, compiled: Compiled, gamma: float) -> None:
        """Collect the goals of a compiled specification; `gamma` is the margin that plans should have."""
        self._gamma = gamma
        self.clock = next((timer.name for timer in compiled.timers if timer.kind == "clock"), "")
        statuses = {timer.name for timer in compiled.timers if timer.kind == "status"}
        found = [
            _goal(rule.name, rule.typed.formula, compiled.grid)
            for rule in compiled.requirements
            if rule.name in statuses
        ]
        self.items = tuple(goal for goal in found if goal is not None)

    def short(self, columns: Mapping[str, Tensor]) -> Tensor:
        """Margin that plans lack, summed over the goals that are pending at the first sample: (batch,).

        At one goal a plan lacks gamma, the margin that plans should have, minus the largest margin that the
        plan reaches at this goal, clipped to the range from 0 to gamma.

        Args:
            columns: predicted states, name -> (time, batch); the result is differentiable with respect to
                them.
        """
        clock = columns[self.clock]
        lack = torch.zeros_like(clock[0])
        for goal, margin in zip(self.items, self._margins(columns, len(clock)), strict=True):
            counts = (clock >= goal.first) & (clock <= goal.last)
            best = torch.where(counts, margin, torch.full_like(clock, -torch.inf)).amax(0)
            is_open = columns[goal.status][0].abs() < HELD
            lack = lack + torch.where(is_open, (self._gamma - best).clamp(0.0, self._gamma), 0.0)
        return lack

    def deepened(self, columns: Mapping[str, Tensor]) -> Tensor:
        """Mask of the plans whose first step increases the margin of a goal that the first sample satisfies.

        Goals whose margin at the first sample is at least gamma, the margin that plans should have, are
        ignored. The mask is (batch,).

        Args:
            columns: predicted states, name -> (time, batch).
        """
        found = torch.zeros_like(columns[self.clock][0], dtype=torch.bool)
        for margin in self._margins(columns, 2):
            now, soon = margin.expand(2, -1)
            found |= (now >= 0.0) & (now < self._gamma) & (soon > now)
        return found

    def _margins(self, columns: Mapping[str, Tensor], count: int) -> list[Tensor]:
        """Robustness of every goal's state formula at the first `count` samples, (count, batch) each."""
        env = {name: column[:count] for name, column in columns.items()}
        found: list[Tensor] = evaluate([goal.body for goal in self.items], env, ops=TORCH, count=count)
        return found


def _goal(name: str, formula: typed.Formula, grid: Grid) -> PendingGoal | None:
    match formula:
        case typed.Temporal(
            op="eventually",
            interval=typed.Interval(clock="start", lo=lo, hi=typed.Time() as hi),
            body=body,
        ):
            lowered = lower(body, grid, [])
            if reach(lowered) == Reach(0, 0):
                return PendingGoal(name, lowered, _steps(lo, grid), _steps(hi, grid))
        case _:
            pass
    return None


def _steps(time: typed.Time, grid: Grid) -> float:
    seconds = float(time.seconds) / float(grid.dt or 1)
    return seconds + float(time.steps) + float(time.horizons) * (grid.horizon or 0)
