"""typed -> IR: negation normal form, and time in whole steps.

De Morgan is the whole trick: `sign` says whether the formula or its negation is wanted, and flipping it swaps
`and` with `or`, `always` with `eventually`, `until` with `release`. It ends in the sign of a predicate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, assert_never, final

from stlc.compile.frontend.bounds import to_window
from stlc.compile.frontend.interface import Grid
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.traverse import from_now, on_clock
from stlc.diagnostics import Diagnostic

Sign: TypeAlias = Literal[1, -1]

_CAUTIOUS = frozenset({"always", "historically", "release", "trigger"})
"""Operators that ask something of every sample: a bound off the grid is rounded outwards."""


def lower(formula: typed.Formula, grid: Grid, sink: list[Diagnostic]) -> ir.Formula:
    """`formula` in negation normal form and steps.

    Absolute intervals are judged from the first sample on; what trains has none any more
    (`stlc.compile.augment.timers`). Findings (E301, E302, E305, E311, W304) go to
    `sink`; where it holds an error afterwards, the formula is not meant to be used.
    """
    return _Lowering(grid, sink).formula(formula, 1)


def _flip(sign: Sign) -> Sign:
    return -1 if sign > 0 else 1


@final
@dataclass(frozen=True, slots=True)
class _Lowering:
    grid: Grid
    sink: list[Diagnostic]

    def formula(self, node: typed.Formula, sign: Sign) -> ir.Formula:
        """`node` for `sign` 1, its negation for -1."""
        match node:
            case typed.Truth(span, value):
                return ir.Truth(value is (sign > 0), span)
            case typed.Predicate(span, num, strict, guard):
                return ir.Predicate(num, sign, strict is (sign > 0), guard, span)
            case typed.Not(_, body):
                return self.formula(body, _flip(sign))
            case typed.Logic():
                return self._logic(node, sign)
            case typed.Temporal() | typed.Until():
                return self._timed(node, sign)
            case typed.Shift(span, steps, body):
                outside = node.outside if sign > 0 or node.outside is None else not node.outside
                return ir.Shift(steps, self.formula(body, sign), outside, span, weak=sign < 0)
            case typed.Edge():
                return self._edge(node, sign)
            case typed.Freeze(span, bindings, body):
                return ir.Freeze(bindings, self.formula(body, sign), span)
            case typed.Recalled(_, _, along):
                return self.formula(along, sign)
            case _:
                assert_never(node)

    def _logic(self, node: typed.Logic, sign: Sign) -> ir.Formula:
        match node.op:
            case "and" | "or":
                items = tuple(self.formula(item, sign) for item in node.items)
                return ir.BoolOp("and" if (node.op == "and") is (sign > 0) else "or", items, node.span)
            case "->":
                left, right = node.items
                parts = (self.formula(left, _flip(sign)), self.formula(right, sign))
                return ir.BoolOp("or" if sign > 0 else "and", parts, node.span)
            case "<->":
                return self._equal(node, sign)
            case "xor":
                return self._equal(node, _flip(sign))
            case _:
                assert_never(node.op)

    def _equal(self, node: typed.Logic, sign: Sign) -> ir.Formula:
        """Both implications; negated: exactly one holds."""
        left, right = node.items
        inner: Literal["and", "or"] = "or" if sign > 0 else "and"
        one = ir.BoolOp(inner, (self.formula(left, _flip(sign)), self.formula(right, sign)), node.span)
        other = ir.BoolOp(inner, (self.formula(left, sign), self.formula(right, _flip(sign))), node.span)
        return ir.BoolOp("and" if sign > 0 else "or", (one, other), node.span)

    def _timed(self, node: typed.Temporal | typed.Until, sign: Sign) -> ir.Formula:
        if on_clock(node):
            return ir.AtStart(self._timed(from_now(node), sign), node.span)
        return self._temporal(node, sign) if isinstance(node, typed.Temporal) else self._until(node, sign)

    def _temporal(self, node: typed.Temporal, sign: Sign) -> ir.Formula:
        body = self.formula(node.body, sign)
        positive = sign > 0
        match node.op:
            case "always" | "eventually":
                over = ir.Temporal(
                    "always" if (node.op == "always") is positive else "eventually", _LATER, body
                )
                return replace(over, window=self._window(node.interval, over.op), span=node.span)
            case "historically" | "once":
                past = ir.PastTemporal(
                    "historically" if (node.op == "historically") is positive else "once", _LATER, body
                )
                return replace(past, window=self._window(node.interval, past.op), span=node.span)
            case _:
                assert_never(node.op)

    def _until(self, node: typed.Until, sign: Sign) -> ir.Formula:
        if node.op == "unless":
            return self._unless(node, sign)
        left, right = self.formula(node.left, sign), self.formula(node.right, sign)
        match node.op:
            case "until" | "release":
                until = ir.Until(
                    "until" if (node.op == "until") is (sign > 0) else "release", _LATER, left, right
                )
                return replace(until, window=self._window(node.interval, until.op), span=node.span)
            case "since":
                since = ir.Since("since" if sign > 0 else "trigger", _LATER, left, right)
                return replace(since, window=self._window(node.interval, since.op), span=node.span)
            case _:
                assert_never(node.op)

    def _unless(self, node: typed.Until, sign: Sign) -> ir.Formula:
        """`always[0, b] left or left until[a, b] right`."""
        whole = replace(node.interval, lo=typed.Time(), lo_open=False)
        held = typed.Temporal(node.span, "always", whole, node.left)
        met = typed.Until(node.span, "until", node.interval, node.left, node.right)
        return self.formula(typed.Logic(node.span, "or", (held, met)), sign)

    def _edge(self, node: typed.Edge, sign: Sign) -> ir.Formula:
        """`rise`: now and not before; `fall`: before and not now; false at the first sample."""
        now = sign if node.op == "rise" else _flip(sign)
        before = ir.Shift(-1, self.formula(node.body, _flip(now)), sign < 0, node.span)
        parts = (self.formula(node.body, now), before)
        return ir.BoolOp("and" if sign > 0 else "or", parts, node.span)

    def _window(self, interval: typed.Interval, op: str) -> ir.Window:
        return to_window(interval, self.grid, self.sink, outward=op in _CAUTIOUS)


_LATER = ir.Window(0, None)
