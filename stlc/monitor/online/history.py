"""Storage of growing time series (columns): rows are added at the end, dropped at the front."""

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
        self.first = self.samples = self._origin = 0
        self._names: tuple[str, ...] = ()
        self._values = np.zeros((1, 0, 1))

    def take(self, columns: Mapping[str, Floats]) -> None:
        """Append samples to all series; `columns` maps their names to arrays (count, width)."""
        block, start = np.stack([*columns.values()]), self.samples - self._origin
        signals, count, width = block.shape
        if start + count > self._values.shape[1]:
            kept = self.samples - self.first
            moved = np.zeros((signals, 2 * (kept + count) + _SPARE, width))
            moved[:, :kept] = self._values[:, start - kept : start]
            self._names, self._values, self._origin, start = tuple(columns), moved, self.first, kept
        self._values[:, start : start + count] = block
        self.samples += count

    def columns(self, first: int = 0, stop: int | None = None) -> dict[str, Floats]:
        """Return views of the stored rows of all series, from sample `first` to `stop` (exclusive)."""
        low = max(first, self.first) - self._origin
        high = (self.samples if stop is None else min(stop, self.samples)) - self._origin
        return dict(zip(self._names, self._values[:, low:high], strict=True)) if self._names else {}

    def forget(self, before: int) -> None:
        """Drop the samples before sample `before`; their memory is freed at the next copy of the arrays."""
        self.first = min(max(before, self.first), self.samples)
