"""Conformal lower bounds on the robustness of the next drive, without assumptions about its distribution.

Split conformal prediction needs drives that are exchangeable with the next one. The robust version allows
that the distribution of the next drive has shifted by a stated amount. Online versions bound the robustness
of a drive while it lasts, and of drives whose distribution changes.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stlc.assurance.bounds import certifies
from stlc.diagnostics import usage

Divergence = Literal["tv", "kl", "chi2"]
DIVERGENCES: tuple[Divergence, ...] = get_args(Divergence)
_ROUNDING = 1e-9
_STEPS = 100


# ---------------------------------------------------------------------- shift


@dataclass(frozen=True, slots=True)
class DistributionShift:
    """Largest distance of the distribution Q of future drives from the distribution P of recorded ones.

    Attributes:
        kind: measure of the distance. `tv`: total variation. `kl`: Kullback-Leibler divergence KL(Q || P) in
            nats. `chi2`: Pearson's chi-square divergence.
        size: largest distance.
    """

    kind: Divergence
    size: float

    @classmethod
    def parse(cls, text: str) -> DistributionShift:
        """Parse `0.02` (total variation) or `kl=0.01`. Raises UsageError (U101) for anything else."""
        kind, found, number = text.strip().rpartition("=")
        try:
            size = float(number)
        except ValueError:
            size = math.nan
        for known in DIVERGENCES:
            if known == (kind if found else "tv") and 0.0 <= size < (1.0 if known == "tv" else math.inf):
                return cls(known, size)
        raise usage(f"`--shift {text}` is no distance of distributions", "--shift 0.02", "--shift kl=0.01")

    def __str__(self) -> str:
        return f"{self.kind}={self.size:g}"

    def greatest(self, chance: float) -> float:
        """Greatest probability under Q of an event with probability `chance` under P.

        The distance of the two distributions of "the event occurs" is at most that of Q and P (data
        processing), and the bound is attained. As a function of `chance` it is concave, so it also bounds the
        mean over random events of mean probability `chance` (M. Cauchois, S. Gupta, A. Ali and J. C. Duchi,
        Robust validation, Journal of the American Statistical Association 119, 2024).
        """
        p = min(max(chance, 0.0), 1.0)
        if not self.size:
            return p
        match self.kind:
            case "tv":
                return min(1.0, p + self.size)
            case "chi2":
                return min(1.0, p + math.sqrt(self.size * p * (1.0 - p)))
            case "kl":
                return self._greatest_by_kl(p)

    def _greatest_by_kl(self, p: float) -> float:
        if p in (0.0, 1.0) or -math.log(p) <= self.size:
            return math.ceil(p)
        low, high = p, 1.0
        for _ in range(_STEPS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if _binary_kl(middle, p) <= self.size else (low, middle)
        return high

    def least(self, chance: float) -> float:
        """Least probability under Q of an event with probability `chance` under P."""
        return 1.0 - self.greatest(1.0 - chance) if self.size else chance  # without a rounding error


def _binary_kl(q: float, p: float) -> float:
    """Kullback-Leibler divergence of Bernoulli distributions with success probabilities q and p, in nats."""
    rest = (1.0 - q) * math.log((1.0 - q) / (1.0 - p)) if q < 1.0 else 0.0
    return q * math.log(q / p) + rest


SAME = DistributionShift("tv", 0.0)
"""Future drives are distributed as the recorded ones."""


# ---------------------------------------------------------------------- the next drive


def rank(drives: int, miss: float, shift: DistributionShift = SAME) -> int:
    """Rank k of the conformal bound: the k-th smallest of the recorded values; 0 if there are too few drives.

    The next value lies below the k-th smallest of n exchangeable ones with probability at most k / (n + 1).
    The rank is the greatest one at which this probability, after the shift, is at most `miss`. Without shift
    it is the floor of (n + 1) miss.
    """
    low, high = 0, drives
    while low < high:
        middle = (low + high + 1) // 2
        fits = shift.greatest(middle / (drives + 1)) <= miss + _ROUNDING
        low, high = (middle, high) if fits else (low, middle - 1)
    return low


def _known(values: ArrayLike) -> NDArray[np.float64]:
    """Values of which those that are no numbers are the least, so that they loosen every bound."""
    given = np.asarray(values, dtype=np.float64)
    return np.where(np.isnan(given), -np.inf, given)


def lower_bound(values: ArrayLike, confidence: float = 0.95, shift: DistributionShift = SAME) -> float:
    """Split conformal lower bound on the next value; -inf if there are too few values.

    The next value is at least the bound with probability `confidence`, over the recorded values and the next
    one, if all are exchangeable, or if the next one is drawn from a distribution within `shift` of theirs.

    Args:
        values: recorded values such as the robustness of drives, (n,); NaN counts as -inf.
        confidence: probability that the bound holds.
        shift: distance of the next drive's distribution from that of the recorded drives.

    Sources: V. Vovk, A. Gammerman and G. Shafer, Algorithmic Learning in a Random World, 2005; with shift: M.
    Cauchois et al., 2024, and Y. Zhao, B. Hoxha, G. Fainekos, J. V. Deshmukh and L. Lindemann, Robust
    conformal prediction for STL runtime verification under distribution shift, ICCPS 2024.
    """
    ordered = np.sort(_known(values))
    k = rank(len(ordered), 1.0 - confidence, shift)
    return float(ordered[k - 1]) if k else -math.inf


def drives_for_bound(confidence: float = 0.95, shift: DistributionShift = SAME) -> int | None:
    """Smallest number of drives with which `lower_bound` is finite; None if the shift allows none."""
    miss = 1.0 - confidence
    if shift.greatest(0.0) >= miss - _ROUNDING:
        return None
    few, many = 0, 1
    while not rank(many, miss, shift):
        few, many = many, 2 * many
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (few, middle) if rank(middle, miss, shift) else (middle, many)
    return many


def tolerance_bound(
    values: ArrayLike, share: float, confidence: float = 0.95, *, any_time: bool = False
) -> float:
    """Value that at least the share `share` of all drives reaches, with `confidence`; -inf if unknown.

    It is a recorded value: the greatest one such that the number of recorded values that reach it certifies
    the share (S. S. Wilks, 1941). With `any_time` the bound is valid at any stopping time: the betting test
    at the unknown true quantile is one fixed test, and the test at any greater value has less capital.

    Args:
        values: robustness of independent drives, (n,); NaN counts as -inf.
        share: share of drives, in (0, 1).
        confidence: probability that the bound holds, over the recorded drives.
        any_time: whether the drives are stopped by their results; see `bounds.certifies`.
    """
    ordered = np.sort(_known(values))
    n = len(ordered)
    low, high = 0, n
    while low < high:  # the greatest number of values that may be lost
        middle = (low + high + 1) // 2
        fits = certifies(n - middle + 1, n, share, confidence, any_time=any_time)
        low, high = (middle, high) if fits else (low, middle - 1)
    return float(ordered[low - 1]) if low else -math.inf


# ---------------------------------------------------------------------- while driving


@dataclass(frozen=True, slots=True)
class OnlineBound:
    """Lower bound on the robustness of the present drive, at every step while it lasts.

    At step k the bound is `predicted(k) - radius * scale[k]`. With probability `confidence` it holds at all
    steps of the drive together.

    Attributes:
        scale: typical loss of robustness from the prediction at each step to the end of the drive, (steps,).
        radius: conformal quantile of the greatest relative loss; inf if there were too few drives.
        confidence: probability that all bounds of a drive hold.
        drives: number of drives behind the radius.
    """

    scale: NDArray[np.float64]
    radius: float
    confidence: float
    drives: int

    def lower(self, step: int, predicted: float) -> float:
        """Bound at a step, given the prediction then, such as the robustness of the plan that is followed."""
        return float(predicted - self.radius * self.scale[min(step, len(self.scale) - 1)])

    @property
    def margins(self) -> NDArray[np.float64]:
        """Numbers that are subtracted from the prediction at each step, (steps,)."""
        return self.radius * self.scale


def calibrate_online(
    predicted: ArrayLike, final: ArrayLike, confidence: float = 0.95, shift: DistributionShift = SAME
) -> OnlineBound:
    """Calibrate an online bound from recorded drives that are exchangeable with the next one.

    The scales come from the first third of the drives, the radius from the others, so that the bound is valid
    for any prediction. The greatest scaled loss over the steps of a drive is its score (M. Cleaveland, I.
    Lee, G. J. Pappas and L. Lindemann, Conformal prediction regions for time series using linear
    complementarity programming, AAAI 2024, in its simple form with given scales).

    Args:
        predicted: robustness predicted at each step, (drives, agents, steps); one bound covers all agents.
        final: robustness of the whole drives, (drives, agents); NaN counts as -inf.
        confidence: probability that all bounds of a drive hold.
        shift: distance of the next drive's distribution from that of the recorded drives.
    """
    before = _known(predicted)
    after = _known(final)[:, :, None]
    with np.errstate(invalid="ignore"):
        loss = np.where(np.isneginf(before) | np.isposinf(after), -np.inf, before - after)
    first = len(loss) // 3
    usual = np.where(np.isfinite(loss[:first]), np.abs(loss[:first]), np.nan).reshape(-1, loss.shape[2])
    known = np.isfinite(usual)
    mean = np.where(known, usual, 0.0).sum(0) / np.maximum(known.sum(0), 1)
    scale = np.maximum(mean, 1e-3 * max(float(mean.max(initial=0.0)), 1e-3))
    scores = (loss[first:] / scale).max((1, 2), initial=-math.inf)
    radius = -lower_bound(-scores, confidence, shift)
    return OnlineBound(scale, radius, confidence, len(scores))


@dataclass(frozen=True, slots=True)
class AdaptiveBound:
    """Lower bound on the value of the next drive, for drives whose distribution may change.

    Adaptive conformal inference (I. Gibbs and E. Candès, NeurIPS 2021): after each drive, the probability
    that the bound is missed is lowered if it was missed, and raised if not.

    Attributes:
        low: bound on the next value; inf or -inf if the level is above 1 or at most 0.
        level: present probability of a miss that the bound is computed for.
        judged: number of drives whose bound was compared with their value.
        missed: number of these drives below their bound.
        slack: greatest distance of the share of missed drives from the requested one, whatever the drives
            are.
    """

    low: float
    level: float
    judged: int
    missed: int
    slack: float


def adaptive_bound(values: Sequence[float], confidence: float = 0.95, rate: float = 0.02) -> AdaptiveBound:
    """Follow recorded values in their order, and return the bound on the next one.

    Args:
        values: robustness of drives in the order in which they were driven; NaN counts as -inf.
        confidence: share of bounds that hold in the long run.
        rate: step by which the level changes; large rates follow faster and vary more.
    """
    miss = 1.0 - confidence
    level, missed = miss, 0
    known: list[float] = []
    for value in _known(values).tolist():
        wrong = value < _at_level(known, level)
        missed += wrong
        level += rate * (miss - wrong)
        insort(known, value)
    judged = len(known)
    slack = (max(miss, 1.0 - miss) + rate) / (rate * judged) if judged else math.inf
    return AdaptiveBound(_at_level(known, level), level, judged, missed, slack)


def _at_level(ordered: Sequence[float], level: float) -> float:
    """Conformal bound of ascending values that the next one misses with probability `level`."""
    if level >= 1.0:
        return math.inf
    k = rank(len(ordered), level) if level > 0.0 else 0
    return ordered[k - 1] if k else -math.inf
