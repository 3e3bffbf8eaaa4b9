"""Parse failures with the surrounding lexemes, as input of the recognisers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from stlc.grammar.parse.tables import acceptable, parses
from stlc.grammar.scan import Bracket, Lexeme, brackets, lexemes
from stlc.grammar.words import BINARY_TEMPORAL
from stlc.source import Source, Span


@dataclass(frozen=True)
class Piece:
    """Part of a text that is parsed separately: a declaration, or an expression.

    Attributes:
        source: the whole text.
        start: offset of the first character.
        end: offset after the last character.
        rule: start rule of the grammar, `start` or `expr`.
    """

    source: Source
    start: int
    end: int
    rule: str

    @property
    def text(self) -> str:
        """Text of the piece."""
        return self.source.text[self.start : self.end]

    def repaired_by(self, start: int, end: int, replacement: str) -> bool:
        """True if the piece parses with the characters from `start` to `end` replaced."""
        text = self.text[: start - self.start] + replacement + self.text[end - self.start :]
        return parses(text, self.rule)


@dataclass(frozen=True)
class ParseFailure:
    """Position in a piece at which no grammar rule applies."""

    piece: Piece
    at: int

    @cached_property
    def lexemes(self) -> tuple[Lexeme, ...]:
        """All lexemes of the piece."""
        return tuple(lexemes(self.piece.source.text, self.piece.start, self.piece.end))

    @cached_property
    def before(self) -> tuple[Lexeme, ...]:
        """Lexemes before the failure."""
        return tuple(lexeme for lexeme in self.lexemes if lexeme.start < self.at)

    @cached_property
    def after(self) -> tuple[Lexeme, ...]:
        """Lexemes from the failure on."""
        return self.lexemes[len(self.before) :]

    @property
    def previous(self) -> Lexeme | None:
        """Last lexeme before the failure."""
        return self.before[-1] if self.before else None

    @property
    def found(self) -> Lexeme | None:
        """Lexeme at the failure; None at the end of the piece."""
        return self.after[0] if self.after else None

    @cached_property
    def follower(self) -> Lexeme | None:
        """First lexeme after the piece, which starts the next declaration."""
        if self.piece.rule != "start":
            return None
        return next(lexemes(self.piece.source.text, self.piece.end), None)

    @cached_property
    def accepts(self) -> frozenset[str]:
        """Terminals of the grammar that are accepted at the failure."""
        return acceptable(self.piece.text, self.piece.rule, even_broken=True) or frozenset()

    @property
    def wants_operand(self) -> bool:
        """True if an operand is expected here."""
        return "NUMBER" in self.accepts and "NAME" in self.accepts

    @property
    def wants_operator(self) -> bool:
        """True if an operator is accepted here."""
        return "AND" in self.accepts or "CMP" in self.accepts

    @cached_property
    def open_brackets(self) -> list[Bracket]:
        """The brackets that are open here, outermost first."""
        return [bracket for bracket in brackets(self.before) if bracket.closing is None]

    @property
    def span(self) -> Span:
        """Span of the lexeme at the failure, or the position after the last lexeme before it."""
        if self.found is not None:
            return self.of(self.found)
        end = self.previous.end if self.previous is not None else self.piece.start
        return self.piece.source.span(end, end)

    def of(self, first: Lexeme, last: Lexeme | None = None) -> Span:
        """Return the span of a lexeme, or from one lexeme to another."""
        return self.piece.source.span(first.start, (last or first).end)

    def line_with(self, *edits: tuple[int, int, str]) -> str:
        """Return the line of the first edit after all edits, without its comment."""
        source = self.piece.source
        number = source.position(edits[0][0])[0]
        start = source.line_starts[number - 1]
        line = source.line(number)
        written = max((lexeme.end for lexeme in lexemes(line)), default=0)
        line = line[: max(written, *(high - start for _, high, _ in edits))]
        for low, high, replacement in sorted(edits, reverse=True):
            line = line[: low - start] + replacement + line[high - start :]
        return line.strip()

    def operand_before(self, index: int) -> int:
        """Return the index of the first lexeme of the operand that ends before lexeme `index`."""
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
    | {":", "=", ",", ";", "then", "else", "if", *BINARY_TEMPORAL}
)
