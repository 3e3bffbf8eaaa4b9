"""Renaming of a symbol at all places where it is named; the meaning of all other names is unchanged."""

from __future__ import annotations

import re
from collections.abc import Sequence

from stlc.diagnostics import SpecError
from stlc.editor.document import Document
from stlc.editor.symbols import Occurrence, SymbolNames, names_of
from stlc.grammar import ast
from stlc.grammar.printer import own_name
from stlc.grammar.spec import Spec
from stlc.lint.lint import Edit, edited
from stlc.source import Source, Span

_NAME = re.compile(r"[^\W\d]\w*")


class RenameError(Exception):
    """Error: a symbol cannot be renamed, for the reason in the message."""


_FROM_ELSEWHERE = ("module", "extern", "param")
"""Kinds of symbols that other files may refer to by name, so that they cannot be renamed safely."""


def can_rename(document: Document, offset: int) -> Occurrence | None:
    """Return the occurrence of a symbol at `offset` if the symbol can be renamed, else None.

    Imported modules, external functions and parameters cannot be renamed, because other files may refer to
    them by name.
    """
    found = document.names.at(offset)
    return None if found is None or found.symbol.kind in _FROM_ELSEWHERE else found


def rename(document: Document, offset: int, new: str) -> tuple[Edit, ...]:
    """Return the edits that give the symbol at `offset` the name `new`.

    A renamed signal still reads the same state of the system: `from "old"` is added to its declaration.

    Raises:
        RenameError: nothing at `offset` can be renamed, the text has errors, or `new` already has a meaning
            at one of the occurrences.
    """
    found = can_rename(document, offset)
    if found is None:
        raise RenameError("there is no name here that this file alone decides")
    if document.unread:
        line = next((finding.span.line for finding in document.unread if finding.span is not None), 1)
        raise RenameError(f"the text has an error in line {line}; mend it first")
    name = new.strip().strip("`")
    if not _NAME.fullmatch(name):
        raise RenameError(f"`{new}` is not a name: letters, digits and _, no digit first")
    symbol = found.symbol
    edits = [(one.span, own_name(name)) for one in document.names.of(symbol)]
    edits += _column(document, symbol.item, symbol.name)
    _refuse_capture(document, edits, name)
    return tuple(edits)


def _column(document: Document, item: ast.Declaration | None, name: str) -> list[Edit]:
    """Return the edit that adds `from "old"` to the declaration of a renamed signal; [] for other symbols.

    With this addition, the signal still reads the state (or column of a trace) that has the old name.
    Raises RenameError if the signal shares its declaration with others.
    """
    if not isinstance(item, ast.Signal) or item.column is not None:
        return []
    together = [other.name for other in document.spec.items if other.span == item.span]
    if len(together) > 1:
        raise RenameError(f"`{', '.join(together)}` share a declaration; give `{name}` one of its own first")
    end = item.span.end
    return [(item.span.source.span(end, end), f' from "{name}"')]


def _refuse_capture(document: Document, edits: Sequence[Edit], name: str) -> None:
    """Raise RenameError if the edits would change the declaration to which some name refers.

    `edits` give a symbol the new name `name`.
    """
    text = edited(document.source.text, edits)
    try:
        after = names_of(Spec.parse(Source(document.source.name, text)))
    except SpecError as error:
        raise RenameError(f"`{name}` cannot stand everywhere: {error.diagnostics[0].message}") from None
    if _bindings(after) != _bindings(document.names) or _declared(after) != _declared(document.names):
        raise RenameError(f"`{name}` has a meaning already where this would be written")


def _bindings(names: SymbolNames) -> list[int]:
    """Return, for every occurrence of a symbol, the index of the first occurrence of the same symbol.

    Two texts with equal results name the same symbols at the same places.
    """
    first: dict[Span, int] = {}
    return [first.setdefault(one.symbol.span, index) for index, one in enumerate(names.occurrences)]


def _declared(names: SymbolNames) -> tuple[int, int, int]:
    """Return the numbers of distinct names of values, of types, and of requirements or assumptions.

    If a renaming decreases one of these numbers, it has given two symbols the same name.
    """
    return len(names.values), len(names.types), len(names.rules)
