"""Confidence bounds on a share: exact ones for a fixed number of drives, and betting bounds for any number.

The Clopper-Pearson bounds hold if the number of drives was fixed in advance. The betting bounds hold at every
number of drives at once, so that the drives may be stopped at any time, for example when the bound suffices.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

BETS = 100
"""Number of constant bets in the mixture of the betting bound."""
_TINY = 1e-300
_NARROW = 1e-13
"""Accuracy of bounds, which are rounded outwards."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Lower and upper bound on a share, both in [0, 1]."""

    low: float
    high: float

    @property
    def width(self) -> float:
        """Difference of the bounds."""
        return self.high - self.low


# ---------------------------------------------------------------------- a fixed number of drives


def regularised_beta(x: float, a: float, b: float) -> float:
    """Regularised incomplete beta function I_x(a, b) for x in [0, 1] and positive a and b.

    The continued fraction (NIST DLMF 8.17.22) is evaluated by the modified method of Lentz. The relative
    error is below 1e-9 for a + b up to 1e5.
    """
    if x <= 0.0 or x >= 1.0:
        return 0.0 if x <= 0.0 else 1.0
    if x > (a + 1.0) / (a + b + 2.0):
        return 1.0 - regularised_beta(1.0 - x, b, a)
    log_beta = math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
    front = a * math.log(x) + b * math.log1p(-x) - log_beta
    return math.exp(front) / (a * _fraction(x, a, b))


def _fraction(x: float, a: float, b: float) -> float:
    """Continued fraction 1 + d1 / (1 + d2 / (1 + …)) of the incomplete beta function."""
    total, numerator, inverse = 1.0, 1.0, 0.0
    terms = 200 + 10 * math.isqrt(int(a + b))  # more than are needed
    for term in range(1, terms):
        half = term // 2
        if term % 2:
            factor = -(a + half) * (a + b + half) * x / ((a + 2 * half) * (a + 2 * half + 1))
        else:
            factor = half * (b - half) * x / ((a + 2 * half - 1) * (a + 2 * half))
        inverse = 1.0 / (1.0 + factor * inverse or _TINY)
        numerator = 1.0 + factor / numerator or _TINY
        total *= inverse * numerator
        if abs(inverse * numerator - 1.0) < 1e-15:
            break
    return total


def clopper_pearson_lower(successes: int, trials: int, confidence: float = 0.95) -> float:
    """One-sided exact lower bound on a share, from independent trials whose number was fixed in advance.

    The bound is the share at which `successes` or more would occur with probability 1 - `confidence` (C. J.
    Clopper and E. S. Pearson, Biometrika 26, 1934).

    Raises:
        ValueError: the counts are negative or contradict each other, or the confidence is not in (0, 1).
    """
    _require(successes, trials, confidence)
    if successes == 0:
        return 0.0
    miss = 1.0 - confidence
    return _bisected(lambda p: regularised_beta(p, successes, trials - successes + 1) <= miss)


def clopper_pearson_upper(successes: int, trials: int, confidence: float = 0.95) -> float:
    """One-sided exact upper bound on a share; see `clopper_pearson_lower`."""
    _require(successes, trials, confidence)
    return 1.0 - clopper_pearson_lower(trials - successes, trials, confidence)


def clopper_pearson(successes: int, trials: int, confidence: float = 0.95) -> Bounds:
    """Two-sided exact interval of a share: each end has half of the probability 1 - `confidence`."""
    sided = 0.5 + confidence / 2
    low = clopper_pearson_lower(successes, trials, sided)
    return Bounds(low, clopper_pearson_upper(successes, trials, sided))


def _bisected(below: Callable[[float], bool]) -> float:
    """Largest number in [0, 1] at which the decreasing condition `below` holds, rounded down."""
    low, high = 0.0, 1.0
    while high - low > _NARROW:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if below(middle) else (low, middle)
    return low


def _require(successes: int, trials: int, confidence: float) -> None:
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes in {trials} trials")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"the confidence {confidence} is not between 0 and 1")


# ---------------------------------------------------------------------- any number of drives


@dataclass(frozen=True, slots=True)
class Tally:
    """Observed values in [0, 1], grouped: distinct values, (k,) ascending, and how often each occurred, (k,).

    Betting bounds depend on nothing else.
    """

    values: NDArray[np.float64]
    counts: NDArray[np.int64]

    @property
    def pairs(self) -> list[list[float]]:
        """Pairs [value, count]."""
        return [[float(v), int(count)] for v, count in zip(self.values, self.counts, strict=True)]

    @classmethod
    def of(cls, observed: ArrayLike) -> Tally:
        """Group observations, (n,). Raises ValueError if one is outside of [0, 1]."""
        values, counts = np.unique(np.asarray(observed, dtype=np.float64), return_counts=True)
        if not bool(((values >= 0.0) & (values <= 1.0)).all()):
            raise ValueError("an observation is outside of [0, 1]")
        return cls(values, counts)

    @classmethod
    def counted(cls, successes: int, trials: int) -> Tally:
        """Successes and failures as observations 1 and 0."""
        return cls(np.array([0.0, 1.0]), np.array([trials - successes, successes]))

    @property
    def flipped(self) -> Tally:
        """The observations 1 - x."""
        return Tally(1.0 - self.values[::-1], self.counts[::-1])


