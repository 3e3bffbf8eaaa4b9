"""Fast scanner that splits any text into lexemes (words, numbers, strings, signs), and into declarations.

The parser reads one declaration at a time, so that errors in different ones are found independently.
Declaration keywords are reserved words, so a text can be split before each of them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from stlc.grammar.words import (
    DECLARATIONS,
    OPERATORS,
    PRAGMAS,
    RESERVED,
    ROLES,
    SPACE,
)
from stlc.source import Source, Span

LexemeKind = Literal["word", "quoted", "number", "string", "sign"]

_LEXEME = re.compile(
    rf"""
    {SPACE}+ | (?P<comment>(?:\#|//)[^\n]*)
    | (?P<string>"[^"\n]*")
    | (?P<quoted>`[^`\n]+`)
    | (?P<word>[^\W\d¹²³⁰⁴-⁹][^\W¹²³⁰⁴-⁹]*)
    | (?P<number>(?:\d[\d_]*\.(?!\.)\d*|\.\d+|\d[\d_]*)(?:[eE][+-]?\d+)?)
    | (?P<sign><->|<=>|->|=>|<=|>=|==|!=|\|\||&&|\.\.|.)
    """,
    re.VERBOSE | re.DOTALL,
)
_NO_PRAGMA = RESERVED | {"from", "as", *ROLES}
CLOSES = MappingProxyType({"(": ")", "[": "]", "{": "}"})


@dataclass(frozen=True, slots=True)
class Lexeme:
    """Word, number, quoted string or sign, with its position in the text."""

    kind: LexemeKind
    text: str
    start: int
    end: int

    @classmethod
    def scan(cls, text: str, start: int = 0, end: int | None = None) -> Iterator[Lexeme]:
        """Yield the lexemes (words, numbers, strings, signs) of a text from offset `start` to `end`.

        Any text is accepted. Blanks and comments are left out.
        """
        for match in _LEXEME.finditer(text, start, len(text) if end is None else end):
            kind = match.lastgroup
            if kind is not None and kind != "comment":
                yield cls(kind, match[0], match.start(), match.end())  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Bracket:
    """An opening bracket, and the bracket that closes it; `closing` is None if there is none.

    `interval` is True if the opening bracket may begin the interval of a temporal operator.
    """

    opening: Lexeme
    interval: bool
    closing: Lexeme | None = None


def comments(source: Source) -> Iterator[Span]:
    """Yield the location of each comment of a text, from its `#` or `//` to the end of its line."""
    for match in _LEXEME.finditer(source.text):
        if match.lastgroup == "comment":
            yield source.span(match.start(), match.end())


def declaration_starts(text: str) -> list[int]:
    """Return the offset at which each declaration of a text starts.

    A declaration starts with its first tag. Without tags, it starts with its first word, such as `env` in
    `env signal`. The first offset is always 0.
    """
    starts = [0]
    tag: int | None = None
    before: Lexeme | None = None
    for lexeme in Lexeme.scan(text):
        if before is not None and _is_pragma(text, before, lexeme):
            starts.append(before.start)
        if before is not None and before.text == "@" and lexeme.kind in ("word", "quoted") and tag is None:
            tag = before.start
        if lexeme.kind == "word" and lexeme.text in DECLARATIONS:
            own = lexeme.start
            if before is not None and lexeme.text == "signal" and before.text in ROLES:
                own = before.start
            starts.append(own if tag is None else tag)
            tag = None
        before = lexeme
    return starts


def _is_pragma(text: str, word: Lexeme, behind: Lexeme) -> bool:
    """True if `word` and the next lexeme, `behind`, begin a pragma such as `spec name` or `time unit`.

    A pragma stands at the start of a line. No expression contains such a pair of words.
    """
    if word.text not in PRAGMAS or (word.start and text[word.start - 1] != "\n"):
        return False
    named = behind.kind in ("word", "quoted", "string") and behind.text not in _NO_PRAGMA
    return named and "\n" not in text[word.end : behind.start]


def brackets(items: Sequence[Lexeme]) -> list[Bracket]:
    """Return all brackets that open in `items`, in order, each with the bracket that closes it.

    The interval of a temporal operator is closed by `)` or `]`. Any other bracket is closed by the
    counterpart of its opening sign.
    """
    found: list[Bracket] = []
    still_open: list[int] = []
    for i, lexeme in enumerate(items):
        if lexeme.kind != "sign":
            continue
        if lexeme.text in CLOSES:
            still_open.append(len(found))
            found.append(Bracket(lexeme, interval=i > 0 and opens_interval(items[i - 1])))
        elif still_open and closes(found[still_open[-1]], lexeme.text):
            index = still_open.pop()
            found[index] = Bracket(found[index].opening, found[index].interval, lexeme)
    return found


def opens_interval(before: Lexeme) -> bool:
    """True if a bracket after the lexeme `before` may open the interval of a temporal operator."""
    return before.text == "@" or (before.kind == "word" and before.text.rstrip("_") in OPERATORS)


def closes(bracket: Bracket, text: str) -> bool:
    """True if the sign `text` closes the bracket.

    A bracket is closed by the counterpart of its opening sign. The interval of a temporal operator is closed
    by `)` or `]`, whichever sign opens it.
    """
    return text == CLOSES[bracket.opening.text] or (bracket.interval and text in (")", "]"))
