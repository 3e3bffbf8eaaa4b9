"""Source texts and locations (spans) in them."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar


@dataclass(frozen=True)
class Source:
    """A text, and its name in messages: the path of its file as the user gave it.

    Attributes:
        name: path of the file.
        text: the whole text.
        root: folder that names in the text do not leave, the folder of a run; "" if they may lead anywhere.
    """

    name: str
    text: str = field(repr=False)
    root: str = field(default="", repr=False, compare=False)

    @cached_property
    def line_starts(self) -> tuple[int, ...]:
        """Offset of the first character of every line."""
        breaks = [i + 1 for i, char in enumerate(self.text) if char == "\n"]
        return (0, *breaks)

    def position(self, offset: int) -> tuple[int, int]:
        """Line and column of `offset`, both counted from 1."""
        row = bisect_right(self.line_starts, offset) - 1
        return row + 1, offset - self.line_starts[row] + 1

    def line(self, number: int) -> str:
        """Text of line `number` (from 1), without its line break."""
        start = self.line_starts[number - 1]
        end = self.text.find("\n", start)
        return self.text[start : None if end < 0 else end].rstrip("\r")

    def span(self, start: int, end: int) -> Span:
        """Location from offset `start` to offset `end` (exclusive)."""
        return Span(self, start, end)


@dataclass(frozen=True, slots=True)
class Position:
    """Line and column, from 1."""

    line: int
    column: int


@dataclass(frozen=True, slots=True)
class Range:
    """Positions of the first character, and of that after the last one."""

    start: Position
    end: Position


@dataclass(frozen=True, slots=True)
class Span:
    """A location in a source: the characters from offset `start` to offset `end` (exclusive)."""

    JSON: ClassVar = "line column"

    source: Source
    start: int
    end: int

    @property
    def line(self) -> int:
        """Line of the first character, from 1."""
        return self.source.position(self.start)[0]

    @property
    def column(self) -> int:
        """Column of the first character, from 1."""
        return self.source.position(self.start)[1]

    @property
    def range(self) -> Range:
        """Positions of both ends."""
        return Range(*(Position(*self.source.position(offset)) for offset in (self.start, self.end)))

    @property
    def text(self) -> str:
        """Text at this location."""
        return self.source.text[self.start : self.end]

    def to(self, other: Span) -> Span:
        """Location from the start of this one to the end of `other`."""
        return Span(self.source, self.start, other.end)

    def label(self, text: str = "") -> Label:
        """This location as a secondary one of a finding, with the text shown beside it."""
        return Label(self, text)


@dataclass(frozen=True, slots=True)
class Label:
    """A secondary source location of a finding, and the text shown beside it."""

    JSON: ClassVar = "file=span.source.name range=span.range text"

    span: Span
    text: str = ""
