"""`m.name`: names of imported files."""

from __future__ import annotations

from stlc.compile.frontend.calls import unsupported
from stlc.compile.frontend.scope import Scope
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.registry import closest


def member(expr: ast.Attr, scope: Scope) -> tuple[ast.Name, Scope]:
    """`m.name`: the name, and the scope in which it means something. Raises Failed (E101)."""
    if not scope.in_spec:
        scope.fail(unsupported(f"`{expr.span.text}`", expr.span, scope))
    place = expr.span.source.span(expr.span.end - len(expr.name), expr.span.end)
    return ast.Name(place, expr.name, quoted=True), _module(expr.base, scope)


def _module(expr: ast.Expr, scope: Scope) -> Scope:
    match expr:
        case ast.Name(_, name) if name in scope.modules:
            return scope.modules[name]
        case ast.Attr(_, base, name):
            outer = _module(base, scope)
            if name in outer.modules:
                return outer.modules[name]
    near = closest(expr.span.text, scope.modules)
    asks = f"did you mean `{near}`?" if near is not None else 'import "file.stl" as m, or import std'
    return scope.fail(
        Diagnostic("E101", f"`{expr.span.text}` is not an imported file", expr.span, help=(asks,))
    )
