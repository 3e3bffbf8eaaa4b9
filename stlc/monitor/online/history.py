"""Storage of growing time series (columns): samples are added at the end, dropped at the front."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

_FEW = 64
"""Blocks of samples that are not joined, and samples per further block."""


class ColumnHistory:
    """Storage of the latest samples of time series (columns), which is joined when it is read.

    It is also joined when there are many blocks, whose headers would take more memory than their numbers.

    Attributes:
        first: index of the first stored sample.
        samples: total number of samples received.
    """

    def __init__(self) -> None:
        self.first = self.samples = 0
        self._names: tuple[str, ...] = ()
        self._blocks: list[Floats] = []

    def take(self, columns: Mapping[str, Floats]) -> None:
        """Append samples to all series; `columns` maps their names to arrays (count, width)."""
        self._names = tuple(columns)
        self._blocks.append(np.stack([*columns.values()]))
        self.samples += self._blocks[-1].shape[1]
        if len(self._blocks) > _FEW + (self.samples - self.first) // _FEW:
            self.forget(0)

    def columns(self, first: int = 0, stop: int | None = None) -> dict[str, Floats]:
        """Return views of the stored samples of all series, from sample `first` to `stop` (exclusive)."""
        self.forget(0)
        low = max(first, self.first) - self.first
        high = (self.samples if stop is None else min(stop, self.samples)) - self.first
        return dict(zip(self._names, self._blocks[0][:, low:high], strict=True)) if self._names else {}

    def forget(self, before: int) -> None:
        """Drop the samples before sample `before`."""
        first = min(max(before, self.first), self.samples)
        if self._names and (first > self.first or len(self._blocks) > 1):
            joined = np.concatenate(self._blocks, axis=1)
            self._blocks = [joined[:, first - self.first :]]
        self.first = first
