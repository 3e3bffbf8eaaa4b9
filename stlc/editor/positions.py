"""Offsets of a text <-> lines and columns as editors count them."""

from __future__ import annotations

import re
from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, TypeAlias

Encoding: TypeAlias = Literal["utf-8", "utf-16", "utf-32"]
"""What a column counts: bytes, 16-bit units, or characters."""

_BREAK = re.compile(r"\r\n|\r|\n")


class Place(NamedTuple):
    """A line and a column, both counted from 0."""

    line: int
    column: int


@dataclass(frozen=True)
class Layout:
    """The lines of a text. Columns beyond the end of a line mean its end, lines beyond the last the end."""

    text: str
    encoding: Encoding = "utf-16"

    @cached_property
    def _lines(self) -> tuple[tuple[int, int], ...]:
        """First offset of every line, and the offset of its break."""
        breaks = [(match.start(), match.end()) for match in _BREAK.finditer(self.text)]
        starts = [0, *(end for _, end in breaks)]
        ends = [*(start for start, _ in breaks), len(self.text)]
        return tuple(zip(starts, ends, strict=True))

    def place(self, offset: int) -> Place:
        """Where the character at `offset` stands."""
        offset = min(max(offset, 0), len(self.text))
        row = bisect_right(self._lines, offset, key=lambda line: line[0]) - 1
        start, end = self._lines[row]
        return Place(row, self._units(self.text[start : min(offset, end)]))

    def offset(self, place: Place) -> int:
        """The offset of a place; a column inside of a character means the character."""
        if place.line < 0:
            return 0
        if place.line >= len(self._lines):
            return len(self.text)
        start, end = self._lines[place.line]
        left = place.column
        for index in range(start, end):
            left -= self._units(self.text[index])
            if left < 0:
                return index
        return end

    @property
    def end(self) -> Place:
        """Behind the last character."""
        return self.place(len(self.text))

    def _units(self, text: str) -> int:
        match self.encoding:
            case "utf-8":
                return len(text.encode("utf-8", "surrogatepass"))
            case "utf-16":
                return len(text) + sum(char > "\uffff" for char in text)
            case _:
                return len(text)
