"""`@scale(auto)`: how far the predicates of a requirement reach, from the ranges that signals declare.

The robustness of a requirement is at most the greatest magnitude that one of its predicates takes; divided by
it, requirements in metres and in seconds weigh alike. The sign stays.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from stlc.compile.analysis.ranges import Facts, bounds
from stlc.compile.frontend.scope import Scope
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.functions import Bounds
from stlc.compile.ir.support import columns_of
from stlc.compile.ir.traverse import nodes
from stlc.diagnostics import Diagnostic
from stlc.signature import Column
from stlc.source import Span


def nominal(columns: Iterable[Column]) -> dict[str, Bounds]:
    """Every declared range, enforced or not, in stored units."""
    return {
        column.name: (column.low, column.high)
        for column in columns
        if column.low is not None and column.high is not None
    }


def reach_of_formula(formula: typed.Formula, ranges: Facts, place: Span, scope: Scope) -> float:
    """The greatest magnitude of a predicate in `formula`. Raises Failed (E205) where a range is missing."""
    known = dict(ranges)
    found = [reach_of_number(pred.num, known, place, scope) for pred in _predicates(formula, known)]
    if not found:
        scope.fail(Diagnostic("E205", "this has no predicate that varies", place))
    return max(found)


def reach_of_number(num: ir.Num, ranges: Facts, place: Span, scope: Scope) -> float:
    """The greatest magnitude of a number. Raises Failed (E205) where a range is missing."""
    ends = bounds(num, ranges)
    if ends is not None and all(map(math.isfinite, ends)) and ends != (0.0, 0.0):
        return max(map(abs, ends))
    missing = sorted(columns_of(num) - ranges.keys())
    help_: tuple[str, ...] = ("say it: `@scale(10)`",)
    message = "how far this reaches is not known"
    if missing:
        listed = ", ".join(f"`{name}`" for name in missing)
        message += f": {listed} declares no range"
        help_ = (f"signal {missing[0]} in [low, high]", *help_)
    return scope.fail(Diagnostic("E205", message, place, help=help_))


def _predicates(formula: typed.Formula, ranges: dict[str, Bounds]) -> Iterator[typed.Predicate]:
    """All predicates; the ranges of what `freeze` binds are added on the way."""
    for node in nodes(formula):
        if isinstance(node, typed.Predicate):
            yield node
        elif isinstance(node, typed.Freeze):
            found = {name: bounds(num, ranges) for name, num in node.bindings}
            ranges.update({name: ends for name, ends in found.items() if ends is not None})
