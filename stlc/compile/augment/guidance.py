"""Guidance cost: a performance term that leads plans towards deadlines beyond their horizon.

Within the horizon robustness says what to do; beyond it nothing does, and a plan could go anywhere. So the
next open goal, the one that is due first, adds how far its formula is from holding, sample by sample: the
plan that is closer sooner is the cheaper one, and once a goal is met the next one draws.
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
"""Steps left of a goal that needs nothing any more, and of one that is lost."""
_ZERO = ir.Const(0.0)


@dataclass(frozen=True, slots=True)
class _Draw:
    """Distance of a goal from being met, and the steps that it has left."""

    gap: ir.Num
    left: ir.Num


def guidance_cost(goals: Sequence[Goal]) -> ir.Num | None:
    """The gap of the goal that is due first, at one sample; None where no goal ever draws."""
    draws = [draw for goal in goals if (draw := _draw(goal)) is not None]
    if not draws:
        return None
    return _first_due(draws).gap


def _draw(goal: Goal) -> _Draw | None:
    match goal:
        case GoalLeaf():
            return _leaf(goal)
        case GoalBranch(op, items):
            draws = [draw for item in items if (draw := _draw(item)) is not None]
            if not draws:
                return None
            if op == "and":
                whole = _first_due(draws)
                most = reduce(lambda a, b: ir.Op("max", (a, b)), [draw.left for draw in draws])
                return _Draw(whole.gap, _where(_is_lost(most), ir.Const(_LOST), whole.left))
            return reduce(_nearer, draws)
        case _:
            assert_never(goal)


def _leaf(leaf: GoalLeaf) -> _Draw | None:
    """Promises draw until they are met, `always` until its window begins."""
    formula, window = leaf.formula, leaf.formula.window
    if formula.op == "always" and window.hi is None and (rounds := _rounds(leaf)):
        return rounds
    promise = formula.op in ("eventually", "until")
    due = window.hi if promise else window.lo
    if due is None or due == 0 or isinstance(formula.margin, ir.Truth):
        return None
    margin = _margin(formula.margin)
    if margin is None:
        return None
    left = ir.Op("sub", (ir.Const(float(due)), leaf.clock))
    open_ = at_least(ir.Const(0.5), ir.Op("abs", (leaf.status,)))
    waiting = open_ if promise else ir.BoolOp("and", (open_, at_least(left, ir.Const(1.0))))
    lost = at_least(ir.Const(-0.5), leaf.status)
    gap = ir.Op("relu", (ir.Op("neg", (margin,)),))
    over = _where(lost, ir.Const(_LOST), ir.Const(_DONE))
    return _Draw(_where(waiting, gap, _ZERO), _where(waiting, left, over))


def _rounds(leaf: GoalLeaf) -> _Draw | None:
    """Recurring goals, `always@[a, end] once[0, c] p`: p draws, and is due c after it was last there."""
    margin = leaf.formula.margin
    parts = margin.items if isinstance(margin, ir.BoolOp) and margin.op == "and" else (margin,)
    draws = [draw for part in parts if (draw := _round(part, leaf)) is not None]
    return _first_due(draws) if draws else None


def _round(part: ir.Formula, leaf: GoalLeaf) -> _Draw | None:
    """Of `p or c - since >= 0`."""
    if not isinstance(part, ir.BoolOp) or part.op != "or":
        return None
    tests = [
        item.num for item in part.items if isinstance(item, ir.Predicate) and item.guard and item.sign > 0
    ]
    margin = _margin(part)
    if margin is None or len(tests) != 1:
        return None
    begins = ir.Op("sub", (ir.Const(float(leaf.formula.window.lo)), leaf.clock))
    left = ir.Op("max", (begins, tests[0]))
    lost = at_least(ir.Const(-0.5), leaf.status)
    gap = ir.Op("relu", (ir.Op("neg", (margin,)),))
    return _Draw(_where(lost, _ZERO, gap), _where(lost, ir.Const(_LOST), left))


def _first_due(draws: Sequence[_Draw]) -> _Draw:
    """Together: the gaps of those that are due first."""
    if len(draws) == 1:
        return draws[0]
    first = reduce(lambda a, b: ir.Op("min", (a, b)), [draw.left for draw in draws])
    gaps = [_where(at_least(first, draw.left), draw.gap, _ZERO) for draw in draws]
    return _Draw(reduce(lambda a, b: ir.Op("add", (a, b)), gaps), first)


def _nearer(one: _Draw, other: _Draw) -> _Draw:
    """Of two ways the one that is met, else the nearer one that is not lost."""
    first = ir.BoolOp(
        "or",
        (
            _is_lost(other.left),
            ir.BoolOp("and", (_not_lost(one.left), at_least(other.gap, one.gap))),
        ),
    )
    return _Draw(_where(first, one.gap, other.gap), _where(first, one.left, other.left))


def _is_lost(left: ir.Num) -> ir.Formula:
    return at_least(left, ir.Const(0.5 * (_DONE + _LOST)))


def _not_lost(left: ir.Num) -> ir.Formula:
    return at_least(ir.Const(0.5 * (_DONE + _LOST)), left)


def _where(condition: ir.Formula, yes: ir.Num, no: ir.Num) -> ir.Num:
    return ir.Where(condition, yes, no)


def _margin(formula: ir.Formula) -> ir.Num | None:
    """Robustness of a state formula as a number; None where only tests of time decide it."""
    match formula:
        case ir.Predicate(_, _, _, True) | ir.Truth():
            return None
        case ir.Predicate(num, sign):
            return num if sign > 0 else ir.Op("neg", (num,))
        case ir.BoolOp(op, items):
            parts = [part for item in items if (part := _margin(item)) is not None]
            name = "min" if op == "and" else "max"
            return reduce(lambda a, b: ir.Op(name, (a, b)), parts) if parts else None
        case _:
            raise TypeError(f"not a state formula: {formula!r}")
