"""Failures of the parser, with the tokens around them: the input of the hints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from stlc.grammar.scan import Bracket, Lexeme, brackets, lexemes
from stlc.source import Source, Span


@dataclass(frozen=True)
class Piece:
    """A part of a text that is parsed for itself: a declaration, or an expression.

    Attributes:
        source: the whole text.
        start: offset of the first character.
        end: offset behind the last one.
        rule: start rule of the grammar, `start` or `expr`.
        accepts: the terminals that may stand where the parser gives up on a text.
        parses: whether a text can be parsed.
    """

    source: Source
    start: int
    end: int
    rule: str
    accepts: Callable[[str, str], frozenset[str]]
    parses: Callable[[str, str], bool]

    @property
    def text(self) -> str:
        """The characters of the piece."""
        return self.source.text[self.start : self.end]

    def edited(self, start: int, end: int, replacement: str) -> str:
        """The piece with the characters from offset `start` to `end` replaced."""
        return self.text[: start - self.start] + replacement + self.text[end - self.start :]

    def repaired_by(self, start: int, end: int, replacement: str) -> bool:
        """True if that edit makes it parse."""
        return self.parses(self.edited(start, end, replacement), self.rule)


@dataclass(frozen=True)
class ParseFailure:
    """The place in a piece at which no rule goes on."""

    piece: Piece
    at: int

    @cached_property
    def lexemes(self) -> tuple[Lexeme, ...]:
        """All lexemes of the piece."""
        return tuple(lexemes(self.piece.source.text, self.piece.start, self.piece.end))

    @cached_property
    def before(self) -> tuple[Lexeme, ...]:
        """The lexemes that the parser took."""
        return tuple(lexeme for lexeme in self.lexemes if lexeme.start < self.at)

    @cached_property
    def after(self) -> tuple[Lexeme, ...]:
        """The lexeme that it did not take, and those behind it."""
        return self.lexemes[len(self.before) :]

    @property
    def previous(self) -> Lexeme | None:
        """The last lexeme that the parser took."""
        return self.before[-1] if self.before else None

    @property
    def found(self) -> Lexeme | None:
        """The lexeme that it did not take; None at the end of the piece."""
        return self.after[0] if self.after else None

    @cached_property
    def follower(self) -> Lexeme | None:
        """The text behind the piece: the start of the next declaration."""
        if self.piece.rule != "start":
            return None
        return next(lexemes(self.piece.source.text, self.piece.end), None)

    @cached_property
    def accepts(self) -> frozenset[str]:
        """The terminals that could have stood here."""
        return self.piece.accepts(self.piece.text, self.piece.rule)

    @property
    def wants_operand(self) -> bool:
        """True if an expression, or a part of one, should begin here."""
        return "NUMBER" in self.accepts and "NAME" in self.accepts

    @property
    def wants_operator(self) -> bool:
        """True if an expression could go on here."""
        return "AND" in self.accepts or "CMP" in self.accepts

    @cached_property
    def open_brackets(self) -> list[Bracket]:
        """The brackets that are open here, outermost first."""
        return [bracket for bracket in brackets(self.before) if bracket.closing is None]

    @property
    def span(self) -> Span:
        """The lexeme that the parser did not take, or the place behind the last one it took."""
        if self.found is not None:
            return self.of(self.found)
        end = self.previous.end if self.previous is not None else self.piece.start
        return self.piece.source.span(end, end)

    def of(self, first: Lexeme, last: Lexeme | None = None) -> Span:
        """The span of a lexeme, or from one to another."""
        return self.piece.source.span(first.start, (last or first).end)

    def line_with(self, *edits: tuple[int, int, str]) -> str:
        """The line of the first edit as it reads with all edits done, without its comment."""
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
        """Index of the first lexeme of the operand that ends before lexeme `index`."""
        depth = 0
        for i in range(index - 1, -1, -1):
            text = self.lexemes[i].text
            depth += (text in _CLOSERS) - (text in _OPENERS)
            if depth < 0 or (depth == 0 and text in _LOOSE):
                return i + 1
        return 0

    def operand_after(self, index: int) -> int:
        """Index behind the last lexeme of the operand that begins with lexeme `index`."""
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
    | {":", "=", ",", ";", "then", "else", "if", "until", "U", "release", "unless", "since"}
)
