"""Expressions that depend on the values of their parts alone: literals, arithmetic, comparisons, choices."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from types import MappingProxyType
from typing import Any

from stlc.compile.frontend import comparisons
from stlc.compile.frontend import intervals as moments
from stlc.compile.frontend.algebra import refuse_point, too_large
from stlc.compile.frontend.calls import unsupported
from stlc.compile.frontend.choices import choose
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.sorts import Need, as_number
from stlc.compile.frontend.values import Moment, Number, Swept, Value, Vector, literal
from stlc.compile.frontend.vectors import broadcast, negate
from stlc.compile.ir import typed
from stlc.compile.ir.functions import OPERATORS
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.source import Span
from stlc.units import nearest, parse_unit

_VERBS = {"+": "adds", "-": "subtracts", "*": "multiplies", "/": "divides", "%": "divides", "^": "raises"}


@dataclass(frozen=True, slots=True)
class Operation:
    """How a kind of node is valued: its parts, in order, and what their values make."""

    parts: Callable[[Any], Sequence[ast.Expr]]
    value: Callable[[Any, Sequence[Value], Scope], Value]


def _quantity(expr: ast.Quantity, _values: Sequence[Value], scope: Scope) -> Value:
    if not expr.unit:
        return literal(expr.value, expr.span)
    if expr.unit in ("step", "steps"):
        if not scope.in_spec:
            scope.fail(unsupported("a number of steps", expr.span, scope))
        return Moment(steps=expr.value, span=expr.span)
    try:
        number = _measured(expr.value, expr.unit)
    except ValueError as error:
        scope.fail(Diagnostic("E203", str(error), expr.span))
    if number is None:
        scope.fail(too_large(expr.span))
    return replace(number, span=expr.span)


@lru_cache(maxsize=256)
def _measured(value: Fraction, unit_text: str) -> Number | None:
    """A number with a unit, from its zero; None: too large for a float. Raises ValueError: no such unit."""
    unit = parse_unit(unit_text)
    exact = value * unit.ratio
    if not math.isfinite(nearest(exact)):
        return None
    return replace(literal(exact), unit=unit, flexible=False, bare=False, kind="real")


def _bool(expr: ast.Bool, _values: Sequence[Value], _scope: Scope) -> Value:
    return typed.Truth(expr.span, expr.value)


def _string(expr: ast.String, _values: Sequence[Value], scope: Scope) -> Value:
    return scope.fail(Diagnostic("E205", "a text has no value here", expr.span))


def _inf(expr: ast.Inf, _values: Sequence[Value], _scope: Scope) -> Value:
    return Moment(end=True, span=expr.span)


def _vector(expr: ast.Vector, values: Sequence[Value], scope: Scope) -> Value:
    need = Need("a vector holds numbers", "this component")
    pairs = zip(values, expr.items, strict=True)
    return Vector(tuple(as_number(value, item, need, scope) for value, item in pairs), expr.span)


def _index(expr: ast.Index, values: Sequence[Value], scope: Scope) -> Value:
    base, index = values
    if not isinstance(base, Vector):
        scope.fail(Diagnostic("E205", "only a vector has components", expr.base.span))
    number = as_number(index, expr.index, Need("an index is a whole number"), scope)
    value = number.constant
    if value is None or value != int(value):
        message = "an index is a whole number that is known at compile time"
        scope.fail(Diagnostic("E205", message, expr.index.span))
    if not 0 <= value < len(base.items):
        last = len(base.items) - 1
        message = f"index {int(value)} is outside the vector: it has components 0 to {last}"
        scope.fail(Diagnostic("E205", message, expr.index.span))
    return base.items[int(value)]


def _neg(expr: ast.Neg, values: Sequence[Value], scope: Scope) -> Value:
    (value,) = values
    if isinstance(value, Moment):
        return moments.negative(value, expr.span, scope)
    if not isinstance(value, Vector):
        value = as_number(value, expr.operand, Need("`-` takes a number"), scope)
    if not isinstance(expr.operand, ast.Quantity):  # -5 degC is below zero; a temperature has no negation
        for item in value.items if isinstance(value, Vector) else (value,):
            refuse_point("`-`", item, expr.operand.span, scope)
    return negate(value, expr.span)


def _binary(expr: ast.Binary, values: Sequence[Value], scope: Scope) -> Value:
    left, right = values
    if isinstance(left, Moment) or isinstance(right, Moment):
        return moments.combine(expr.op, (expr.left, left), (expr.right, right), expr.span, scope)
    who = f"`{expr.op}` {_VERBS[expr.op]} numbers"
    sides: list[Number | Vector] = []
    for value, side, which in ((left, expr.left, "left"), (right, expr.right, "right")):
        if isinstance(value, Vector):
            sides.append(value)
        else:
            sides.append(as_number(value, side, Need(who, f"the {which} side"), scope))
    place = comparisons.sign_span(expr.op, expr.left.span, expr.right.span)
    _refuse_products(expr, sides, place, scope)
    return broadcast(OPERATORS[expr.op], sides, place if expr.op in "+-%" else expr.span, scope)


def _refuse_products(expr: ast.Binary, sides: Sequence[Number | Vector], place: Span, scope: Scope) -> None:
    """Sums are made of two vectors or of two numbers; a product takes at most one vector."""
    vectors = [isinstance(side, Vector) for side in sides]
    if expr.op in "+-" and any(vectors) and not all(vectors):
        scope.fail(Diagnostic("E205", f"`{expr.op}` does not mix a vector and a number", place))
    if expr.op == "*" and all(vectors):
        left, right = expr.left.span.text, expr.right.span.text
        help_ = (f"`dot({left}, {right})` or `cross({left}, {right})`",)
        scope.fail(Diagnostic("E205", "`*` of two vectors is ambiguous", place, help=help_))
    if expr.op in "/%^" and vectors[1]:
        scope.fail(Diagnostic("E205", f"`{expr.op}` does not take a vector on its right", place))


def _compare(expr: ast.Compare, values: Sequence[Value], scope: Scope) -> Value:
    return comparisons.comparison(expr, values, scope)


def _member(expr: ast.Member, values: Sequence[Value], scope: Scope) -> Value:
    region = expr.region
    item, rest = (expr.item, values[0]), values[1:]
    if isinstance(values[0], Swept):
        return comparisons.sweeps(
            expr, values[0], list(zip(_member_parts(expr)[1:], rest, strict=True)), scope
        )
    if isinstance(region, ast.SetLiteral):
        inside = comparisons.in_set(item, list(zip(region.items, rest, strict=True)), expr.span, scope)
    elif isinstance(region, ast.Vector) and len(region.items) == 2:
        inside = comparisons.in_range(item, list(zip(region.items, rest, strict=True)), expr.span, scope)
    else:
        inside = comparisons.in_region(item, (region, rest[0]), expr.span, scope)
    return typed.Not(expr.span, inside) if expr.negated else inside


def _member_parts(expr: ast.Member) -> Sequence[ast.Expr]:
    region = expr.region
    if isinstance(region, ast.SetLiteral) or (isinstance(region, ast.Vector) and len(region.items) == 2):
        return (expr.item, *region.items)
    return (expr.item, region)


def _if(expr: ast.IfThenElse, values: Sequence[Value], scope: Scope) -> Value:
    cond, yes, no = values
    return choose(expr, (cond, yes, no), scope)


def _nothing(_expr: ast.Expr) -> Sequence[ast.Expr]:
    return ()


OPERATIONS: Mapping[type[ast.Node], Operation] = MappingProxyType(
    {
        ast.Quantity: Operation(_nothing, _quantity),
        ast.String: Operation(_nothing, _string),
        ast.Bool: Operation(_nothing, _bool),
        ast.Inf: Operation(_nothing, _inf),
        ast.Vector: Operation(lambda expr: expr.items, _vector),
        ast.Index: Operation(lambda expr: (expr.base, expr.index), _index),
        ast.Neg: Operation(lambda expr: (expr.operand,), _neg),
        ast.Binary: Operation(lambda expr: (expr.left, expr.right), _binary),
        ast.Compare: Operation(lambda expr: expr.operands, _compare),
        ast.Member: Operation(_member_parts, _member),
        ast.IfThenElse: Operation(lambda expr: (expr.cond, expr.yes, expr.no), _if),
    }
)
"""Kind of node -> how it is valued."""
