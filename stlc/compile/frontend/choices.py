"""`if … then … else …`, for formulas and for numbers."""

from __future__ import annotations

from dataclasses import replace

from stlc.compile.frontend.algebra import agree
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.sorts import Need, as_formula, as_state_formula, loose_number
from stlc.compile.frontend.values import Number, Value, Vector
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.traverse import is_state
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.signature import Kind

Branches = tuple[Value, Value, Value]


def choose(expr: ast.IfThenElse, values: Branches, scope: Scope) -> Value:
    """A choice between formulas, or between numbers or vectors. One between bools is both.

    Args:
        expr: as written.
        values: of the condition and of both branches.
        scope: where findings go.

    Raises:
        Failed: the condition is not a formula (E201), for numbers not one about a single instant (E202), or
            the branches do not go together (E203, E205).
    """
    cond = as_formula(values[0], expr.cond, Need("`if`"), scope)
    yes, no = values[1:]
    if isinstance(yes, typed.Node) or isinstance(no, typed.Node):
        return _formulas(expr, cond, (yes, no), scope)
    if _is_bool(yes) and _is_bool(no) and not is_state(cond):
        return _formulas(expr, cond, (yes, no), scope)
    if not (isinstance(yes, Vector) and isinstance(no, Vector)):
        return _choose(expr, cond, (yes, no), scope)
    if len(yes.items) != len(no.items):
        message = f"vectors of {len(yes.items)} and {len(no.items)} components do not go together"
        scope.fail(Diagnostic("E205", message, expr.span))
    pairs = zip(yes.items, no.items, strict=True)
    return Vector(tuple(_choose(expr, cond, pair, scope) for pair in pairs), expr.span)


def _is_bool(value: Value) -> bool:
    return isinstance(value, Number) and value.kind == "bool"


def _formulas(
    expr: ast.IfThenElse, cond: typed.Formula, branches: tuple[Value, Value], scope: Scope
) -> typed.Formula:
    """`(cond and yes) or (not cond and no)`."""
    yes = as_formula(branches[0], expr.yes, Need("`then`"), scope)
    no = as_formula(branches[1], expr.no, Need("`else`"), scope)
    first = typed.Logic(expr.yes.span, "and", (cond, yes))
    second = typed.Logic(expr.no.span, "and", (typed.Not(expr.cond.span, cond), no))
    return typed.Logic(expr.span, "or", (first, second))


def _choose(expr: ast.IfThenElse, cond: typed.Formula, branches: tuple[Value, Value], scope: Scope) -> Number:
    """One of two numbers, by a state formula; of two bools the choice between formulas as well."""
    decides = as_state_formula(cond, expr.cond, Need("`if`"), scope)
    need = Need("the branches of `if` are of one sort", "this")
    yes = loose_number(branches[0], expr.yes, need, scope)
    no = loose_number(branches[1], expr.no, need, scope)
    (yes, no), blank = agree((yes, no), "choose between", expr.span, scope)
    if isinstance(decides, ir.Truth):
        return yes if decides.value else no
    formula = _formulas(expr, cond, branches, scope) if _is_bool(yes) and _is_bool(no) else None
    same = yes.kind == no.kind and yes.labels == no.labels
    kind: Kind = yes.kind if same else "real"
    labels = yes.labels if same else ()
    num = ir.Where(decides, yes.num, no.num)
    return replace(blank, num=num, kind=kind, labels=labels, formula=formula)
