"""Where names lead: to their declaration, and from there into the system file."""

from __future__ import annotations

from stlc.editor.document import Document
from stlc.editor.modules import borrowed_at
from stlc.editor.symbols import Symbol
from stlc.grammar import ast
from stlc.source import Span


def definition(document: Document, offset: int) -> tuple[Span, ...]:
    """Where to go from a cursor.

    From a use to the declaration; from the declaration of a signal, a parameter or a constant to the system
    file that has it too; from `system "file"` into that file; from `module.name` into the module.
    """
    place = document.spec.system_span
    if place is not None and place.start <= offset <= place.end:
        return () if document.system is None else (document.system.source.span(0, 0),)
    borrowed = borrowed_at(document.spec, document.modules, offset)
    if borrowed is not None:
        return () if borrowed.item is None else (borrowed.item.name_span,)
    found = document.names.at(offset)
    if found is None:
        return ()
    if not found.declares:
        return (found.symbol.span,)
    beyond = system_place(document, found.symbol)
    return (found.symbol.span if beyond is None else beyond,)


def system_place(document: Document, symbol: Symbol) -> Span | None:
    """Where the system file declares a symbol, if it does."""
    if document.system is None or symbol.kind not in ("signal", "param", "const", "extern"):
        return None
    item = symbol.item
    name = item.column or symbol.name if isinstance(item, ast.Signal) else symbol.name
    return document.system.places.get(name)


def outline(document: Document) -> tuple[tuple[Symbol, Span], ...]:
    """The declarations of a file, in order, each with all of its text."""
    names = document.names
    found = [
        (one.symbol, one.symbol.item.span)
        for one in names.occurrences
        if one.declares and one.symbol.item is not None and one.symbol.kind not in ("argument", "member")
    ]
    return tuple(found)
