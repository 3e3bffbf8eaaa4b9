"""Names of imported files: `std.response`, and what the file says about it."""

from __future__ import annotations

from dataclasses import dataclass

from stlc.compile.frontend.modules import Module
from stlc.grammar import ast
from stlc.grammar.children import descendants
from stlc.grammar.scan import lexemes
from stlc.source import Span


@dataclass(frozen=True, slots=True)
class Borrowed:
    """A name behind a dot.

    Attributes:
        span: of the name.
        module: where it comes from.
        item: its declaration there; None where the module has no such name.
    """

    span: Span
    module: Module
    item: ast.Item | None


def shared(module: Module) -> tuple[ast.Item, ...]:
    """What can be used of a module; its requirements are its own."""
    return tuple(item for item in module.spec.items if not isinstance(item, ast.Require | ast.Assume))


def borrowed_at(spec: ast.Spec, modules: tuple[Module, ...], offset: int) -> Borrowed | None:
    """The name of a module that a cursor at `offset` touches."""
    by_alias = {module.alias: module for module in modules}
    for node in (part for item in spec.items for part in descendants(item)):
        if not isinstance(node, ast.Attr) or not isinstance(node.base, ast.Name):
            continue
        if node.base.name not in by_alias:
            continue
        words = list(lexemes(node.span.source.text, node.base.span.end, node.span.end))
        span = node.span.source.span(words[-1].start, words[-1].end)
        if span.start <= offset <= span.end:
            module = by_alias[node.base.name]
            item = next((item for item in shared(module) if item.name == node.name), None)
            return Borrowed(span, module, item)
    return None
