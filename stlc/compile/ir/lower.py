"""Lowering (translation) of typed formulas to the intermediate representation (IR), with time in steps.

In training all margins are in SI, so that requirements are comparable. For recorded traces, margins are in
the units of the source: each predicate is divided by the scale of its unit. For example, the margin of
`speed < 120 km/h` is then in km/h. Signs do not change.

First each `not` is moved inwards (negation normal form). This matters for bounds that lie between two
samples, since their rounding depends on the operator. For example, `not always[0, b] p` becomes
`eventually[0, b] not p`, whose bound is rounded inwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.functions import FUNCTIONS
from stlc.compile.ir.nodes import DUAL, OPERATORS
from stlc.compile.ir.normal_form import literal, normal
from stlc.diagnostics import Diagnostic
from stlc.units import Unit

if TYPE_CHECKING:
    from stlc.compile.ir.discretize import Grid


def as_written(requirement: typed.Requirement) -> typed.Requirement:
    """Return a requirement with margins in the units of the source.

    If all predicates of the requirement have the same unit, the divisor of `@scale` is converted to this unit
    as well.
    """
    formula, scale = requirement.formula, requirement.scale
    units = [node.written for node in formula.walk() if isinstance(node, typed.Predicate) and not node.guard]
    alike = all(unit.same_dims(units[0]) and unit.ratio == units[0].ratio for unit in units)
    if units and alike and scale != 1:
        scale /= units[0].scale
    return replace(requirement, formula=_in_written_units(formula), scale=scale)


def _in_written_units(formula: typed.Formula) -> typed.Formula:
    if isinstance(formula, typed.Predicate):
        return replace(formula, num=in_unit(formula.num, formula.written), unit=formula.written)
    return formula.map_children(formulas=_in_written_units)


def in_unit(num: ir.Num, unit: Unit) -> ir.Num:
    """Convert the expression `num` from SI to `unit`; signals stored in `unit` are read as they are."""
    if unit.ratio == 1:
        return num
    match num:
        case ir.Const(value):
            found = value / unit.scale
            short = float(f"{found:.14g}")  # 120, not 120.00000000000001
            return ir.Const(short if math.isclose(short, found, rel_tol=1e-15) else found)
        case ir.Op("mul", (inner, ir.Const(factor))) if factor == unit.scale:
            return inner
        case ir.Op(name, args) if FUNCTIONS[name].linear:
            return replace(num, args=tuple(in_unit(arg, unit) for arg in args))
        case ir.Where():
            return replace(num, yes=in_unit(num.yes, unit), no=in_unit(num.no, unit))
        case _:
            return num / unit.scale


def lower(formula: typed.Formula, grid: Grid, sink: list[Diagnostic]) -> ir.Formula:
    """Lower a typed formula to an IR formula in negation normal form, with time in steps.

    The interval of an operator such as `always@[a, b]` counts from the first sample. In training there is no
    such operator, since `stlc.compile.augment` has replaced it. Findings about intervals are appended to
    `sink`, such as W304 for a bound that is rounded to a sample. If a finding is an error, the result must
    not be used.
    """
    return _Lowering(grid, sink).formula(normal(formula))


def _meaning(node: typed.Edge | typed.Recalled) -> typed.Formula:
    """Return the formula that defines the operator `node`.

    For example, `rise(p)` is `p and prev(not p)`, where `prev(not p)` is false at the first sample. For a
    past operator that was rewritten with timers (`Recalled`), the formula is `node.along`.
    """
    if isinstance(node, typed.Recalled):
        return node.along
    span, inverse = node.span, typed.Not(node.span, node.body)
    now, before = (node.body, inverse) if node.op == "rise" else (inverse, node.body)
    return typed.Logic(span, "and", (now, typed.Shift(span, -1, before, outside=False)))


@final
@dataclass(frozen=True, slots=True)
class _Lowering:
    grid: Grid
    sink: list[Diagnostic]

    def formula(self, node: typed.Formula) -> ir.Formula:
        """Lower a formula in negation normal form."""
        match node:
            case typed.Truth(span, value):
                return ir.Truth(value, span)
            case typed.Predicate() | typed.Not(_, typed.Predicate()):
                return literal(node)
            case typed.Not(_, body):
                return self._negated(body)
            case typed.Logic(span, "and" | "or" as op, items):
                return ir.BoolOp(op, tuple(map(self.formula, items)), span)
            case typed.Shift(span, steps, body, outside):
                return ir.Shift(steps, self.formula(body), outside, span)
            case typed.Freeze(span, bindings, body):
                return ir.Freeze(bindings, self.formula(body), span)
            case typed.Temporal() | typed.Until():
                return self._timed(node, node.op)
            case typed.Edge() | typed.Recalled():
                return self.formula(normal(_meaning(node)))
            case _:
                raise AssertionError("not in negation normal form")

    def _negated(self, node: typed.Formula) -> ir.Formula:
        """Lower the negation of `node`, an operator before which negation normal form keeps a `not`.

        This is `until`, a shift in time, `rise`, `fall`, or a past operator that was rewritten with timers.
        """
        match node:
            case typed.Until(_, op, _, left, right):
                return self._timed(replace(node, left=normal(left, -1), right=normal(right, -1)), DUAL[op])
            case typed.Shift(span, steps, body, outside):
                filled = None if outside is None else not outside
                return ir.Shift(steps, self.formula(normal(body, -1)), filled, span, weak=True)
            case typed.Edge() | typed.Recalled():
                return self.formula(normal(_meaning(node), -1))
            case _:
                raise AssertionError("not in negation normal form")

    def _timed(self, node: typed.Temporal | typed.Until, op: str) -> ir.Formula:
        """Lower a temporal operator as `op`: the operator itself or, if it is negated, its dual."""
        if node.on_clock:
            return ir.AtStart(self._timed(node.from_now(), op), node.span)
        parts = [self.formula(part) for part in node.operands]
        window = self.grid.window(node.interval, self.sink, outward=op == OPERATORS[op].names[0])
        lowered: ir.Formula = OPERATORS[op](op, window, *parts, node.span)
        return lowered
