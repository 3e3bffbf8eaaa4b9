"""Interval arithmetic over numbers: what enforced ranges say about an expression."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS, Bounds

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
