"""Expressions as formulas: state formulas for system files, temporal ones for requirements."""

from __future__ import annotations

from stlc.compile.frontend.expressions import evaluate
from stlc.compile.frontend.scope import Failed, Scope
from stlc.compile.frontend.sorts import Need, as_formula
from stlc.compile.frontend.values import REGION_TYPES, Number, Region, Value, describe, noun
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.normal_form import condition
from stlc.compile.ir.traverse import is_state
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast


def resolve_state_formula(expr: ast.Expr, scope: Scope, *, what: str = "a condition") -> ir.Formula:
    """The expression as a formula over one instant, in negation normal form.

    Args:
        expr: as parsed.
        scope: what names mean; findings are appended to its sink.
        what: what the formula is, for messages: "a guard".

    Raises:
        StlcError: `scope.error`, with what was found.
    """
    before = len(scope.sink)
    try:
        with scope.meter.fresh():
            value = evaluate(expr, scope)
            formula = _formula(value, expr, what, scope)
            if not is_state(formula):
                scope.fail(Diagnostic("E202", f"{what} speaks about one instant", expr.span, "temporal"))
            return condition(formula)
    except Failed:
        raise scope.error(*(f for f in scope.sink[before:] if f.severity == "error")) from None


def resolve_region(expr: ast.Expr, scope: Scope) -> Region:
    """The expression as a region.

    Raises:
        StlcError: `scope.error`, with what was found.
    """
    before = len(scope.sink)
    try:
        with scope.meter.fresh():
            value = evaluate(expr, scope)
            if not isinstance(value, REGION_TYPES):
                scope.fail(Diagnostic("E205", f"a region is needed, this is {noun(value)}", expr.span))
            return value
    except Failed:
        raise scope.error(*(f for f in scope.sink[before:] if f.severity == "error")) from None


def resolve_formula(expr: ast.Expr, scope: Scope, *, what: str = "a requirement") -> typed.Formula:
    """The expression as a formula, temporal operators included where `scope.temporal`.

    Raises:
        Failed: the findings are in the sink.
    """
    with scope.meter.fresh():
        return as_formula(evaluate(expr, scope), expr, Need(what), scope)


def _formula(value: Value, expr: ast.Expr, what: str, scope: Scope) -> typed.Formula:
    fits = isinstance(value, typed.Node) or (isinstance(value, Number) and value.kind == "bool")
    if not fits and not scope.in_spec:
        help_ = (f"`{expr.span.text} > 0`",) if isinstance(value, Number) and not value.labels else ()
        message = f"{what} must be a formula, this is {noun(value)}"
        scope.fail(Diagnostic("S203", message, expr.span, describe(value), help=help_))
    return as_formula(value, expr, Need(what), scope)
