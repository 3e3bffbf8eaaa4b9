"""Conformal lower bounds on the robustness of the next drive, without assumptions about its distribution.

Split conformal prediction needs drives that are exchangeable with the next one. The robust version allows
that the distribution of the next drive has shifted by a stated total variation. The online version bounds
the robustness of a drive while it lasts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stlc.assurance.bounds import certifies
from stlc.diagnostics import usage

_ROUNDING = 1e-9


def parse_shift(text: str) -> float:
    """Parse a total variation in [0, 1): `0.02` or `tv=0.02`. Raises UsageError (U101) for anything else."""
    try:
        shift = float(text.strip().removeprefix("tv="))
    except ValueError:
        shift = math.nan
    if 0.0 <= shift < 1.0:
        return shift
    raise usage(f"`--shift {text}` is no total variation, a number from 0 to below 1", "--shift 0.02")


# ---------------------------------------------------------------------- the next drive


def rank(drives: int, miss: float, shift: float = 0.0) -> int:
    """Rank k of the conformal bound: the k-th smallest of the recorded values; 0 if there are too few drives.

    The next value lies below the k-th smallest of n exchangeable ones with probability at most k / (n + 1).
    The rank is the greatest one at which this probability plus the shift is at most `miss`. Without shift it
    is the floor of (n + 1) miss.
    """
    return min(drives, max(0, math.floor((drives + 1) * (miss - shift + _ROUNDING))))


def _known(values: ArrayLike) -> NDArray[np.float64]:
    """Values of which those that are no numbers are the least, so that they loosen every bound."""
    given = np.asarray(values, dtype=np.float64)
    return np.where(np.isnan(given), -np.inf, given)


def lower_bound(values: ArrayLike, confidence: float = 0.95, shift: float = 0.0) -> float:
    """Split conformal lower bound on the next value; -inf if there are too few values.

    The next value is at least the bound with probability `confidence`, over the recorded values and the next
    one, if all are exchangeable, or if the next one is drawn from a distribution within `shift` of theirs: a
    total variation is the greatest change of the probability of an event.

    Args:
        values: recorded values such as the robustness of drives, (n,); NaN counts as -inf.
        confidence: probability that the bound holds.
        shift: total variation between the next drive's distribution and that of the recorded drives.

    Sources: V. Vovk, A. Gammerman and G. Shafer, Algorithmic Learning in a Random World, 2005; with shift: M.
    Cauchois, S. Gupta, A. Ali and J. C. Duchi, Robust validation, Journal of the American Statistical
    Association 119, 2024, and Y. Zhao, B. Hoxha, G. Fainekos, J. V. Deshmukh and L. Lindemann, Robust
    conformal prediction for STL runtime verification under distribution shift, ICCPS 2024.
    """
    ordered = np.sort(_known(values))
    k = rank(len(ordered), 1.0 - confidence, shift)
    return float(ordered[k - 1]) if k else -math.inf


def drives_for_bound(confidence: float = 0.95, shift: float = 0.0) -> int | None:
    """Smallest number of drives with which `lower_bound` is finite; None if the shift allows none."""
    miss = 1.0 - confidence
    if shift >= miss - _ROUNDING:
        return None
    return max(1, math.ceil(1.0 / (miss - shift + _ROUNDING)) - 1)


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

    JSON: ClassVar = "margins confidence units=drives"

    scale: NDArray[np.float64]
    radius: float
    confidence: float
    drives: Annotated[int, 0]

    def lower(self, step: int, predicted: float) -> float:
        """Bound at a step, given the prediction then, such as the robustness of the plan that is followed."""
        return float(predicted - self.radius * self.scale[min(step, len(self.scale) - 1)])

    @property
    def margins(self) -> NDArray[np.float64]:
        """Numbers that are subtracted from the prediction at each step, (steps,)."""
        return self.radius * self.scale


def calibrate_online(
    predicted: ArrayLike, final: ArrayLike, confidence: float = 0.95, shift: float = 0.0
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
        shift: total variation between the next drive's distribution and that of the recorded drives.
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
