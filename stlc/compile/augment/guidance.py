"""Guidance cost: a term of the plan's cost that drives plans towards deadlines beyond their horizon.

A goal is a formula such as `eventually@[a, b] p`, whose interval counts from the start of the mission. The
robustness of a plan covers only the horizon of the plan. Therefore the open (undecided) goal with the
earliest deadline adds its violation to the cost at every sample. The violation is `max(-margin, 0)`, where
the margin is the robustness of p. So plans that approach the goal sooner cost less. Once this goal is met,
the goal with the next deadline takes over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import assert_never

from stlc.compile.augment.mission import Goal, GoalBranch, GoalLeaf
from stlc.compile.augment.timers import at_least
from stlc.compile.ir import nodes as ir

_DONE, _LOST = 1e6, 2e6
"""Values of `left` for a goal that is already met, and for one that can no longer be met."""
_ZERO = ir.Const(0.0)
_LATEST = ir.Const(0.5 * (_DONE + _LOST))
"""Greatest `left` of a goal that can still be met."""


@dataclass(frozen=True, slots=True)
class _Guidance:
    """Violation of a goal such as `eventually@[a, b] p`, and the time left for the goal.

    The guidance cost, a term of the plan's cost, is computed from these values.

    Attributes:
        gap: violation of the goal, `max(-margin, 0)`, where the margin is the robustness of p.
        left: steps until the deadline of the goal; `_DONE` if the goal is already met, `_LOST` if it can no
            longer be met.
    """

    gap: ir.Num
    left: ir.Num


def guidance_cost(goals: Sequence[Goal]) -> ir.Num | None:
    """Return the guidance cost at one sample: the violation of the goal with the earliest deadline.

    A goal is a formula such as `eventually@[a, b] p`, whose interval counts from the start of the mission.
    Its violation is `max(-margin, 0)`, where the margin is the robustness of p. The result is None if no goal
    has a deadline.
    """
    costs = [cost for goal in goals if (cost := _guidance(goal)) is not None]
    if not costs:
        return None
    return _first_due(costs).gap


def _guidance(goal: Goal) -> _Guidance | None:
    match goal:
        case GoalLeaf():
            return _leaf(goal)
        case GoalBranch(op, items):
            costs = [cost for item in items if (cost := _guidance(item)) is not None]
            if not costs:
                return None
            if op == "and":
                whole = _first_due(costs)
                most = reduce(lambda a, b: a.apply("max", b), [cost.left for cost in costs])
                return _Guidance(whole.gap, _is_lost(most).select(_LOST, whole.left))
            return reduce(_nearer, costs)
        case _:
            assert_never(goal)


def _leaf(leaf: GoalLeaf) -> _Guidance | None:
    """Return the violation of one goal and the time left for it; None if the goal has no deadline ahead.

    The goal is an absolute formula: its interval counts from the start of the mission. The deadline of
    `eventually@` and `until@` is the end of the interval. The deadline of `always@` is the start of the
    interval. The violation is 0 once the formula is true or false, or once the interval of `always@` has
    begun.

    A recurring goal is `always@[a, end] once[0, c] p`, or a conjunction such as
    `always@[a, end] (once[0, c] p and once[0, d] q)`. The deadline of `once[0, c] p` is c after the last
    sample at which p held.
    """
    formula, window, status = leaf.formula, leaf.formula.window, leaf.status
    if formula.op == "always" and window.hi is None and status is not None:
        body = formula.margin
        parts = body.items if isinstance(body, ir.BoolOp) and body.op == "and" else (body,)
        costs = [cost for part in parts if (cost := _recurring_part(part, leaf, status)) is not None]
        if costs:
            return _first_due(costs)
    promise = formula.op in ("eventually", "until")
    due = window.hi if promise else window.lo
    if due is None or due == 0 or status is None or isinstance(formula.margin, ir.Truth):
        return None
    margin = _margin(formula.margin)
    if margin is None:
        return None
    left = ir.Const(float(due)) - leaf.clock
    open_ = at_least(ir.Const(0.5), status.apply("abs"))
    waiting = open_ if promise else open_ & at_least(left, ir.Const(1.0))
    lost = at_least(ir.Const(-0.5), status)
    gap = (-margin).apply("relu")
    over = lost.select(_LOST, _DONE)
    return _Guidance(waiting.select(gap, _ZERO), waiting.select(left, over))


def _recurring_part(part: ir.Formula, leaf: GoalLeaf, status: ir.Signal) -> _Guidance | None:
    """Return the violation and the time left of `part`, one item of a recurring goal.

    A recurring goal is, for example, `always@[a, end] (once[0, c] p and once[0, d] q)`; its items are
    `once[0, c] p` and `once[0, d] q`. Timers have replaced the past operators: `part` is
    `p or c - since >= 0`, where the timer `since` counts the steps since p last held. The result is None if
    `part` does not have this form.

    `leaf` is the recurring goal, and `status` the state that holds whether it is open, true or false.
    """
    if not isinstance(part, ir.BoolOp) or part.op != "or":
        return None
    tests = [
        item.num for item in part.items if isinstance(item, ir.Predicate) and item.guard and item.sign > 0
    ]
    margin = _margin(part)
    if margin is None or len(tests) != 1:
        return None
    begins = ir.Const(float(leaf.formula.window.lo)) - leaf.clock
    left = begins.apply("max", tests[0])
    lost = at_least(ir.Const(-0.5), status)
    gap = (-margin).apply("relu")
    return _Guidance(lost.select(_ZERO, gap), lost.select(_LOST, left))


def _first_due(costs: Sequence[_Guidance]) -> _Guidance:
    """Return the violation and the time left of a conjunction of goals.

    `costs` are the violation and the time left of each goal. The violation of the conjunction is the sum over
    the goals with the earliest deadline. The time left is the time until this deadline.
    """
    if len(costs) == 1:
        return costs[0]
    first = reduce(lambda a, b: a.apply("min", b), [cost.left for cost in costs])
    gaps: list[ir.Num] = [at_least(first, cost.left).select(cost.gap, _ZERO) for cost in costs]
    return _Guidance(reduce(lambda a, b: a + b, gaps), first)


def _nearer(one: _Guidance, other: _Guidance) -> _Guidance:
    """Return the violation and the time left of a disjunction of two goals, `one` and `other`.

    The result is `one` or `other`, whichever has the smaller violation. A goal that can no longer be met is
    passed over; a goal that is already met has the violation 0.
    """
    first = _is_lost(other.left) | (at_least(_LATEST, one.left) & at_least(other.gap, one.gap))
    return _Guidance(first.select(one.gap, other.gap), first.select(one.left, other.left))


def _is_lost(left: ir.Num) -> ir.Formula:
    return at_least(left, _LATEST)


def _margin(formula: ir.Formula) -> ir.Num | None:
    """Return the robustness of a state formula as a number; predicates on the clock and timers are left out.

    If the formula has no other predicates, the result is None.
    """
    match formula:
        case ir.Predicate(_, _, _, True) | ir.Truth():
            return None
        case ir.Predicate(num, sign):
            return num if sign > 0 else -num
        case ir.BoolOp(op, items):
            parts = [part for item in items if (part := _margin(item)) is not None]
            name = "min" if op == "and" else "max"
            return reduce(lambda a, b: a.apply(name, b), parts) if parts else None
        case _:
            raise TypeError(f"not a state formula: {formula!r}")