@cache
def _bets() -> NDArray[np.float64]:
    """Constant bets, (BETS,), each a share of the capital: Chebyshev nodes of [0, 1], equally weighted.

    They approximate the arcsine distribution: small bets, which suit many drives with failures, and bets near
    1, which suit drives without a failure, have more weight than those between.
    """
    angles = (2 * np.arange(BETS) + 1) * (np.pi / (2 * BETS))
    return np.asarray((1.0 - np.cos(angles)) / 2)


def log_capital(tally: Tally, mean: float) -> float:
    """Logarithm of the capital won by betting against "the mean of each observation is at most `mean`".

    A bet of the share u of the capital multiplies it by 1 - u + u x / mean at an observation x. The capital
    is the mean over several constant bets, and starts at 1. While the hypothesis is true, the capital is a
    nonnegative supermartingale: with probability 1 - a it never reaches 1 / a, however long it is watched
    (Ville's inequality). For observations 0 and 1 it is a mixture of binomial likelihood ratios.

    Source: I. Waudby-Smith and A. Ramdas, Estimating means of bounded random variables by betting, Journal of
    the Royal Statistical Society B 86, 2024; the mixture of constant bets is our choice among its bets.
    """
    if mean <= 0.0:
        return math.inf if bool((tally.values * tally.counts).any()) else 0.0
    bets = _bets()[:, None]
    gains = np.log1p(bets * (tally.values / mean - 1.0)) @ tally.counts
    top = float(gains.max())
    return top + math.log(float(np.exp(gains - top).mean()))


def betting_lower(tally: Tally, confidence: float = 0.95) -> float:
    """One-sided lower bound on the mean of observations in [0, 1], valid at any stopping time.

    With probability `confidence` the bound is at most the mean after every number of observations, if each
    observation has the same mean given the earlier ones. Independent, identically distributed ones do.

    Raises:
        ValueError: the confidence is not in (0, 1).
    """
    _require(0, 0, confidence)
    enough = -math.log1p(-confidence)
    return _bisected(lambda mean: log_capital(tally, mean) >= enough)


def betting_upper(tally: Tally, confidence: float = 0.95) -> float:
    """One-sided upper bound on the mean of observations in [0, 1], valid at any stopping time."""
    return 1.0 - betting_lower(tally.flipped, confidence)


def betting(tally: Tally, confidence: float = 0.95) -> Bounds:
    """Two-sided interval of the mean of observations in [0, 1], valid at any stopping time.

    Each end has half of the probability 1 - `confidence`.
    """
    sided = 0.5 + confidence / 2
    return Bounds(betting_lower(tally, sided), betting_upper(tally, sided))


# ---------------------------------------------------------------------- planning


def drives_needed(
    share: float, confidence: float = 0.95, *, failures: int = 0, any_time: bool = False
) -> int:
    """Smallest number of drives that certify `share` if `failures` of them fail.

    Args:
        share: share of drives to certify, in (0, 1).
        confidence: confidence of the certificate, in (0, 1).
        failures: number of drives that fail.
        any_time: whether the drives are stopped by their results (betting bound), or their number is fixed in
            advance (Clopper-Pearson).

    Raises:
        ValueError: an argument is outside of its range.
    """
    _require(0, failures, confidence)
    if not 0.0 < share < 1.0:
        raise ValueError(f"the share {share} is not between 0 and 1")
    few, many = failures, failures + 1
    while not certifies(many - failures, many, share, confidence, any_time=any_time):
        few, many = many, 2 * many
    while many - few > 1:
        middle = (few + many) // 2
        found = certifies(middle - failures, middle, share, confidence, any_time=any_time)
        few, many = (few, middle) if found else (middle, many)
    return many


def certifies(successes: int, trials: int, share: float, confidence: float, *, any_time: bool) -> bool:
    """True if the lower bound on the share, from `successes` in `trials`, is at least `share`.

    `any_time`: whether the trials are stopped by their results (betting bound), or their number is fixed in
    advance (Clopper-Pearson).
    """
    if any_time:
        return log_capital(Tally.counted(successes, trials), share) >= -math.log1p(-confidence)
    return successes > 0 and regularised_beta(share, successes, trials - successes + 1) <= 1.0 - confidence


# ---------------------------------------------------------------------- text


def floored(share: float) -> str:
    """Format a lower bound on a share, rounded down to two decimals of a percent."""
    return f"{math.floor(1e4 * share + 1e-9) / 100:.2f} %"


def raised(share: float) -> str:
    """Format an upper bound on a share, rounded up to two decimals of a percent."""
    return f"{math.ceil(1e4 * share - 1e-9) / 100:.2f} %"
