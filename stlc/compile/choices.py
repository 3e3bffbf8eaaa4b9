"""`if … then … else …`, for formulas and for numbers."""

from __future__ import annotations

from dataclasses import replace

from stlc.compile import ir, typed
from stlc.compile.algebra import agree
from stlc.compile.scope import Scope
from stlc.compile.sorts import Need, as_formula, as_state_formula, loose_number
from stlc.compile.values import Number, Value, Vector
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.signature import Kind

Branches = tuple[Value, Value, Value]


def choose_formula(expr: ast.IfThenElse, values: Branches, scope: Scope) -> typed.Formula:
    """`(cond -> yes) and (not cond -> no)`."""
    cond = as_formula(values[0], expr.cond, Need("`if`"), scope)
    yes = as_formula(values[1], expr.yes, Need("`then`"), scope)
    no = as_formula(values[2], expr.no, Need("`else`"), scope)
    first = typed.Logic(expr.yes.span, "->", (cond, yes))
    second = typed.Logic(expr.no.span, "->", (typed.Not(expr.cond.span, cond), no))
    return typed.Logic(expr.span, "and", (first, second))


def choose_number(expr: ast.IfThenElse, values: Branches, scope: Scope) -> Number | Vector:
    """One of two numbers (or vectors), by a state formula."""
    cond = as_state_formula(values[0], expr.cond, Need("`if`"), scope)
    yes, no = values[1], values[2]
    if isinstance(yes, Vector) and isinstance(no, Vector):
        if len(yes.items) != len(no.items):
            message = f"vectors of {len(yes.items)} and {len(no.items)} components do not go together"
            scope.fail(Diagnostic("E205", message, expr.span))
        pairs = zip(yes.items, no.items, strict=True)
        return Vector(tuple(_choose(cond, a, b, expr, scope) for a, b in pairs), expr.span)
    a = loose_number(yes, expr.yes, Need("the branches of `if` are of one sort", "this"), scope)
    b = loose_number(no, expr.no, Need("the branches of `if` are of one sort", "this"), scope)
    return _choose(cond, a, b, expr, scope)


def _choose(cond: ir.Formula, yes: Number, no: Number, expr: ast.IfThenElse, scope: Scope) -> Number:
    (yes, no), blank = agree((yes, no), "choose between", expr.span, scope)
    if isinstance(cond, ir.Truth):
        return yes if cond.value else no
    same = yes.kind == no.kind and yes.labels == no.labels
    kind: Kind = yes.kind if same else "real"
    labels = yes.labels if same else ()
    return replace(blank, num=ir.Where(cond, yes.num, no.num), kind=kind, labels=labels)
