"""What is asked of windows: minimum or maximum, and how many windows of how many rows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias, final

Pick: TypeAlias = Literal["min", "max"]

_SCRATCH = 1 << 21
"""Numbers in the scratch arrays for one signal, about: what stays near the processor."""

_NARROW = 16
"""The fewest columns that are worth a chunk of their own."""


def dual(pick: Pick) -> Pick:
    """The other extremum."""
    return "max" if pick == "min" else "min"


def neutral(pick: Pick) -> float:
    """The extremum of nothing."""
    return math.inf if pick == "min" else -math.inf


@final
@dataclass(frozen=True, slots=True)
class Sliding:
    """`count` windows of `width` rows over an array of `rows` rows; window `j` starts at row `j`.

    There is at least one window, and at most one a row. Rows beyond the array are absent.
    """

    rows: int
    count: int
    width: int

    @property
    def to_end(self) -> bool:
        """Every window reaches the last row: the whole is one block."""
        return self.width >= self.rows

    @property
    def shape(self) -> tuple[int, int]:
        """Blocks that cover all windows, and rows of each; absent rows are in the last ones."""
        if self.to_end:
            return 1, self.rows
        return -(-(self.count + self.width - 1) // self.width), self.width

    @property
    def covered(self) -> int:
        """Rows of all blocks together."""
        blocks, length = self.shape
        return blocks * length

    def chunks(self, batch: int, arrays: int) -> list[slice]:
        """The batch in parts for which so many scratch arrays a signal are small together."""
        parts = max(-(-self.covered * batch * arrays // _SCRATCH), 1)
        size = max(-(-batch // parts), min(batch, _NARROW))
        return [slice(first, min(first + size, batch)) for first in range(0, batch, size)]

    def numbers(self, batch: int, arrays: int) -> int:
        """Numbers of each of so many scratch arrays."""
        return self.covered * int(self.chunks(batch, arrays)[0].stop)
