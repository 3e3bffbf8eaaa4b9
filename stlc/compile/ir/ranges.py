"""Intervals that contain the values of an expression.

For an expression of signals, the interval follows from the ranges of the signals (interval arithmetic). For a
number drawn at random, the interval contains nearly all values, for example three standard deviations on
either side of the mean.

The ranges of functions stand in their table (`stlc.compile.ir.functions`), so that the front end needs no
array library. A test holds each to the interval arithmetic over arrays, which is as tight or tighter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS, Bounds

_DEVIATIONS = 3.0
"""Standard deviations around the mean that hold nearly all draws."""


def usual_range(num: ir.Num) -> tuple[float, float] | None:
    """Return the range that contains nearly all values of a number drawn at random; None if unknown.

    The number is a constant, or a sampler such as `uniform(0, 1)` with constant arguments. The sampler may be
    scaled and shifted by constants, as in `2 * uniform(0, 1) + 5`; unit conversions do this. For `normal` the
    range is the mean plus or minus three standard deviations.
    """
    match num:
        case ir.Const(value):
            return value, value
        case ir.Op("uniform" | "randint", (ir.Const(low), ir.Const(high))) if low <= high:
            return low, high
        case ir.Op("truncnorm", (_, _, ir.Const(low), ir.Const(high))) if low <= high:
            return low, high
        case ir.Op("normal", (ir.Const(mean), ir.Const(deviation))):
            reach = _DEVIATIONS * abs(deviation)
            return mean - reach, mean + reach
        case ir.Op("bernoulli", _):
            return 0.0, 1.0
        case ir.Op("choice", options):
            known = [usual_range(option) for option in options]
            found = [ends for ends in known if ends is not None]
            if len(found) < len(known):
                return None
            return min(low for low, _ in found), max(high for _, high in found)
        case ir.Op("add" | "sub" | "mul" | "div" as op, (inner, ir.Const(amount))) if amount:
            return _op(op, [usual_range(inner), (amount, amount)])
        case _:
            return None


KnownRanges: TypeAlias = Mapping[str, Bounds]


def bounds(num: ir.Num, facts: KnownRanges) -> Bounds | None:
    """Return an interval that contains all values of `num`; None if the known ranges do not bound it.

    Args:
        num: a number in SI units.
        facts: ranges that signals never leave, each in the unit in which the signal is stored.
    """
    match num:
        case ir.Const(value):
            return (value, value)
        case ir.Op(name, args):
            return _op(name, [bounds(arg, facts) for arg in args])
        case ir.Where(_, yes, no):
            left, right = bounds(yes, facts), bounds(no, facts)
            if left is None or right is None:
                return None
            return (min(left[0], right[0]), max(left[1], right[1]))
        case ir.Indicator():
            return (0.0, 1.0)
        case ir.Signal(name) | ir.ShiftedSignal(name) | ir.FrozenVar(name):
            return facts.get(name)
        case _:
            return None


def has_value(num: ir.Op) -> bool:
    """True if a function gives a number for all values of the signals that its arguments read.

    False for `sqrt(x)`, which is NaN for x < 0, and for `1 / x`, but not for `sqrt(x^2 + 1)`.
    """
    rule = FUNCTIONS[num.name].domain
    if rule is None:
        return True
    facts = {leaf.name: _ANYTHING for leaf in num.leaves() if not isinstance(leaf, ir.Const)}
    return rule([bounds(arg, facts) or _ANYTHING for arg in num.args])


_ANYTHING = (-math.inf, math.inf)


def _op(name: str, args: Sequence[Bounds | None]) -> Bounds | None:
    rule = FUNCTIONS[name].bounds
    if isinstance(rule, tuple):
        return rule
    known = [arg for arg in args if arg is not None]
    if rule is None or len(known) < len(args):
        return None
    try:
        low, high = rule(known)
    except (ValueError, OverflowError, ZeroDivisionError):
        return None
    return None if math.isnan(low) or math.isnan(high) else (low, high)
