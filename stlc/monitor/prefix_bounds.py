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
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Reach, farthest
from stlc.compile.ir.traverse import children, map_children, nodes

Floats: TypeAlias = NDArray[np.float64]

FAR = 1 << 40
"""More samples than any trace has."""

SEEN = "@seen"
"""A column that is 1 at every sample."""

_SEEN = ir.Predicate(ir.Signal(SEEN), guard=True)
_UNSEEN = ir.Predicate(ir.Signal(SEEN), sign=-1, guard=True)


def prefix_bound(formula: ir.Formula, end: Literal["lower", "upper"], *, cut: bool) -> ir.Formula:
    """Return a formula whose value is a bound on `formula` while the trace is still growing.

    The bound is valid wherever the trace may end: with the latest sample or with any later sample.

    Args:
        formula: the formula to bound.
        end: "lower" or "upper" bound.
        cut: True if the end of the trace clips all windows, False if it clips only unbounded ones.
    """
    return _PrefixBound(end == "lower", cut).of(formula)


@dataclass(frozen=True, slots=True)
class _PrefixBound:
    least: bool
    cut: bool

    def of(self, formula: ir.Formula) -> ir.Formula:
        """Return a formula whose value is a bound on `formula`, wherever the trace ends.

        The trace may end with the latest sample, or later. If it ends early, some instants of a window do not
        exist. These instants are left out if an early end is the worst case for the bound.
        """
        match formula:
            case ir.Temporal(op, window, body):
                found = self._found(body, some=op == "eventually", cut=self._cuts(window))
                return self._begun(replace(formula, body=found), window, some=op == "eventually")
            case ir.Until(op, window, left, right):
                found = self._found(right, some=op == "until", cut=self._cuts(window))
                whole = replace(formula, left=self.of(left), right=found)
                return self._begun(whole, window, some=op == "until")
            case ir.Shift(steps, body):
                found = self._found(body, some=not formula.weak, cut=self.cut and steps > 0)
                return replace(formula, body=found)
            case _:
                return map_children(formula, formulas=self.of)

    def _cuts(self, window: ir.Window) -> bool:
        return self.cut or window.hi is None

    def _found(self, body: ir.Formula, *, some: bool, cut: bool) -> ir.Formula:
        """Return a bound on the body of a window, wherever the trace ends.

        If an early end of the trace is the worst case for the bound, only existing samples count.

        Args:
            body: the body.
            some: True if the body must hold at some instant of the window, False if at every instant.
            cut: whether the end of the trace clips the window.
        """
        inner = self.of(body)
        return self._seen(inner, 0) if cut and some is self.least else inner

    def _begun(self, formula: ir.Formula, window: ir.Window, *, some: bool) -> ir.Formula:
        """Make the bound on an unbounded operator infinite if its window starts after the last sample.

        Nothing is known in this case. `some` is True if the body must hold at some instant of the window,
        False if at every instant. The formula is returned unchanged if an empty window has an infinite bound
        anyway, or if the end of the trace clips all windows (`cut`).
        """
        if window.hi is not None or self.cut or some is self.least:
            return formula
        return self._seen(formula, window.lo)

    def _seen(self, formula: ir.Formula, later: int) -> ir.Formula:
        """Make the value of `formula` infinite at each instant k for which sample k + `later` is missing.

        The value of `formula` is a bound. An infinite bound contains no information. The sample is missing if
        it has not been received yet.
        """
        there = _SEEN if self.least else _UNSEEN
        then = ir.Shift(later, there) if later else there
        return ir.BoolOp("and" if self.least else "or", (formula, then))


def with_seen(signals: Mapping[str, Floats]) -> Mapping[str, Floats]:
    """Return the signals (samples, traces), and the additional signal `SEEN`, which is 1 at every sample."""
    return {**signals, SEEN: np.broadcast_to(1.0, next(iter(signals.values())).shape)}


# ---------------------------------------------------------------- windows without an end


def own_span(node: ir.Formula) -> Reach:
    """Return how many samples `node`, an operator or predicate, reads back and ahead.

    What its operands read is not included. An unbounded window `[a, inf)` counts as `a` samples.
    """
    reads = [Reach(0, 0), *(farthest(num) for num in children(node) if not isinstance(num, ir.Formula))]
    past, future = (max(ends) for ends in zip(*reads, strict=True))
    steps = node.steps if isinstance(node, ir.Shift) else 0
    if isinstance(node, ir.Windowed):
        width = node.window.lo if node.window.hi is None else node.window.hi
        steps = -width if node.back else width
    return Reach(past + max(-steps, 0), future + max(steps, 0))


def lengthened(formula: ir.Formula, samples: int) -> ir.Formula:
    """Return the formula with every unbounded future window replaced by a long bounded one.

    The new windows are so long that no value after their end depends on the `samples` known samples.
    """
    length = samples + sum(sum(own_span(node)) for node in nodes(formula)) + 1

    def longer(node: ir.Formula) -> ir.Formula:
        if isinstance(node, ir.Windowed) and not node.back and node.window.hi is None:
            node = replace(node, window=ir.Window(node.window.lo, node.window.lo + length))
        return map_children(node, formulas=longer)

    return longer(formula)
