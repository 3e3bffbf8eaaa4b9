"""Source texts and locations (spans) in them."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from functools import cached_property


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
class Span:
    """A location in a source: the characters from offset `start` to offset `end` (exclusive)."""

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
    def text(self) -> str:
        """Text at this location."""
        return self.source.text[self.start : self.end]

    def to(self, other: Span) -> Span:
        """Location from the start of this one to the end of `other`."""
        return Span(self.source, self.start, other.end)
