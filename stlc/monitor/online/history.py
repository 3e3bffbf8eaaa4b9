"""Storage of growing time series (columns): samples are added at the end, dropped at the front."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]


class ColumnHistory:
    """Storage of the latest samples of time series (columns), which is joined when it is read.

    It is also joined when there are many blocks, whose headers would take more memory than their numbers.

    Attributes:
        first: index of the first stored sample.
        samples: total number of samples received.
    """

    def __init__(self) -> None:
        self.first = self.samples = self._origin = 0
        self._names: tuple[str, ...] = ()
        self._blocks: list[Floats] = []

    def take(self, columns: Mapping[str, Floats]) -> None:
        """Append samples to all series; `columns` maps their names to arrays (count, width)."""
        self._names = tuple(columns)
        self._blocks.append(np.stack([*columns.values()]))
        self.samples += self._blocks[-1].shape[1]
        if len(self._blocks) > 64 + (self.samples - self.first) // 64:
            self.columns()

    def columns(self, first: int = 0, stop: int | None = None) -> dict[str, Floats]:
        """Return views of the stored samples of all series, from sample `first` to `stop` (exclusive)."""
        if len(self._blocks) > 1:
            self._blocks = [np.concatenate(self._blocks, axis=1)[:, self.first - self._origin :]]
            self._origin = self.first
        low = max(first, self.first) - self._origin
        high = None if stop is None else stop - self._origin
        return dict(zip(self._names, self._blocks[0][:, low:high], strict=True)) if self._names else {}

    def forget(self, before: int) -> None:
        """Drop the samples before sample `before`; those of one block are freed together."""
        self.first = min(max(before, self.first), self.samples)
        while len(self._blocks) > 1 and self._origin + self._blocks[0].shape[1] <= self.first:
            self._origin += self._blocks.pop(0).shape[1]
