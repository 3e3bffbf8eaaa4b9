"""Sample history of a stream: columns that grow at the end and are trimmed at the front."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

_SPARE = 64
"""Rows that are free after the columns were moved."""


class SampleHistory:
    """Columns (samples, 1) of consecutive samples; appending one takes amortized constant time.

    Attributes:
        first: number of the first stored sample.
        samples: total number of samples taken in.
    """

    def __init__(self) -> None:
        self.first = 0
        self.samples = 0
        self._rows: dict[str, Floats] = {}
        self._origin = 0
        self._room = 0

    def take(self, columns: Mapping[str, Floats], count: int) -> None:
        """Append samples. Raises KeyError for columns with other names than those before."""
        if self.samples + count - self._origin > self._room:
            self._move(columns, count)
        begin = self.samples - self._origin
        for name, rows in self._rows.items():
            rows[begin : begin + count] = columns[name]
        self.samples += count

    def _move(self, columns: Mapping[str, Floats], count: int) -> None:
        kept = slice(self.first - self._origin, self.samples - self._origin)
        number = self.samples - self.first
        self._room = 2 * (number + count) + _SPARE
        moved = {name: np.empty((self._room, 1)) for name in columns}
        for name, old in self._rows.items():
            moved[name][:number] = old[kept]
        self._rows, self._origin = moved, self.first

    def columns(self, first: int | None = None, stop: int | None = None) -> dict[str, Floats]:
        """Views of the stored samples from `first` up to `stop`."""
        low = max(self.first if first is None else first, self.first) - self._origin
        high = min(self.samples if stop is None else stop, self.samples) - self._origin
        return {name: rows[low:high] for name, rows in self._rows.items()}

    def forget(self, before: int) -> None:
        """Forget the samples before one; their memory is freed when the columns are next moved."""
        self.first = min(max(before, self.first), self.samples)
