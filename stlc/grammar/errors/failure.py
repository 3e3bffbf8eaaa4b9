"""Syntax errors, and the words and signs around them.

These words and signs show whether an error is a common mistake.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from stlc.grammar.scan import Bracket, Lexeme, brackets
from stlc.grammar.tables import acceptable, parses
from stlc.grammar.words import OPERATORS
from stlc.source import Source, Span

_REPAIRABLE = 100_000
"""Characters of the longest part of a text in which repairs are tried."""


@dataclass(frozen=True)
class Piece:
    """Part of a text that is parsed by itself: a declaration, or an expression.

    Attributes:
        source: the whole text.
        start: offset of the first character of the part.
        end: offset after its last character.
        rule: grammar rule that the part must match: `start` for a declaration, `expr` for an expression.
    """

    source: Source
    start: int
    end: int
    rule: str

    @property
    def text(self) -> str:
        """Text of this part."""
        return self.source.text[self.start : self.end]

    def repaired_by(self, start: int, end: int, replacement: str) -> bool:
        """True if this part parses with the characters from `start` to `end` replaced by `replacement`.

        No repair is tried in a part that takes long to parse.
        """
        if self.end - self.start > _REPAIRABLE:
            return False
        text = self.text[: start - self.start] + replacement + self.text[end - self.start :]
        return parses(text, self.rule)


@dataclass(frozen=True)
class ParseFailure:
    """Syntax error: a part of the text (`piece`), and the offset in the text where no grammar rule fits."""

    piece: Piece
    at: int

    @cached_property
    def lexemes(self) -> tuple[Lexeme, ...]:
        """All lexemes (words, numbers, strings and signs) of the part."""
        return tuple(Lexeme.scan(self.piece.source.text, self.piece.start, self.piece.end))

    @cached_property
    def before(self) -> tuple[Lexeme, ...]:
        """Lexemes (words, numbers, strings and signs) that come before the error."""
        return tuple(lexeme for lexeme in self.lexemes if lexeme.start < self.at)

    @cached_property
    def after(self) -> tuple[Lexeme, ...]:
        """Lexemes (words, numbers, strings and signs) from the error to the end of the part."""
        return self.lexemes[len(self.before) :]

    @property
    def previous(self) -> Lexeme | None:
        """Last lexeme (word, number, string or sign) before the error, or None."""
        return self.before[-1] if self.before else None

    @property
    def found(self) -> Lexeme | None:
        """Lexeme (word, number, string or sign) at the error; None at the end of the part."""
        return self.after[0] if self.after else None

    @cached_property
    def follower(self) -> Lexeme | None:
        """First lexeme (word, number, string or sign) after this part; the next declaration begins with it.

        It is None at the end of the text, or if the part is an expression.
        """
        if self.piece.rule != "start":
            return None
        return next(Lexeme.scan(self.piece.source.text, self.piece.end), None)

    @cached_property
    def accepts(self) -> frozenset[str]:
        """Kinds of token (terminals of the grammar) that the parser would accept at the error."""
        return acceptable(self.piece.text, self.piece.rule, even_broken=True) or frozenset()

    @property
    def wants_operand(self) -> bool:
        """True if an operand is expected at the error."""
        return "NUMBER" in self.accepts and "NAME" in self.accepts

    @property
    def wants_operator(self) -> bool:
        """True if an operator is accepted at the error."""
        return "AND" in self.accepts or "CMP" in self.accepts

    @cached_property
    def open_brackets(self) -> list[Bracket]:
        """Brackets that are open at the error, outermost first."""
        return [bracket for bracket in brackets(self.before) if bracket.closing is None]

    @property
    def span(self) -> Span:
        """Source location of the lexeme at the error.

        If the error is at the end of the part, it is the location of the end of the last lexeme.
        """
        if self.found is not None:
            return self.of(self.found)
        end = self.previous.end if self.previous is not None else self.piece.start
        return self.piece.source.span(end, end)

    def of(self, first: Lexeme, last: Lexeme | None = None) -> Span:
        """Return the source location from the lexeme `first` to the lexeme `last`, both included.

        If `last` is None, it is the location of `first`.
        """
        return self.piece.source.span(first.start, (last or first).end)

    def line_with(self, *edits: tuple[int, int, str]) -> str:
        """Return the line that contains the first of `edits`, with all edits applied.

        A comment at the end of the line is removed, except where an edit reaches into it. An edit (start,
        end, text) replaces the characters from offset `start` up to, but without, offset `end` of the source.
        """
        source = self.piece.source
        number = source.position(edits[0][0])[0]
        start = source.line_starts[number - 1]
        line = source.line(number)
        written = max((lexeme.end for lexeme in Lexeme.scan(line)), default=0)
        line = line[: max(written, *(high - start for _, high, _ in edits))]
        for low, high, replacement in sorted(edits, reverse=True):
            line = line[: low - start] + replacement + line[high - start :]
        return line.strip()

    def operand_before(self, index: int) -> int:
        """Return the index of the first lexeme of the operand that ends just before lexeme `index`."""
        depth = 0
        for i in range(index - 1, -1, -1):
            text = self.lexemes[i].text
            depth += (text in _CLOSERS) - (text in _OPENERS)
            if depth < 0 or (depth == 0 and text in _LOOSE):
                return i + 1
        return 0

    def operand_after(self, index: int) -> int:
        """Return the index after the last lexeme of the operand that begins with lexeme `index`."""
        depth = 0
        for i in range(index, len(self.lexemes)):
            text = self.lexemes[i].text
            depth += (text in _OPENERS) - (text in _CLOSERS)
            if depth < 0 or (depth == 0 and i > index and text in _LOOSE):
                return i
        return len(self.lexemes)


_OPENERS = ("(", "[", "{")
_CLOSERS = (")", "]", "}")
_LOOSE = frozenset(
    {"and", "&", "&&", "or", "|", "||", "xor", "->", "=>", "implies", "<->", "<=>", "iff"}
    | {":", "=", ",", ";", "then", "else", "if", *(word for word, each in OPERATORS.items() if each.binary)}
)
