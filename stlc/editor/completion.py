"""Proposals to complete the word at a cursor: the words and names that the grammar accepts there.

The parser reads the declaration up to the cursor and returns the terminals that may follow. If it finds a
syntax error before the cursor, all names, functions and keywords are proposed.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

from stlc.compile.ir.functions import callable_names
from stlc.editor.document import Document, shared
from stlc.editor.hover import about, about_shared, summary
from stlc.editor.symbols import inside
from stlc.editor.vocabulary import BUILT_IN, FUNCTIONS, KEYWORDS, TAGS, TEMPORAL, TYPES
from stlc.grammar import ast
from stlc.grammar.printer import own_name
from stlc.grammar.scan import Lexeme, declaration_starts
from stlc.grammar.tables import acceptable
from stlc.grammar.words import OPERATORS, PRAGMAS, RESERVED, ROLES
from stlc.units import Unit

OfferKind: TypeAlias = Literal[
    "Keyword", "Function", "Unit", "Property", "Class", "Variable", "Constant", "Reference", "EnumMember"
]
"""Names of completion item kinds of the language server protocol."""

_PREFIX = re.compile(r"@?`?\w*\Z")
_OF_MODULE = re.compile(r"(?<![\w.])`?([^\W\d]\w*)`?\s*\.\s*\Z")
_UNIT_PREFIX = re.compile(r"(?:[A-Za-zµ°Ω%][\w/^*·.°]*)?\Z")
_SILENT = re.compile(r"""[^"\n]*(?:"[^"\n]*"[^"\n]*)*(?:(?:\#|//).*|"[^"\n]*)""")
_PLAIN_WORDS = RESERVED | {*PRAGMAS, "as", "fn", "from"}
_TERMINALS = {
    "AND": ("and",),
    "OR": ("or", "xor"),
    "IFF": ("iff",),
    "IMPLIES": ("implies",),
    "_NOT_IN": ("not in",),
    "QUANTIFIER": ("forall", "exists"),
    "ROLE": tuple(ROLES),
    "UNARY": tuple(dict.fromkeys(each.name for each in OPERATORS.values() if not each.binary)),
    "BINARY": tuple(dict.fromkeys(each.name for each in OPERATORS.values() if each.binary)),
}
"""Words of a terminal of the grammar, in the spelling that the language prefers."""
_KINDS: dict[str, OfferKind] = {
    "signal": "Variable",
    "param": "Variable",
    "const": "Constant",
    "member": "EnumMember",
}
_FIRST_UNITS = ("s", "steps", "ms", "min", "m", "m/s", "m/s^2", "rad", "deg", "1")


@dataclass(frozen=True, slots=True)
class Offer:
    """One proposal in a completion list.

    Attributes:
        text: text inserted in place of the partial word.
        kind: kind of the symbol or word, such as `Keyword`.
        detail: one line shown beside the text.
        doc: description in Markdown, shown when the proposal is selected.
        order: sort key; proposals with smaller numbers come first.
    """

    text: str
    kind: OfferKind
    detail: str = ""
    doc: str = ""
    order: int = 5


@dataclass(frozen=True, slots=True)
class Completion:
    """The proposals at a cursor, and the offset (`start`) of the partial word that a proposal replaces."""

    start: int
    offers: tuple[Offer, ...]


def complete(document: Document, offset: int) -> Completion:
    """Return the proposals for the cursor at `offset`; the text after the cursor is ignored."""
    text = document.source.text[:offset]
    if _SILENT.fullmatch(text[text.rfind("\n") + 1 :]):
        return Completion(offset, ())
    match = _PREFIX.search(text)
    assert match is not None
    start = match.start()
    if match[0].startswith("@"):
        tags = sorted(TAGS.items())
        return Completion(start, tuple(Offer(f"@{name}", "Property", text) for name, text in tags))
    behind_dot = _OF_MODULE.search(text[:start])
    if behind_dot is not None:
        names = sorted(_shared(document, behind_dot[1]), key=lambda offer: offer.text)
        return Completion(start, tuple(names))
    starts = declaration_starts(text)
    piece = text[starts[bisect_right(starts, len(text)) - 1] : start]
    units = _units_at(piece, text)
    if units is not None:
        return Completion(offset - len(units), tuple(_units()))
    accepted = acceptable(piece)
    if accepted is None:
        aliases = {word for word, each in OPERATORS.items() if word != each.name}
        words = (Offer(x, "Keyword", doc=KEYWORDS.get(x, ""), order=7) for x in sorted(RESERVED - aliases))
        offers = [*_names(document, offset), *_functions(), *words]
    else:
        offers = [*_fitting(document, offset, piece, accepted)]
    unique = {offer.text: offer for offer in reversed(offers)}
    return Completion(start, tuple(sorted(unique.values(), key=lambda offer: (offer.order, offer.text))))


def _units_at(piece: str, text: str) -> str | None:
    """Return the part of a unit that is typed before the cursor inside `[…]`.

    None is returned if the cursor is not in a unit.

    Args:
        piece: text of the declaration up to the word under the cursor.
        text: text of the file up to the cursor.
    """
    head, bracket, tail = piece.rpartition("[")
    written = _UNIT_PREFIX.search(text)
    assert written is not None
    if not bracket or "]" in tail or _UNIT_PREFIX.fullmatch(tail) is None:
        return None
    accepted = acceptable(head)
    return written[0] if accepted is not None and "UNIT_BRACKET" in accepted else None


# ------------------------------------------------------------------------- offers


def _fitting(document: Document, offset: int, piece: str, accepted: frozenset[str]) -> Iterator[Offer]:
    """Yield proposals for the terminals `accepted`: the kinds of token that the parser accepts at the cursor.

    `piece` is the text of the declaration up to the word under the cursor.
    """
    for terminal in accepted:
        plain = terminal[1:].lower() if terminal.startswith("_") else ""
        for word in _TERMINALS.get(terminal, (plain,) if plain in _PLAIN_WORDS else ()):
            yield Offer(word, "Keyword", doc=TEMPORAL.get(word) or KEYWORDS.get(word, ""), order=4)
    if "UNIT" in accepted:
        yield from _units()
    if "TIME_UNIT" in accepted:
        yield from (Offer(unit, "Unit", order=1) for unit in ("s", "ms", "us", "ns", "min", "h", "steps"))
    if "NAME" not in accepted:
        return
    if "NUMBER" in accepted:
        yield from _names(document, offset)
        yield from _functions()
    else:
        yield from _new_names(document, piece)


def _names(document: Document, offset: int) -> Iterator[Offer]:
    """Yield proposals for the names that an expression at `offset` can contain.

    Arguments and bound variables come first, then declared names, then built-in constants.
    """
    for symbol in inside(document.spec, offset):
        yield Offer(own_name(symbol.name), "Reference", about(document, symbol), order=1)
    for symbol in document.names.values.values():
        kind = _KINDS.get(symbol.kind, "Reference")
        yield Offer(own_name(symbol.name), kind, summary(document, symbol), about(document, symbol), 2)
    yield from (Offer(name, "Constant", text, order=3) for name, text in BUILT_IN.items())


def _functions() -> Iterator[Offer]:
    yield from (Offer(name, "Function", doc=FUNCTIONS.get(name, ""), order=6) for name in callable_names())


def _new_names(document: Document, piece: str) -> Iterator[Offer]:
    """Yield proposals for names at a cursor where no expression can begin.

    `piece` is the text of the declaration up to the word under the cursor. If it ends with a colon or an
    arrow, types are proposed. In a signal declaration, the states of the system that are not yet declared are
    proposed.
    """
    words = [lexeme.text for lexeme in Lexeme.scan(piece)]
    if words[-1:] in ([":"], [">"], ["->"]):
        yield from (Offer(name, "Class", text) for name, text in TYPES.items())
        yield from (Offer(own_name(name), "Class", "enum") for name in document.names.types)
    elif document.system is not None and "signal" in words:
        declared = document.names.values
        for column in document.system.signature.columns:
            if column.name not in declared and "[" not in column.name:
                unit = f" [{column.unit}]" if column.unit.text else ""
                text = f"{own_name(column.name)}{unit}"
                yield Offer(text, "Variable", f"a state of {document.system.path.name}")


def _shared(document: Document, alias: str) -> Iterator[Offer]:
    """Yield proposals for the declarations of the imported module `alias`, which can follow `alias.`."""
    for module in document.modules:
        if module.alias == alias:
            for item in shared(module):
                kind: OfferKind = "Function" if isinstance(item, ast.Def) else "Reference"
                yield Offer(own_name(item.name), kind, "", about_shared(item, module.key))


def _units() -> Iterator[Offer]:
    usual = {prefix + unit for prefix in ("", *"numkM") for unit in Unit.PREFIXED}
    rest = (unit for unit in Unit.SYMBOLS if unit in usual and unit not in _FIRST_UNITS)
    yield from (Offer(unit, "Unit", order=1) for unit in _FIRST_UNITS)
    yield from (Offer(unit, "Unit", order=8) for unit in rest)
