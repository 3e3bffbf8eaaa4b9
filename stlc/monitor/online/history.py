"""Storage of growing time series (columns): rows are added or replaced at the end, dropped at the front."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]

_SPARE = 64
"""Rows that are free after the columns were moved."""


class ColumnHistory:
    """Storage of time series (columns) in arrays (rows, width) that grow by one row per sample.

    Appending a row takes amortized constant time.

    Args:
        beyond: number of rows stored after the last sample.
        fill: value of rows that are not written yet: one number, or one number per entry of a row.

    Attributes:
        first: index of the first stored sample.
        samples: total number of samples received.
    """

    def __init__(self, beyond: int = 0, fill: ArrayLike = 0.0) -> None:
        self.first = self.samples = 0
        self._beyond, self._fill = beyond, fill
        self._rows: dict[str, Floats] = {}
        self._origin = self._room = 0

    def grow(self, names: Iterable[str], count: int, width: int = 1) -> None:
        """Append `count` rows of `width` entries with the value `fill` to the columns `names`.

        All calls must have the same `names`.
        """
        stop = self.samples + count + self._beyond
        if stop - self._origin > self._room:
            known = slice(self.first - self._origin, self.samples - self._origin)
            self._room = 2 * (stop - self.first) + _SPARE
            moved = {name: np.full((self._room, width), self._fill) for name in names}
            for name, old in self._rows.items():
                moved[name][: self.samples - self.first] = old[known]
            self._rows, self._origin = moved, self.first
        self.samples += count

    def put(self, name: str, start: int, values: Floats) -> None:
        """Write `values`, (rows, width), to the series `name`; the first row belongs to sample `start`."""
        self._rows[name][start - self._origin : start - self._origin + len(values)] = values

    def take(self, columns: Mapping[str, Floats], count: int) -> None:
        """Append `count` samples to all series; `columns` maps their names to arrays (count, width)."""
        start = self.samples
        self.grow(columns, count, next(iter(columns.values())).shape[1])
        for name in self._rows:
            self.put(name, start, columns[name])

    def columns(self, first: int | None = None, stop: int | None = None) -> dict[str, Floats]:
        """Return views of the stored rows of all series, from sample `first` to `stop` (exclusive)."""
        end = self.samples + self._beyond
        low = max(self.first if first is None else first, self.first) - self._origin
        high = (end if stop is None else min(stop, end)) - self._origin
        return {name: rows[low:high] for name, rows in self._rows.items()}

    def forget(self, before: int) -> None:
        """Drop the samples before sample `before`; their memory is freed at the next copy of the arrays."""
        self.first = min(max(before, self.first), self.samples)
