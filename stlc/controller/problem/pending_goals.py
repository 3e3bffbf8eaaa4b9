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

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.numbers import Untranslatable, margin_of
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.support import Reach

if TYPE_CHECKING:
    from collections.abc import Mapping

    from stlc.compile.ir.discretize import Grid
    from stlc.compile.namespace import Ops
    from stlc.compile.pipeline import Compiled
    from stlc.dynamics.model.cost import PlanCost


@dataclass(frozen=True, slots=True)
class PendingGoal:
    """Goal `eventually@[a, b]`: a state formula to be satisfied once in steps a to b of a mission.

    Attributes:
        status: name of the state that records the status of the goal; it is near 0 while the goal is pending.
        margin: robustness of the state formula, an expression of the states at a sample.
        first: first step of the mission at which satisfaction counts.
        last: last step of the mission at which satisfaction counts.
    """

    status: str
    margin: ir.Num
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

    def added_to(self, cost: PlanCost, weight: float) -> PlanCost:
        """Add to a cost `weight` times the margins that plans lack at the goals that are pending."""
        for goal in self.items:
            times = goal.first, goal.last
            cost = cost.with_goal(goal.margin, self.clock, times, goal.status, self._gamma, weight)
        return cost

    def deepened(self, columns: Mapping[str, Any], ops: Ops) -> Any:
        """Mask of the plans whose first step increases the margin of a goal that the first sample satisfies.

        Goals whose margin at the first sample is at least gamma, the margin that plans should have, are
        ignored. There must be at least one goal. The mask is (1, batch).

        Args:
            columns: predicted states, name -> (time, batch).
            ops: the array library.
        """
        found = []
        for margin in self._margins({name: column[:2] for name, column in columns.items()}, ops).values():
            now, soon = margin[:1], margin[1:]
            held = ops.both(ops.ge(now, 0.0), ops.gt(self._gamma, now))
            found.append(ops.both(held, ops.gt(soon, now)))
        return reduce(ops.either, found)

    @cached_property
    def _margins(self) -> ArrayProgram:
        return ArrayProgram({goal.status: goal.margin for goal in self.items})


def _goal(name: str, formula: typed.Formula, grid: Grid) -> PendingGoal | None:
    if formula.word != "eventually" or not formula.on_clock or (window := formula.ahead) is None:
        return None
    (body,) = formula.operands
    lowered = grid.lower(body, [])
    if window.hi is not None and lowered.reach == Reach(0, 0):
        with suppress(Untranslatable):
            margin = margin_of(lowered, guarded=True)
            return PendingGoal(name, margin, _steps(window.lo, grid), _steps(window.hi, grid))
    return None


def _steps(time: typed.Time, grid: Grid) -> float:
    seconds = float(time.seconds) / float(grid.dt or 1)
    return seconds + float(time.steps) + float(time.horizons) * (grid.horizon or 0)
