"""Samples that a line needs for its picture: the least and the greatest in each column of pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

COLUMNS = 2_000
"""Columns of a thinned line, more than a panel has pixels at any size that is printed."""


def extremes(*values: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the indices of the samples to draw, ascending, so that the picture stays the same.

    Of each column, these are the samples with the least and the greatest of each of `values`, which are
    arrays of equal shape (samples,). The first and the last sample are kept, and NaN where a column has
    nothing else. A line of at most two samples a column is kept whole.
    """
    count = len(values[0])
    if count <= 2 * COLUMNS:
        return np.arange(count)
    width = -(-count // COLUMNS)
    starts = np.arange(0, count, width)
    kept = [np.array([0, count - 1])]
    for one in values:
        padded = np.full(len(starts) * width, np.nan)
        padded[:count] = one
        columns = padded.reshape(len(starts), width)
        hidden = np.isnan(columns)
        kept.append(starts + np.where(hidden, np.inf, columns).argmin(1))
        kept.append(starts + np.where(hidden, -np.inf, columns).argmax(1))
    return np.unique(np.concatenate(kept))
