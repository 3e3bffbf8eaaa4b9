"""Means with 95 % intervals over deployment seeds (Student's t)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from statistics import fmean, stdev
from typing import Any

from stlc.jsontext import Num


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


@cache
def student(freedom: int) -> float:
    """97.5 % quantile of Student's t distribution with `freedom` degrees of freedom."""
    from mpmath import betainc, findroot  # torch brings it

    def above(t: float) -> Any:
        return betainc(freedom / 2, 0.5, 0, freedom / (freedom + t * t), regularized=True) - 0.05

    return float(findroot(above, (1.0, 20.0), solver="anderson"))
