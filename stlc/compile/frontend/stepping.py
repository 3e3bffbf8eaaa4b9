"""Calls that look at other samples: `next prev rise fall shift delta sweep`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from stlc.compile.frontend.intervals import moment
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.sorts import Need, as_formula, as_number
from stlc.compile.frontend.values import Moment, Number, Swept, Value, Vector
from stlc.compile.frontend.vectors import broadcast
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid, delay_fault, no_delay
from stlc.compile.ir.traverse import shifted
from stlc.grammar import ast
from stlc.source import Span
from stlc.units import SYMBOLS, same_dims

_SECOND = SYMBOLS["s"]


def stepping(name: str, call: ast.Call, values: Sequence[Value], scope: Scope) -> Value:
    """`name(values)`, with as many values as it takes. Raises Failed (E201, E205)."""
    value, expr = values[0], call.args[0].value
    match name:
        case "rise":
            return typed.Edge(call.span, "rise", as_formula(value, expr, Need("`rise`"), scope))
        case "fall":
            return typed.Edge(call.span, "fall", as_formula(value, expr, Need("`fall`"), scope))
        case "sweep":
            return Swept(_vector(value, expr, Need("`sweep` follows a point"), scope), call.span)
        case "delta":
            return _delta(value, expr, call.span, scope)
    delay = typed.Time(steps=Fraction({"next": 1, "prev": -1}.get(name, 0)))
    if name == "shift":
        delay = _delay(values[1], call.args[1].value, scope)
    return _shifted(value, delay, (expr, call.span), f"`{name}`", scope)


def _shifted(
    value: Value, delay: typed.Time, places: tuple[ast.Expr, Span], name: str, scope: Scope
) -> Value:
    """A number, a vector or a formula some time later."""
    expr, span = places
    match value:
        case Number() if value.kind != "bool":
            return replace(value, num=_number(value.num, delay), origin=None)
        case Vector(items):
            return Vector(tuple(_later(item, delay, span) for item in items), span)
        case _:
            return _formula(as_formula(value, expr, Need(name), scope), delay, span)


def _number(num: ir.Num, delay: typed.Time) -> ir.Num:
    if delay.seconds or delay.horizons:
        return shifted(num, 0, delay=delay)
    return shifted(num, int(delay.steps))


def _formula(formula: typed.Formula, delay: typed.Time, span: Span) -> typed.Formula:
    if delay.seconds or delay.horizons:
        return typed.Shift(span, 1, formula, delay=delay)
    return typed.Shift(span, int(delay.steps), formula)


def _later(number: Number, delay: typed.Time, span: Span) -> Number:
    """A component some time later; of a choice between bools the formula as well."""
    formula = None if number.formula is None else _formula(number.formula, delay, span)
    return replace(number, num=_number(number.num, delay), formula=formula)


def _delta(value: Value, expr: ast.Expr, span: Span, scope: Scope) -> Value:
    """What changed since the sample before."""
    now = value if isinstance(value, Vector) else as_number(value, expr, Need("`delta` takes numbers"), scope)
    before = _shifted(now, typed.Time(steps=Fraction(-1)), (expr, span), "`delta`", scope)
    assert isinstance(before, Number | Vector)
    return broadcast("sub", (now, before), span, scope)


def _vector(value: Value, expr: ast.Expr, need: Need, scope: Scope) -> Vector:
    if isinstance(value, Vector):
        return value
    return Vector((as_number(value, expr, need, scope),), expr.span)


def _delay(value: Value, expr: ast.Expr, scope: Scope) -> typed.Time:
    """A number of samples, `3`, `-1`, `3 steps`, or a time, which the grid will count in samples: `0.1 s`.

    Raises Failed: E205 where it is none.
    """
    match value:
        case Moment(end=False):
            time = typed.Time(value.seconds, value.steps, value.horizons, expr.span)
        case Number(bare=True, exact=known) if known is not None:
            time = typed.Time(steps=known, span=expr.span)
        case Number(bare=False, flexible=False) if value.constant is not None and same_dims(
            value.unit, _SECOND
        ):
            found = moment(expr, value, scope)
            time = typed.Time(found.seconds, found.steps, found.horizons, expr.span)
        case _:
            message = "`shift` goes a whole number of samples, known at compile time"
            return scope.fail(no_delay(message, expr.span))
    if not (time.seconds or time.horizons):
        finding = delay_fault(time.steps, expr.span, Grid())
        if finding is not None:
            scope.fail(finding)
    return time
