"""Definitions (`def`, `const`, `region`): types of their bodies, binding of arguments, and errors."""

from __future__ import annotations

from dataclasses import replace

from stlc.compile.frontend.arithmetic import in_unit, on_scale
from stlc.compile.frontend.coerce import Expectation, as_formula, as_number
from stlc.compile.frontend.scope import MAX_LEVELS, MAX_NODES, Definition, Meter, Scope
from stlc.compile.frontend.values import REGION_TYPES, Number, TimeExpr, Value, VectorValue, noun, unit_text
from stlc.compile.ir import typed
from stlc.compile.ir.functions import REGIONS
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.source import Span
from stlc.units import Unit


def arguments(entry: Definition, call: ast.Call, scope: Scope) -> dict[str, ast.Expr]:
    """Return the expression that a call passes for each argument name, by position or by name.

    Raises:
        Failed: an argument is missing, unknown or repeated (E105).
    """
    shape = (f"{entry.name}({', '.join(entry.formals)})",)
    count, given = len(entry.formals), len(call.args)
    if given != count:
        were = "was" if given == 1 else "were"
        message = f"`{entry.name}` takes {count} argument{'s' if count != 1 else ''}, {given} {were} given"
        scope.fail(Diagnostic("E105", message, call.span, help=shape))
    bound: dict[str, ast.Expr] = {}
    for formal, arg in zip(entry.formals, call.args, strict=True):
        name = formal if arg.name is None else arg.name
        if name not in entry.formals or name in bound:
            fault = "is given twice" if name in bound else "does not exist"
            message = f"argument `{name}` of `{entry.name}` {fault}"
            scope.fail(Diagnostic("E105", message, arg.span, help=shape))
        bound[name] = arg.value
    return bound


def finished(entry: Definition, value: Value, scope: Scope) -> Value:
    """Return the value of a definition's body, converted to the declared type and unit.

    Raises:
        Failed: the value has another type (E201, E202, E205) or another unit (E203).
    """
    body = entry.body
    match entry.sort:
        case "formula":
            return as_formula(value, body, Expectation(f"`{entry.name}`"), scope)
        case "number":
            value = as_number(value, body, Expectation(f"`{entry.name}` is a number"), scope)
        case "region":
            if not isinstance(value, REGION_TYPES):
                help_ = ("a region is made by " + ", ".join(f"`{name}`" for name in REGIONS),)
                message = f"`region` needs a region, this is {noun(value)}"
                scope.fail(Diagnostic("E205", message, body.span, help=help_))
        case "constant":
            _check_constant(entry, value, scope)
        case "any":
            pass
    if entry.unit is not None and isinstance(value, VectorValue):
        items = tuple(_number_in(item, entry.unit, body.span, scope) for item in value.items)
        return replace(value, items=items)
    if entry.unit is not None and isinstance(value, Number):
        return _number_in(value, entry.unit, body.span, scope)
    return value


def _check_constant(entry: Definition, value: Value, scope: Scope) -> None:
    items = value.items if isinstance(value, VectorValue) else (value,)
    for item in items:
        known = isinstance(item, Number) and item.constant is not None
        if known or isinstance(item, typed.Truth) or (isinstance(item, TimeExpr) and not item.end):
            continue
        message = f"`const {entry.name}` must be a number that is known at compile time"
        help_ = (f"def {entry.name} = {entry.body.span.text}",)
        scope.fail(Diagnostic("E205", message, entry.body.span, f"this is {noun(value)}", help=help_))


def _number_in(number: Number, unit: Unit, span: Span, scope: Scope) -> Number:
    if number.bare:
        return in_unit(number, unit, scope)
    if not number.flexible and not number.unit.same_dims(unit):
        message = f"declared as [{unit}], but this is {unit_text(number) or '[1]'}"
        scope.fail(Diagnostic("E203", message, number.span or span))
    return replace(on_scale(number, unit, span, scope), flexible=False)


def cycle(entry: Definition, scope: Scope) -> Diagnostic:
    """Return the error E105 for a definition that refers to itself, directly or through others."""
    start = scope.open.index(entry.name)
    chain = " -> ".join((*scope.open[start:], entry.name))
    note = (f"{chain}",) if len(scope.open) - start > 1 else ()
    return Diagnostic("E105", f"`{entry.name}` is defined in terms of itself", entry.span, note=note)


def too_big(meter: Meter, span: Span) -> Diagnostic:
    """Return the error E005 for an expression that is too large or too deeply nested when expanded."""
    if meter.nodes > MAX_NODES:
        message = f"this expands to more than {MAX_NODES:,} operations"
        help_ = ("definitions are written out where they are used, and quantifiers are unrolled",)
        return Diagnostic("E005", message, span, help=help_)
    return Diagnostic("E005", f"this is nested more than {MAX_LEVELS} levels deep", span)
