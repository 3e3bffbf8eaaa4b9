"""Times and intervals: `2 s`, `3 steps`, `T - 1 s`, `end`."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from types import MappingProxyType

from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.values import Number, Operand, TimeExpr, Value, noun
from stlc.compile.ir import typed
from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar import ast
from stlc.grammar.words import OPERATORS
from stlc.source import Span
from stlc.units import Unit

_SECOND = Unit.SYMBOLS["s"]


TIME_WORDS = MappingProxyType(
    {
        "T": TimeExpr(horizons=Fraction(1)),
        "dt": TimeExpr(steps=Fraction(1)),
        "end": TimeExpr(end=True),
    }
)
"""Name of a built-in time -> its value."""


def combine(op: str, left: Operand, right: Operand, span: Span, scope: Scope) -> TimeExpr:
    """Return the sum or difference of two times, or a time multiplied or divided by a constant.

    Raises:
        Failed: the operator does not apply to these operands (E205), a factor is not constant (E311), or a
            divisor is 0 (E401).
    """
    if op in ("+", "-"):
        a, b = moment(*left, scope), moment(*right, scope)
        if not (a.end or b.end):
            return a.plus(b, 1 if op == "+" else -1)
    times, factor = (left, right) if isinstance(left.value, TimeExpr) else (right, left)
    if isinstance(factor.value, Number) and factor.value.constant is None:
        scope.fail(out_of_place(times.expr.span))
    if (
        op in ("*", "/")
        and isinstance(times.value, TimeExpr)
        and not times.value.end
        and not (op == "/" and times is right)
    ):
        number = factor.value
        if not isinstance(number, Number) or number.constant is None or not number.unit.dimensionless:
            message = f"a time is multiplied by a plain number, this is {noun(number)}"
            scope.fail(Diagnostic("E205", message, factor.expr.span))
        share = number.exact if number.exact is not None else Fraction(repr(number.constant))
        if op == "/" and share == 0:
            scope.fail(Diagnostic("E401", "division by zero", factor.expr.span, "is 0"))
        return times.value.times(1 / share if op == "/" else share)
    help_ = ("a bound is a sum of times, each times a plain number: `T / 2 - 1 s`",)
    return scope.fail(Diagnostic("E205", f"`{op}` does not apply to these times", span, help=help_))


def out_of_place(span: Span) -> Diagnostic:
    """Return the error E311 for `T`, `dt` or a number of steps outside of an interval or delay."""
    message = f"`{span.text}` is only known inside the interval of a temporal operator"
    return Diagnostic("E311", message, span, help=("name the time: `const tau = 2 s`",))


def negative(value: TimeExpr, span: Span, scope: Scope) -> TimeExpr:
    """Return the time with its sign reversed.

    Raises:
        Failed: the time is `end` (E205).
    """
    if value.end:
        scope.fail(Diagnostic("E205", "`end` has no sign", span))
    return value.times(Fraction(-1))


def moment(expr: ast.Expr, value: Value, scope: Scope) -> TimeExpr:
    """Return a value as a time.

    Raises:
        Failed: the value is not constant (E303), has another unit (E203), or is not a number (E205).
    """
    if isinstance(value, TimeExpr):
        return value
    if not isinstance(value, Number) or value.kind in ("bool", "enum"):
        scope.fail(Diagnostic("E205", f"an interval bound is a time, this is {noun(value)}", expr.span))
    if value.constant is None:
        scope.fail(_not_constant(expr, value, scope))
    exact = value.exact if value.exact is not None else Fraction(repr(value.constant))
    if value.bare:
        return _bare(exact, expr, scope)
    if value.unit.dims != _SECOND.dims and not value.flexible:
        scope.fail(Diagnostic("E203", f"an interval bound is a time, this is [{value.unit}]", expr.span))
    return TimeExpr(exact, span=expr.span)


def _bare(value: Fraction, expr: ast.Expr, scope: Scope) -> TimeExpr:
    """Return a number without a unit as a time, in the unit given by `time UNIT`, else in seconds.

    If the file has no `time UNIT`, W101 is reported for a number other than 0.
    """
    if scope.time_unit in ("step", "steps"):
        return TimeExpr(steps=value, span=expr.span)
    if not scope.time_unit and value != 0:
        fix = Fix(((expr.span, f"{expr.span.text} s"),), f"write `{expr.span.text} s`")
        help_ = ("say the unit, or set it for the whole file: `time s`",)
        scope.report(
            Diagnostic(
                "W101",
                "a bare number as an interval bound",
                expr.span,
                "taken as seconds",
                help=help_,
                fix=fix,
            )
        )
    ratio = Unit.parse(scope.time_unit).ratio if scope.time_unit else Fraction(1)
    return TimeExpr(value * ratio, span=expr.span)


def _not_constant(expr: ast.Expr, value: Number, scope: Scope) -> Diagnostic:
    entry = scope.entries.get(expr.name) if isinstance(expr, ast.Name) else None
    sampled = entry is not None and entry.about.startswith("param")
    label = "a parameter that is sampled per trajectory" if sampled else "changes along the trajectory"
    text = expr.span.text
    labels = (
        ()
        if value.origin is None or value.origin.span is None
        else (value.origin.span.label("declared here"),)
    )
    return Diagnostic(
        "E303",
        "an interval bound must be known at compile time",
        expr.span,
        label,
        labels,
        help=(
            f"use a timer state instead:  always[0, T] (near or tau <= 0)   with tau := {text} at the start",
            f"or fix it:  const {text} = 2 s",
        ),
    )


def interval(
    node: ast.Interval | None,
    bounds: Sequence[Value],
    op: str,
    place: Span,
    body: ast.Expr,
    scope: Scope,
) -> typed.Interval:
    """Return the interval of a temporal operator, checked as far as possible without a time step.

    Args:
        node: interval in the source; None if there is none, which means from now to the end.
        bounds: values of the two bounds.
        op: name of the operator.
        place: source location of the operator.
        body: operand of the operator, which an error message repeats in its hint.
        scope: receives findings.

    Raises:
        Failed: the interval ends before it starts (E301), begins before now (E302), is not constant (E303),
            or has a bound that is not a time (E203).
    """
    if node is None:
        return typed.Interval(typed.Time(), None, span=place)
    low, high = moment(node.lo, bounds[0], scope), moment(node.hi, bounds[1], scope)
    if low.end:
        scope.fail(Diagnostic("E303", "an interval cannot start at the end of the trace", node.lo.span))
    if sign(low) < 0 or (not high.end and sign(high) < 0):
        scope.fail(_negative(op, node, (low, high), body))
    if not high.end and sign(high.plus(low, -1)) < 0:
        first, last = node.lo.span, node.hi.span
        fix = Fix(((first, last.text), (last, first.text)), f"write `[{last.text}, {first.text}]`")
        label = f"{first.text} > {last.text}"
        message = "the interval ends before it starts"
        scope.fail(Diagnostic("E301", message, first.to(last), label, fix=fix))
    lo, hi = low.on(low.span), None if high.end else high.on(high.span)
    return typed.Interval(lo, hi, node.lo_open, node.hi_open, node.clock, node.span)


def sign(value: TimeExpr) -> int:
    """Return -1 if a time is negative for every time step and horizon, 0 if it is zero, else 1.

    A time such as `T - 1 s`, whose sign depends on the horizon, gives 1.
    """
    parts = (value.seconds, value.steps, value.horizons)
    if all(part <= 0 for part in parts):
        return -1 if any(parts) else 0
    return 1


def _negative(name: str, node: ast.Interval, ends: tuple[TimeExpr, TimeExpr], body: ast.Expr) -> Diagnostic:
    low, high = ends
    bound = node.lo if sign(low) < 0 else node.hi
    if OPERATORS[name].past:
        help_ = (f"bounds of `{name}` count backwards already: write them without the sign",)
        return Diagnostic(
            "E302", "a bound of a past operator is a length of time, never negative", bound.span, help=help_
        )
    mirror = OPERATORS[name].mirror
    plain = all(not end.end and sign(end) <= 0 for end in ends)
    hints: tuple[str, ...] = ()
    if mirror and plain and not OPERATORS[name].binary:
        near, far = _shown(high, node.hi), _shown(low, node.lo)
        hints = (f"{mirror}[{near}, {far}] {body.span.text}   looks back",)
    elif mirror:
        hints = (f"`{mirror}` looks back",)
    return Diagnostic("E302", "a future operator cannot look into the past", bound.span, help=hints)


def _shown(value: TimeExpr, expr: ast.Expr) -> str:
    """Return the source text of `expr`, an interval bound with the value `value`.

    If `value` is negative, the minus sign is removed from the text.
    """
    text = expr.span.text.strip()
    return text.removeprefix("-").strip() if sign(value) < 0 else text
