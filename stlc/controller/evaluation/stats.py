"""Means with 95 % intervals over deployment seeds (Student's t)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist, fmean, stdev

from stlc.jsontext import Num

CONFIDENCE = 0.95
_Z = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)


@dataclass(frozen=True, slots=True)
class MeanInterval:
    """Mean over seeds with its 95 % confidence interval; `low` and `high` are None without an interval."""

    mean: Num
    low: Num | None
    high: Num | None
    values: tuple[Num, ...]

    @classmethod
    def of(cls, values: Sequence[float]) -> MeanInterval:
        """Return the mean of the values, one per seed, with its interval.

        There is no interval if there is only one value or if a value is not finite.
        """
        mean = fmean(values)
        if len(values) < 2 or not all(map(math.isfinite, values)):
            return cls(mean, None, None, tuple(values))
        half = student(len(values) - 1) * stdev(values) / math.sqrt(len(values))
        return cls(mean, mean - half, mean + half, tuple(values))

    @property
    def half(self) -> float | None:
        """Half-width of the interval; None if there is no interval."""
        return None if self.high is None else self.high - self.mean


def student(freedom: int) -> float:
    """97.5 % quantile of Student's t distribution with `freedom` degrees of freedom.

    The quantile is exact for 1 and 2 degrees of freedom. For more, a Cornish-Fisher expansion (Abramowitz &
    Stegun 26.7.5) gives it within 0.13 %.
    """
    if freedom == 1:
        return math.tan(math.pi * CONFIDENCE / 2)
    if freedom == 2:
        return math.sqrt(2 * CONFIDENCE**2 / (1 - CONFIDENCE**2))
    z, n = _Z, freedom
    terms = (
        z,
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return math.fsum(term / n**power for power, term in enumerate(terms))
