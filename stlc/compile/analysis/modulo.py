"""W403: a modulo in a predicate that is trained for jumps where a gradient cannot see it."""

from __future__ import annotations

import math
from collections.abc import Iterator

from stlc.compile.analysis.ranges import Facts, bounds
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.traverse import nodes, subexpressions
from stlc.diagnostics import Diagnostic


def jumps(formula: typed.Formula, ranges: Facts) -> Iterator[Diagnostic]:
    """One warning for every predicate with a modulo that jumps within the ranges of its signals.

    Args:
        formula: as resolved.
        ranges: of columns, declared or enforced, in stored units.
    """
    for node in nodes(formula):
        if isinstance(node, typed.Predicate) and any(_jumps(num, ranges) for num in subexpressions(node.num)):
            yield Diagnostic(
                "W403",
                "a modulo in a predicate that is trained for",
                node.span,
                "jumps at every multiple, and no gradient tells so",
                help=(
                    "give the system a phase as a state that a jump sets back: `timer`, `reset_when`",
                    "or declare a range within one period: `signal tau [s] in [0, 8]`",
                ),
            )


def _jumps(num: ir.Num, ranges: Facts) -> bool:
    """Whether `num` is a modulo whose left side may pass a multiple of its right side."""
    if not isinstance(num, ir.Op) or num.name != "mod":
        return False
    value, period = (bounds(arg, ranges) for arg in num.args)
    if value is None or period is None or period[0] != period[1] or not all(map(math.isfinite, value)):
        return True
    return math.ceil(value[1] / period[0]) - math.floor(value[0] / period[0]) > 1
