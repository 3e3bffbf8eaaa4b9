"""Evaluation of expressions in system files and declarations to numbers, state formulas and regions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from stlc.compile.frontend.arithmetic import difference_for_point, in_unit, rebased
from stlc.compile.frontend.coerce import Expectation, as_formula, loose_number, require_unit
from stlc.compile.frontend.evaluate import evaluate
from stlc.compile.frontend.scope import Failed, Scope
from stlc.compile.frontend.values import (
    REGION_TYPES,
    EnumMember,
    Number,
    Region,
    Value,
    VectorValue,
    describe,
    noun,
)
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.normal_form import condition
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.signature import Column
from stlc.units import Unit, nearest


@contextmanager
def _raising(scope: Scope) -> Iterator[None]:
    """Context for the evaluation of one expression.

    If the evaluation fails, an exception of the class `scope.error` is raised, with the errors found.
    """
    before = len(scope.sink)
    try:
        with scope.meter.fresh():
            yield
    except Failed:
        raise scope.error(*(f for f in scope.sink[before:] if f.severity == "error")) from None


def resolve_state_formula(expr: ast.Expr, scope: Scope, *, what: str = "a condition") -> ir.Formula:
    """Return an expression as a state formula, whose truth depends on one instant.

    The result is in negation normal form.

    Args:
        expr: syntax tree of the expression.
        scope: names that the expression may use; findings are appended to `scope.sink`.
        what: role of the formula, for messages: "a guard".

    Raises:
        StlcError: of class `scope.error`, with the findings.
    """
    with _raising(scope):
        value = evaluate(expr, scope)
        fits = isinstance(value, typed.Formula) or (isinstance(value, Number) and value.kind == "bool")
        if not fits and not scope.in_spec:
            help_ = (f"`{expr.span.text} > 0`",) if isinstance(value, Number) and not value.labels else ()
            message = f"{what} must be a formula, this is {noun(value)}"
            scope.fail(Diagnostic("S203", message, expr.span, describe(value), help=help_))
        formula = as_formula(value, expr, Expectation(what), scope)
        if not formula.is_state():
            scope.fail(Diagnostic("E202", f"{what} speaks about one instant", expr.span, "temporal"))
        return condition(formula)


def resolve_region(expr: ast.Expr, scope: Scope) -> Region:
    """Return an expression as a region.

    Raises:
        StlcError: of class `scope.error`, with the findings.
    """
    with _raising(scope):
        value = evaluate(expr, scope)
        if not isinstance(value, REGION_TYPES):
            scope.fail(Diagnostic("E205", f"a region is needed, this is {noun(value)}", expr.span))
        return value


def resolve_formula(expr: ast.Expr, scope: Scope, *, what: str = "a requirement") -> typed.Formula:
    """Return an expression as a formula.

    Temporal operators are allowed if `scope.temporal` is True. `what` is the role of the formula, for
    messages.

    Raises:
        Failed: the expression has errors, which are in `scope.sink`.
    """
    with scope.meter.fresh():
        return as_formula(evaluate(expr, scope), expr, Expectation(what), scope)


def resolve_number(
    expr: ast.Expr, scope: Scope, *, expected: Column | None = None, what: str = "a value"
) -> Number:
    """Return the value of an expression as one number.

    The number is in SI units, but counted from the zero of its own unit: 20 degC is 20, not 293.15.

    Args:
        expr: syntax tree of the expression.
        scope: names that the expression may use; findings are appended to `scope.sink`.
        expected: column that stores the number, if any. The expression may then use the members of the
            column's enum. `true` is 1, and a formula is 1 where it holds. A number without a unit takes the
            unit of the column. A unit of other dimensions is the error E203.
        what: role of the number, for messages: "the flow of `x`".

    Raises:
        StlcError: of class `scope.error`, with the findings.
    """
    numbers = resolve_numbers(expr, scope, expected=expected, what=what)
    if len(numbers) == 1:
        return numbers[0]
    finding = Diagnostic(
        scope.sort_error, f"{what} is one number, this is a vector of {len(numbers)}", expr.span
    )
    scope.report(finding)
    raise scope.error(finding)


def resolve_numbers(
    expr: ast.Expr, scope: Scope, *, expected: Column | None = None, what: str = "a value"
) -> tuple[Number, ...]:
    """Return the components of a vector expression; a number is a vector of one component.

    Arguments and errors are those of `resolve_number`.
    """
    with _raising(scope):
        value = evaluate(expr, scope)
        items: tuple[Value, ...] = value.items if isinstance(value, VectorValue) else (value,)
        return tuple(_stored_value(item, expr, expected, what, scope) for item in items)


def stored(number: Number, unit: Unit) -> ir.Num:
    """Return a number as a column in `unit` stores it: for km/h, the number 20 m/s is stored as 72."""
    number = rebased(number, unit)
    if unit.ratio == 1:
        return number.num
    value = number.constant
    if value is None:
        return number.num / unit.scale
    return ir.Const(nearest(number.exact / unit.ratio) if number.exact is not None else value / unit.scale)


def _stored_value(value: Value, expr: ast.Expr, column: Column | None, what: str, scope: Scope) -> Number:
    """Convert a value to the number that `column` stores.

    If `column` is None, the value becomes a number in any unit. For a bool column, a formula becomes the
    number 1 where it holds, else 0.

    Raises:
        Failed: the value has a type (E202, E205, S203) or unit (E203) that does not fit the column.
    """
    if column is not None and column.kind == "bool" and isinstance(value, typed.Formula) and value.is_state():
        cond = condition(value)
        truth = cond.indicator() if cond.constant is None else ir.Const(float(cond.constant))
        return Number(truth, kind="bool", span=expr.span)
    if column is not None and column.labels and isinstance(value, EnumMember):
        known = dict(column.labels)
        if value.name not in known:
            names = ", ".join(f"`{name}`" for name in known)
            message = f"`{value.name}` is not a member of the enum of `{column.name}`"
            scope.fail(Diagnostic("E205", message, expr.span, help=(f"its members are {names}",)))
        return Number(ir.Const(known[value.name]), kind="enum", labels=column.labels, span=expr.span)
    if isinstance(value, typed.Formula) and not isinstance(value, typed.Truth) and not scope.in_spec:
        help_ = (f"`ind({expr.span.text})` is 1 where it holds and 0 elsewhere",) if value.is_state() else ()
        scope.fail(
            Diagnostic(
                "S203", f"{what} must be a number, this is a formula", expr.span, "formula", help=help_
            )
        )
    number = loose_number(value, expr, Expectation(f"{what} is a number"), scope)
    return number if column is None else _fitted(number, expr, column, scope)


def _fitted(number: Number, expr: ast.Expr, column: Column, scope: Scope) -> Number:
    """Return a number after checking its type and unit against a column.

    A number without a unit takes the unit of the column.

    Raises:
        Failed: the number has another type (E205, S203) or another unit (E203).
    """
    values = [value for _, value in column.labels] if column.labels else [0.0, 1.0]
    if column.kind in ("bool", "enum"):
        fits = (number.kind == column.kind and number.labels == column.labels) or number.constant in values
        if not fits and number.kind != "int":
            names = ", ".join(f"`{name}`" for name, _ in column.labels) or "`true` and `false`"
            message = f"`{column.name}` is one of {names}, this is {noun(number)}"
            scope.fail(Diagnostic(scope.sort_error, message, expr.span))
        return replace(number, kind=column.kind, labels=column.labels)
    if number.kind == "enum":
        scope.fail(
            Diagnostic(scope.sort_error, f"`{column.name}` is a number, this is an enum member", expr.span)
        )
    if number.bare:
        return in_unit(number, column.unit, scope)
    require_unit(number, column, expr, scope)
    if column.unit.offset and number.sense == "difference":
        scope.fail(difference_for_point(number, column.unit, expr.span))
    return number
