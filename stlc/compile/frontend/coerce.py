"""Conversion of values to the type that their place in an expression requires."""

from __future__ import annotations

from dataclasses import dataclass, replace

from stlc.compile.frontend.arithmetic import apply, half
from stlc.compile.frontend.intervals import out_of_place
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.values import EnumMember as Member
from stlc.compile.frontend.values import Number, TimeExpr, Value, VectorValue, describe, noun
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.normal_form import condition
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.signature import Column
from stlc.source import Span


@dataclass(frozen=True, slots=True)
class Expectation:
    """Description of the value that an operator or function needs, as texts for error messages.

    Attributes:
        who: the operator or function, with its verb: "`+` adds numbers", "`always` needs a formula".
        which: role of the value: "the right side", "argument 2", "this".
        span: source location of the operator, for a second label in the message.
    """

    who: str
    which: str = "this"
    span: Span | None = None


def as_number(value: Value, expr: ast.Expr, need: Expectation, scope: Scope) -> Number:
    """Return a value as a number; a member of an enum becomes the number that stands for the member.

    Raises:
        Failed: the value is a formula or a bool (E202), a time that is known only in an interval (E311),
            or anything else that is not a number (E205).
    """
    match value:
        case Number(kind="bool"):
            help_ = (f"`ind({expr.span.text})` is 1 where it holds and 0 elsewhere",)
            message = f"{need.who}; {need.which} is true or false"
            return scope.fail(Diagnostic("E202", message, expr.span, "bool", help=help_))
        case Number():
            return value
        case Member():
            return member_number(value, expr.span, scope)
        case typed.Formula():
            return scope.fail(_formula_for_number(value, expr, need))
        case TimeExpr():
            if value.end:
                message = f"`{expr.span.text}` is only known as the end of an interval"
                scope.fail(Diagnostic("E205", message, expr.span))
            return scope.fail(out_of_place(expr.span))
        case _:
            message = f"{need.who}; {need.which} is {noun(value)}"
            return scope.fail(Diagnostic("E205", message, expr.span, describe(value)))


def loose_number(value: Value, expr: ast.Expr, need: Expectation, scope: Scope) -> Number:
    """Return a value as a number; unlike in `as_number`, a bool is allowed and counts as 0 or 1.

    Raises:
        Failed: the value is a formula other than `true` and `false` (E202), or anything else that is not a
            number (E205).
    """
    match value:
        case Number():
            return value
        case typed.Truth(_, truth):
            return Number(ir.Const(float(truth)), kind="bool", span=expr.span)
        case _:
            return as_number(value, expr, need, scope)


def as_formula(value: Value, expr: ast.Expr, need: Expectation, scope: Scope) -> typed.Formula:
    """Return a value as a formula; a bool signal `b` becomes the formula `b >= 1/2`.

    Raises:
        Failed: the value is neither a formula nor a bool (E201).
    """
    match value:
        case Number(formula=formula) if formula is not None:
            return formula
        case Number(kind="bool") as number:
            margin = apply("sub", (replace(number, kind="real"), half(expr.span)), expr.span, scope)
            return typed.Predicate(expr.span, margin.num, strict=False)
        case typed.Formula():
            return value
        case _:
            labels = () if need.span is None else (need.span.label("wants something that is true or false"),)
            message = f"{need.who} needs a formula, {need.which} is {noun(value)}"
            help_ = _as_comparison(value, expr)
            return scope.fail(Diagnostic("E201", message, expr.span, describe(value), labels, help=help_))


def as_state_formula(value: Value, expr: ast.Expr, need: Expectation, scope: Scope) -> ir.Formula:
    """Return a value as a state formula: a formula whose truth depends on one instant only.

    The result is in negation normal form: negations are pushed down to the predicates.

    Raises:
        Failed: the value is not a formula (E201), or its truth depends on several instants (E202).
    """
    formula = as_formula(value, expr, need, scope)
    if not formula.is_state():
        message = f"{need.who}, but this looks at other times"
        note = ("a temporal operator has no numeric form in a predicate",)
        scope.fail(Diagnostic("E202", message, expr.span, "temporal", note=note))
    return condition(formula)


def as_vector(value: Value, expr: ast.Expr, need: Expectation, scope: Scope) -> VectorValue:
    """Return a value that must be a vector of numbers.

    Raises:
        Failed: the value is not a vector (E205).
    """
    if isinstance(value, VectorValue):
        return value
    message = f"{need.who}; {need.which} is {noun(value)}"
    return scope.fail(Diagnostic("E205", message, expr.span, describe(value)))


def require_unit(number: Number, column: Column, expr: ast.Expr, scope: Scope) -> None:
    """Check that a number, the value of `expr`, has the unit of a column up to a factor.

    Raises:
        Failed: it has another unit (E203).
    """
    if not number.flexible and column.unit.text and not number.unit.same_dims(column.unit):
        message = f"`{column.name}` is in [{column.unit}], this is in [{number.unit}]"
        scope.fail(Diagnostic("E203", message, expr.span, f"[{number.unit}]"))


def member_number(member: Member, span: Span, scope: Scope) -> Number:
    """Return the number that stands for an enum member.

    Raises:
        Failed: the member belongs to several enums, which give it different numbers (E101).
    """
    values = {dict(labels)[member.name] for labels in member.options}
    if len(values) > 1:
        message = f"`{member.name}` is a member of several enums, with different values"
        scope.fail(Diagnostic("E101", message, span, help=("compare it with a signal of the enum you mean",)))
    labels = member.options[0]
    return Number(ir.Const(float(values.pop())), kind="enum", labels=labels, span=span)


def _as_comparison(value: Value, expr: ast.Expr) -> tuple[str, ...]:
    text = expr.span.text
    match value, expr:
        case Number(kind="enum", labels=labels), _:
            return (f"did you mean `{text} == {labels[0][0]}`?",)
        case Number(), ast.Binary(op="-", left=left, right=right):
            return (f"did you mean `{text} > 0` or `{left.span.text} > {right.span.text}`?",)
        case Number(), _:
            return (f"did you mean `{text} > 0`?",)
        case VectorValue(), _:
            return ("compare one component, its `norm`, or use `in` with a region",)
        case _:
            return ()


def _formula_for_number(value: typed.Formula, expr: ast.Expr, need: Expectation) -> Diagnostic:
    message = f"{need.who}; {need.which} is a formula"
    if value.is_state():
        help_ = (f"`ind({expr.span.text})` is 1 where it holds and 0 elsewhere",)
    else:
        help_ = (
            "`ind(phi)` is 1 where phi holds and 0 otherwise;"
            " a temporal operator has no numeric form in a predicate",
        )
    return Diagnostic("E202", message, expr.span, "formula", help=help_)
