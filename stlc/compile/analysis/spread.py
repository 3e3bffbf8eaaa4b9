"""Between which values random numbers usually lie: ranges for scaling, never facts."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from types import MappingProxyType

from stlc.compile.ir import nodes as ir

_DEVIATIONS = 3.0
_CHANGES: Mapping[str, Callable[[float, float], float]] = MappingProxyType(
    {"add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv}
)
"""Units of random draws: points are shifted, deviations are scaled."""


def spread(num: ir.Num) -> tuple[float, float] | None:
    """Where nearly all draws of a sampler with known arguments lie; None where nothing is known."""
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
            known = [spread(option) for option in options]
            found = [ends for ends in known if ends is not None]
            if len(found) < len(known):
                return None
            return min(low for low, _ in found), max(high for _, high in found)
        case ir.Op("add" | "sub" | "mul" | "div" as op, (inner, ir.Const(amount))) if amount:
            ends = spread(inner)
            if ends is None:
                return None
            moved = [_CHANGES[op](end, amount) for end in ends]
            return min(moved), max(moved)
        case _:
            return None
