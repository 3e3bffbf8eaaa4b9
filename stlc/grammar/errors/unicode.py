# ruff: noqa: RUF001 - this module lists such characters
"""Characters that are not of the language, and what to write instead.

Mathematical and typographic characters, such as `□`, `≤` and curved quotes, have a spelling. Blanks are
space, tab, LF and CRLF. Other controls and the marks of bidirectional text are refused even in comments and
texts, since an editor would show another text than the one that is parsed.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar.scan import Lexeme
from stlc.source import Source


@dataclass(frozen=True, slots=True)
class Replacement:
    """Advice about a character that is not in the language, such as `≤`.

    `text` is the spelling of this character in the language, here `<=`. It is None if there is no unique
    spelling. `help` is the advice in words.
    """

    help: str
    text: str | None = None


_SPELLED = {
    "always": "□◻☐▢",
    "eventually": "◇◊♢⋄",
    "until": "𝒰𝓤",
    "and": "∧⋀",
    "or": "∨⋁",
    "not": "¬",
    "xor": "⊕",
    "->": "→⇒⟶⟹⊃",
    "<->": "↔⇔⟷⟺≡",
    "<=": "≤⩽≦",
    ">=": "≥⩾≧",
    "!=": "≠",
    "in": "∈",
    "not in": "∉",
    "forall": "∀",
    "exists": "∃",
    "true": "⊤",
    "false": "⊥",
    "inf": "∞",
    "*": "×·⋅∙",
    "/": "÷",
    "-": "−–—",
    "^2": "²",
    "^3": "³",
    "sqrt": "√",
    '"': "“”„",
}
_ADVICE: Mapping[str, Replacement] = MappingProxyType(
    {
        **{char: Replacement(f"write `{text}`", text) for text, chars in _SPELLED.items() for char in chars},
        **dict.fromkeys("'‘’", Replacement('texts stand in double quotes: "…"')),
        "?": Replacement("write `if … then … else …`"),
        **dict.fromkeys("‖∥", Replacement("write `norm(…)`")),
        "∪": Replacement("write `union(a, b)`"),
        "∩": Replacement("write `intersect(a, b)`"),
    }
)
_SPACES = frozenset("\xa0\u1680\u202f\u205f\u3000" + "".join(map(chr, range(0x2000, 0x200B))))
_BREAKS = frozenset("\r\x85\u2028\u2029")
_UNSEEN = re.compile(
    rf"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069{''.join(_SPACES)}]"
    r"|\r(?!\n)"
)
_OF_THE_LANGUAGE = frozenset("()[]{}.,:;=<>!&|+-*/%^~@#")


def replacement(char: str) -> Replacement | None:
    """Return the advice about a character that is not in the language; None if there is none."""
    return _ADVICE.get(char)


def unexpected_character(lexeme: Lexeme) -> bool:
    """True if no token of the language begins with the first character of a lexeme."""
    if lexeme.kind == "sign":
        return lexeme.text[0] not in _OF_THE_LANGUAGE
    return lexeme.text[0] in _ADVICE and lexeme.kind == "word"


def apart(word: str, text: str, at: int) -> str:
    """Return `word`, with blanks around it if needed, as a replacement of one character of `text`.

    `at` is the offset of this character. A blank is added on a side where `word` would otherwise join a
    letter or digit.
    """
    before = " " if word[0].isalpha() and at and text[at - 1].isalnum() else ""
    behind = " " if word[-1].isalpha() and text[at + 1 : at + 2].isalnum() else ""
    return f"{before}{word}{behind}"


def _unseen(text: str, start: int, end: int) -> Iterator[tuple[int, str | None]]:
    """Yield (offset, replacement) of the foreign blanks and controls between two offsets.

    The replacement is None within texts in quotes and names in backticks, where it would change a name.
    Spaces such as the no-break space are allowed there, and in comments.
    """
    places = [match.start() for match in _UNSEEN.finditer(text, start, end)]
    if not places:
        return
    signs: set[int] = set()
    quoted: set[int] = set()
    for lexeme in Lexeme.scan(text, start, end):
        where = quoted if lexeme.kind in ("quoted", "string") else signs
        where.update(range(lexeme.start, lexeme.end))
    for at in places:
        if text[at] not in _SPACES:
            blank = "\n" if text[at] in _BREAKS else " " if text[at] in "\v\f" else ""
            yield at, None if at in quoted else blank
        elif at in signs:
            yield at, " "


def unseen_characters(source: Source, start: int, end: int) -> Iterator[Diagnostic]:
    """Yield E001 for each blank or control character between two offsets that is not of the language."""
    for at, blank in _unseen(source.text, start, end):
        span = source.span(at, at + 1)
        message = f"unexpected character {named(source.text[at])}"
        help_ = ("blanks are space, tab and line breaks (LF or CRLF)",)
        yield Diagnostic(
            "E001", message, span, help=help_, fix=None if blank is None else Fix(((span, blank),))
        )


def named(char: str) -> str:
    """Return a character for a message: itself, or its number and name if it is not visible."""
    if char.isprintable():
        return f"`{char}`"
    return f"U+{ord(char):04X} ({unicodedata.name(char, 'control character').lower()})"


def plain_text(text: str) -> str:
    """Return the text with symbols such as `□`, `≤`, `∧` spelled in the language, and with its blanks only.

    Symbols in comments, strings and quoted names are kept.
    """
    edits = [(at, blank) for at, blank in _unseen(text, 0, len(text)) if blank is not None]
    for lexeme in Lexeme.scan(text):
        advice = replacement(lexeme.text[0]) if unexpected_character(lexeme) else None
        if advice is not None and advice.text is not None:
            edits.append((lexeme.start, apart(advice.text, text, lexeme.start)))
    parts: list[str] = []
    done = 0
    for at, written in sorted(edits):
        parts += [text[done:at], written]
        done = at + 1
    return "".join([*parts, text[done:]])
