"""Interval arithmetic over numbers: what enforced ranges say about an expression."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from types import MappingProxyType
from typing import TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS

Bounds: TypeAlias = tuple[float, float]
Facts: TypeAlias = Mapping[str, Bounds]


def bounds(num: ir.Num, facts: Facts) -> Bounds | None:
    """The least interval that interval arithmetic finds for `num`, or None where the facts do not say.

    Args:
        num: a number in SI units.
        facts: enforced ranges of columns, in stored units.
    """
    match num:
        case ir.Const(value):
            return (value, value)
        case ir.Signal(name) | ir.ShiftedSignal(name) | ir.FrozenVar(name):
            return facts.get(name)
        case ir.Indicator():
            return (0.0, 1.0)
        case ir.Where(_, yes, no):
            return _hull(bounds(yes, facts), bounds(no, facts))
        case ir.Op(name, args):
            return _op(name, [bounds(arg, facts) for arg in args])
        case ir.Extern():
            return None


def _hull(left: Bounds | None, right: Bounds | None) -> Bounds | None:
    if left is None or right is None:
        return None
    return (min(left[0], right[0]), max(left[1], right[1]))


def _op(name: str, args: Sequence[Bounds | None]) -> Bounds | None:
    known = [arg for arg in args if arg is not None]
    if name in ("sin", "cos"):
        return (-1.0, 1.0)
    rule = _RULES.get(name)
    if rule is None or len(known) < len(args):
        return None
    try:
        low, high = rule(known)
    except (ValueError, OverflowError, ZeroDivisionError):
        return None
    return None if math.isnan(low) or math.isnan(high) else (low, high)


def _corners(name: str) -> Callable[[Sequence[Bounds]], Bounds]:
    """For functions that are monotone in each argument: the extremes lie at corners."""
    fold = FUNCTIONS[name].fold
    assert fold is not None

    def rule(args: Sequence[Bounds]) -> Bounds:
        values = [float(fold(*corner)) for corner in product(*args)]
        return (min(values), max(values))

    return rule


def _quotient(args: Sequence[Bounds]) -> Bounds:
    low, high = args[1]
    if low <= 0 <= high:
        return (-math.inf, math.inf)
    return _corners("div")(args)


def _even(args: Sequence[Bounds]) -> Bounds:
    low, high = args[0]
    top = max(abs(low), abs(high))
    return (0.0 if low <= 0 <= high else min(abs(low), abs(high)), top)


def _square(args: Sequence[Bounds]) -> Bounds:
    low, high = _even(args)
    return (low * low, high * high)


def _modulo(args: Sequence[Bounds]) -> Bounds:
    low, high = args[1]
    return (min(low, 0.0), max(high, 0.0))


def _norm(args: Sequence[Bounds]) -> Bounds:
    sides = [_even([arg]) for arg in args]
    return (math.hypot(*(side[0] for side in sides)), math.hypot(*(side[1] for side in sides)))


_MONOTONE = "add sub mul neg min max clip relu floor ceil round sign sqrt exp log asin acos atan"
_RULES: Mapping[str, Callable[[Sequence[Bounds]], Bounds]] = MappingProxyType(
    {
        **{name: _corners(name) for name in _MONOTONE.split()},
        "div": _quotient,
        "abs": _even,
        "square": _square,
        "mod": _modulo,
        "norm": _norm,
    }
)
