"""Names inside an expression, without resolving it: macros know their sorts only where they are used."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields

from stlc.compile.frontend.scope import TIME_WORDS, Definition, Failed, Scope
from stlc.compile.ir.functions import callable_names, sampler_names
from stlc.grammar import ast


def check_names(entry: Definition, scope: Scope) -> None:
    """Report every name in a macro's body that nothing declares (E101)."""
    functions = {*callable_names(), *sampler_names()}
    for name, called in _free(entry.body, frozenset(entry.formals)):
        if name.name in scope.entries or (name.name in TIME_WORDS and not name.quoted):
            continue
        if called and name.name in functions:
            continue
        try:
            scope.unknown(name, called=called)
        except Failed:
            continue


def _free(node: object, bound: frozenset[str]) -> Iterator[tuple[ast.Name, bool]]:
    """Names that no formal, quantifier or freeze binds, and whether they are called."""
    if isinstance(node, ast.Name):
        if node.name not in bound:
            yield node, False
        return
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        yield node.func, True
    for part in _parts(node):
        yield from _free(part, bound | _binds(node))


def _binds(node: object) -> frozenset[str]:
    match node:
        case ast.Quantifier(_, _, var):
            return frozenset((var,))
        case ast.Freeze(_, bindings):
            return frozenset(name for name, _ in bindings)
        case _:
            return frozenset()


def _parts(node: object) -> Iterator[object]:
    """What stands inside a node, without the functions that it calls and the modules that it names."""
    if isinstance(node, tuple):
        yield from node
    elif isinstance(node, ast.Node) and not isinstance(node, ast.Attr):
        skipped = ("span", "func") if isinstance(node, ast.Call) else ("span",)
        yield from (getattr(node, field.name) for field in fields(node) if field.name not in skipped)
