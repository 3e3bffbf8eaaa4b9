"""Calls that look at other samples: `next prev rise fall shift delta sweep`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from stlc.compile.frontend.bounds import in_steps, in_words
from stlc.compile.frontend.intervals import moment
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.sorts import Need, as_formula, as_number
from stlc.compile.frontend.values import Moment, Number, Swept, Value, Vector
from stlc.compile.frontend.vectors import broadcast
from stlc.compile.ir import typed
from stlc.compile.ir.traverse import shifted
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.source import Span
from stlc.units import SYMBOLS, same_dims

_SECOND = SYMBOLS["s"]
_MOST = 1_000_000
"""How many samples `shift` may be away."""


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
    steps = {"next": 1, "prev": -1}.get(name)
    if steps is None:
        steps = _steps(values[1], call.args[1].value, scope)
    return _shifted(value, steps, (expr, call.span), f"`{name}`", scope)


def _shifted(value: Value, steps: int, places: tuple[ast.Expr, Span], name: str, scope: Scope) -> Value:
    """A number, a vector or a formula `steps` samples later."""
    expr, span = places
    match value:
        case Number() if value.kind != "bool":
            return replace(value, num=shifted(value.num, steps), origin=None)
        case Vector(items):
            return Vector(tuple(_later(item, steps, span) for item in items), span)
        case _:
            return typed.Shift(span, steps, as_formula(value, expr, Need(name), scope))


def _later(number: Number, steps: int, span: Span) -> Number:
    """A component `steps` samples later; of a choice between bools the formula as well."""
    formula = None if number.formula is None else typed.Shift(span, steps, number.formula)
    return replace(number, num=shifted(number.num, steps), formula=formula)


def _delta(value: Value, expr: ast.Expr, span: Span, scope: Scope) -> Value:
    """What changed since the sample before."""
    now = value if isinstance(value, Vector) else as_number(value, expr, Need("`delta` takes numbers"), scope)
    before = _shifted(now, -1, (expr, span), "`delta`", scope)
    assert isinstance(before, Number | Vector)
    return broadcast("sub", (now, before), span, scope)


def _vector(value: Value, expr: ast.Expr, need: Need, scope: Scope) -> Vector:
    if isinstance(value, Vector):
        return value
    return Vector((as_number(value, expr, need, scope),), expr.span)


def _steps(value: Value, expr: ast.Expr, scope: Scope) -> int:
    """A number of samples: `3`, `-1`, `3 steps`, or a time that is a whole number of steps: `0.1 s`.

    Raises Failed: E205 where it is none, E311 where nobody says how long a step is.
    """
    match value:
        case Moment(end=False):
            exact = _on_grid(value, expr, scope)
        case Number(bare=True, exact=known) if known is not None:
            exact = known
        case Number(bare=False, flexible=False) if value.constant is not None and same_dims(
            value.unit, _SECOND
        ):
            exact = _on_grid(moment(expr, value, scope), expr, scope)
        case _:
            return scope.fail(
                _no_steps("`shift` goes a whole number of samples, known at compile time", expr)
            )
    if exact.denominator != 1:
        return scope.fail(_off_grid(exact, expr, scope))
    if abs(exact) > _MOST:
        return scope.fail(_no_steps(f"`shift` goes {_MOST:,} samples at most", expr))
    return int(exact)


def _on_grid(time: Moment, expr: ast.Expr, scope: Scope) -> Fraction:
    """A time in steps; any whole number where nobody asks."""
    if scope.grid is None:
        return time.steps if not (time.seconds or time.horizons) else Fraction(1)
    found: list[Diagnostic] = []
    steps = in_steps(
        typed.Time(time.seconds, time.steps, time.horizons, expr.span), scope.grid, found, expr.span
    )
    return steps if steps is not None else scope.fail(found[0])


def _off_grid(exact: Fraction, expr: ast.Expr, scope: Scope) -> Diagnostic:
    """E205: between two samples, with the times of both."""
    if scope.grid is None or scope.grid.dt is None:
        return _no_steps("`shift` goes a whole number of samples, known at compile time", expr)
    low, high = (in_words(Fraction(n), scope.grid) for n in (math.floor(exact), math.ceil(exact)))
    message = f"{in_words(exact, scope.grid)} is not a whole number of {float(scope.grid.dt):g} s steps"
    label = "there is no sample at this time"
    return Diagnostic("E205", message, expr.span, label, help=(f"use {low} or {high}, or a dt that fits",))


def _no_steps(message: str, expr: ast.Expr) -> Diagnostic:
    help_ = ("shift(x, 2) is x two samples later, shift(x, -0.1 s) what it was a tenth of a second before",)
    return Diagnostic("E205", message, expr.span, help=help_)
