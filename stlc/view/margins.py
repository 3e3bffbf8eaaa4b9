"""A recorded trace with the robustness of every requirement at every instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Margins:
    """Robustness per requirement.

    Attributes:
        names: of the requirements.
        rho: (requirements, traces, samples): the value of each requirement where a window that starts
            at the sample fits, NaN elsewhere.
    """

    names: tuple[str, ...]
    rho: Array

    def of(self, name: str) -> Array:
        """(traces, samples) of one requirement."""
        values: Array = self.rho[self.names.index(name)]
        return values

    @property
    def least(self) -> Array:
        """(traces,) the least value over requirements and instants; +inf where nothing was judged."""
        least: Array = np.nan_to_num(self.rho, nan=np.inf).min(axis=(0, 2))
        return least
