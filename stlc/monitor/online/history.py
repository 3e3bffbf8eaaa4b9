"""Storage of growing time series (columns): rows are added or replaced at the end, dropped at the front."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

_SPARE = 64
"""Rows that are free after the columns were moved."""


class ColumnHistory:
    """Storage of time series (columns) in arrays (rows, width) that grow by one row per sample.

    Appending a row takes amortized constant time.

    Attributes:
        first: index of the first stored sample.
        samples: total number of samples received.
    """

    def __init__(self) -> None:
        self.first = self.samples = 0
        self._rows: dict[str, Floats] = {}
        self._origin = self._room = 0

    def take(self, columns: Mapping[str, Floats], count: int) -> None:
        """Append `count` samples to all series; `columns` maps their names to arrays (count, width)."""
        start, stop = self.samples - self._origin, self.samples - self._origin + count
        if stop > self._room:
            kept = self.samples - self.first
            self._room = 2 * (kept + count) + _SPARE
            moved = {name: np.zeros((self._room, rows.shape[1])) for name, rows in columns.items()}
            for name, old in self._rows.items():
                moved[name][:kept] = old[start - kept : start]
            self._rows, self._origin, start, stop = moved, self.first, kept, kept + count
        for name, rows in self._rows.items():
            rows[start:stop] = columns[name]
        self.samples += count

    def columns(self, first: int | None = None, stop: int | None = None) -> dict[str, Floats]:
        """Return views of the stored rows of all series, from sample `first` to `stop` (exclusive)."""
        low = max(self.first if first is None else first, self.first) - self._origin
        high = (self.samples if stop is None else min(stop, self.samples)) - self._origin
        return {name: rows[low:high] for name, rows in self._rows.items()}

    def forget(self, before: int) -> None:
        """Drop the samples before sample `before`; their memory is freed at the next copy of the arrays."""
        self.first = min(max(before, self.first), self.samples)
