"""Conjunctions that nothing satisfies: bounds of one quantity that leave no room, `x > 1 and x < 0.5`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.traverse import nodes
from stlc.diagnostics import Diagnostic, Label
from stlc.source import Span

_TOLERANCE = 1e-6


def contradictions(formula: typed.Formula) -> Iterator[Diagnostic]:
    """W505 for each conjunction in a formula that is false whatever the signals are."""
    told: set[Span] = set()
    for node in nodes(formula):
        if isinstance(node, typed.Logic) and node.op == "and" and node.span not in told:
            found = _contradiction(node)
            if found is not None:
                told |= {inner.span for inner in nodes(node)}
                yield found


@dataclass(slots=True)
class _Room:
    """Bounds that predicates leave of a quantity, and which of them bind."""

    low: float = -math.inf
    high: float = math.inf
    low_at: typed.Predicate | None = None
    high_at: typed.Predicate | None = None


@dataclass(frozen=True, slots=True)
class _Linear:
    """A number as a sum of parts with factors, and a constant."""

    parts: dict[ir.Num, float] = field(default_factory=dict)
    constant: float = 0.0

    def plus(self, other: _Linear, factor: float = 1.0) -> _Linear:
        parts = dict(self.parts)
        for part, its in other.parts.items():
            parts[part] = parts.get(part, 0.0) + factor * its
        return _Linear({p: f for p, f in parts.items() if f}, self.constant + factor * other.constant)


def _contradiction(node: typed.Logic) -> Diagnostic | None:
    rooms: dict[frozenset[tuple[ir.Num, float]], _Room] = {}
    for pred in _conjuncts(node):
        linear = _linear(pred.num)
        if not linear.parts or not math.isfinite(linear.constant):
            continue
        scale = next(iter(sorted(linear.parts.items(), key=lambda item: repr(item[0]))))[1]
        key = frozenset((part, factor / scale) for part, factor in linear.parts.items())
        room, bound = rooms.setdefault(key, _Room()), -linear.constant / scale
        if scale > 0 and bound > room.low:
            room.low, room.low_at = bound, pred
        if scale < 0 and bound < room.high:
            room.high, room.high_at = bound, pred
    for room in rooms.values():
        least = _TOLERANCE * max(1.0, abs(room.low), abs(room.high)) if math.isfinite(room.low) else 0.0
        if room.low_at is not None and room.high_at is not None and room.low > room.high + least:
            return Diagnostic(
                "W505",
                "this can never be true: its parts leave no room",
                node.span,
                labels=(
                    Label(room.low_at.span, "bounds it from one side"),
                    Label(room.high_at.span, "and this from the other"),
                ),
                help=("`or`, or the other comparison?",),
            )
    return None


def _conjuncts(formula: typed.Formula) -> Iterator[typed.Predicate]:
    """The predicates that all have to hold at one instant."""
    match formula:
        case typed.Predicate():
            yield formula
        case typed.Logic(_, "and", items):
            for item in items:
                yield from _conjuncts(item)
        case _:
            return


def _linear(num: ir.Num) -> _Linear:
    match num:
        case ir.Const(value):
            return _Linear(constant=value)
        case ir.Op("add", (left, right)):
            return _linear(left).plus(_linear(right))
        case ir.Op("sub", (left, right)):
            return _linear(left).plus(_linear(right), -1.0)
        case ir.Op("neg", (inner,)):
            return _Linear().plus(_linear(inner), -1.0)
        case ir.Op("mul", (ir.Const(factor), inner)) | ir.Op("mul", (inner, ir.Const(factor))):
            return _Linear().plus(_linear(inner), factor)
        case ir.Op("div", (inner, ir.Const(divisor))) if divisor:
            return _Linear().plus(_linear(inner), 1.0 / divisor)
        case _:
            return _Linear({num: 1.0})
