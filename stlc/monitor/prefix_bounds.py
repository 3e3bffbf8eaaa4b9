"""Formulas whose values are bounds on the robustness of a stream that may end with any sample.

A window that extends to the end of the trace has an unknown length while the trace grows. An `eventually` is
least if the trace ends now, since later samples can only increase it. An `always` is least if the trace
continues. For the greatest values it is the other way round. The least and the greatest value therefore need
two formulas.

`prefix_bound` adds a predicate to the formula. This predicate is true at every existing sample and unknown
after the last one. Values after the last sample then do not count.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Literal

from stlc.compile.ir import nodes as ir
from stlc.compile.namespace import Array, Ops

FAR = 1 << 40
"""More samples than any trace has."""

SEEN = "@seen"
"""A column that is 1 at every sample."""


@lru_cache(maxsize=512)
def prefix_bound(formula: ir.Formula, end: Literal["lower", "upper"], *, cut: bool) -> ir.Formula:
    """Return a formula whose value is a bound on `formula` while the trace is still growing.

    The bound is valid wherever the trace may end: with the latest sample or with any later sample.

    Args:
        formula: the formula to bound.
        end: "lower" or "upper" bound.
        cut: True if the end of the trace clips all windows, False if it clips only unbounded ones.
    """
    least = end == "lower"

    def bound(node: ir.Formula) -> ir.Formula:
        found = node.map_children(formulas=bound)
        if isinstance(found, (ir.Temporal, ir.Until)):
            clipped = cut or found.window.hi is None
            if (found.op in ("eventually", "until")) is not least:  # an early end is not the worst case
                return seen(found, found.window.lo) if clipped and not cut else found
            if clipped and isinstance(found, ir.Temporal):  # only instants that exist count
                return replace(found, body=seen(found.body))
            if clipped and isinstance(found, ir.Until):
                return replace(found, right=seen(found.right))
        elif isinstance(found, ir.Shift) and cut and found.steps > 0 and found.weak is not least:
            return replace(found, body=seen(found.body))
        return found

    def seen(node: ir.Formula, later: int = 0) -> ir.Formula:
        """Make the bound infinite at each instant k for which sample k + `later` is missing."""
        there = ir.Predicate(ir.Signal(SEEN), sign=1 if least else -1, guard=True)
        return ir.BoolOp("and" if least else "or", (node, ir.Shift(later, there) if later else there))

    return bound(formula)


def with_seen(signals: Mapping[str, Array], ops: Ops) -> Mapping[str, Array]:
    """Return the signals (samples, traces), and the additional signal `SEEN`, which is 1 at every sample."""
    like = next(iter(signals.values()))
    return {**signals, SEEN: ops.full(like.shape, 1.0, like)}


def lengthened(formula: ir.Formula, samples: int) -> ir.Formula:
    """Return the formula with every unbounded future window replaced by a long bounded one.

    The new windows are so long that no value after their end depends on the `samples` known samples.
    """
    length = samples + sum(sum(node.own_reach) for node in formula.walk()) + 1

    def longer(node: ir.Formula) -> ir.Formula:
        if operator := node.unbounded:
            node = operator.with_window(operator.window.lo, operator.window.lo + length)
        return node.map_children(formulas=longer)

    return longer(formula)
