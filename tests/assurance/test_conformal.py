"""Conformal bounds: coverage over recalibrations, without and with the stated shift, and while driving."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from stlc.assurance.conformal import (
    calibrate_online,
    drives_for_bound,
    lower_bound,
    parse_shift,
    rank,
    tolerance_bound,
)
from stlc.diagnostics import UsageError

RECALIBRATIONS = 200
SHIFTS = st.floats(0, 0.5)


@given(st.integers(0, 500), st.integers(1, 99))
def test_the_rank_is_the_usual_one(drives: int, percent: int) -> None:
    usual = drives + 1 - math.ceil((drives + 1) * (100 - percent) / 100)
    assert rank(drives, percent / 100) == min(usual, drives)


@given(st.integers(1, 300), SHIFTS)
def test_a_shift_never_raises_the_bound(drives: int, shift: float) -> None:
    values = np.random.default_rng(drives).normal(size=drives)
    assert lower_bound(values, 0.9, shift) <= lower_bound(values, 0.9)


@pytest.mark.parametrize(("text", "shift"), [("0.02", 0.02), ("tv=.1", 0.1), ("0", 0.0)])
def test_a_shift_is_a_total_variation(text: str, shift: float) -> None:
    assert parse_shift(text) == shift


@pytest.mark.parametrize(
    "text", ["", "-1", "1.5", "1", "l2=.1", "kl=.01", "chi2=.01", "tv=", "tv=nan", "inf"]
)
def test_other_shifts_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"U101.*total variation"):
        parse_shift(text)


@given(st.floats(0.01, 0.99), st.floats(0, 0.9))
def test_the_drives_for_a_bound_are_the_fewest(confidence: float, part: float) -> None:
    shift = part * (1 - confidence)
    needed = drives_for_bound(confidence, shift)
    assert needed is not None
    assert math.isfinite(lower_bound(np.zeros(needed), confidence, shift))
    assert lower_bound(np.zeros(needed - 1), confidence, shift) == -math.inf


@pytest.mark.parametrize(("confidence", "needed"), [(0.95, 19), (0.9, 9), (0.5, 1)])
def test_the_drives_for_a_bound_without_a_shift(confidence: float, needed: int) -> None:
    assert drives_for_bound(confidence) == needed


def test_too_large_a_shift_allows_no_bound() -> None:
    assert drives_for_bound(0.95, 0.05) is None
    assert lower_bound(np.zeros(10_000), 0.95, 0.06) == -math.inf


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_the_bound_covers_the_next_drive_under_the_stated_shift(shift: float) -> None:
    """With the probability of the shift the next drive comes from a worse place: the worst case."""
    rng = np.random.default_rng(3)
    covered, naive = [], []
    for _ in range(RECALIBRATIONS):
        drives = rng.standard_t(3, 150)
        bounds = lower_bound(drives, 0.9, shift), lower_bound(drives, 0.9)
        chances = [1 - float(stats.t.cdf(bound, 3)) for bound in bounds]
        for found, chance in zip((covered, naive), chances, strict=True):
            found.append(chance - min(shift, chance))
    assert np.mean(covered) >= 0.9
    assert not shift or np.mean(naive) < 0.9


@pytest.mark.parametrize("any_time", [False, True])
def test_the_share_that_reaches_a_value(any_time: bool) -> None:
    rng = np.random.default_rng(4)
    reached = [
        1 - stats.norm.cdf(tolerance_bound(rng.normal(size=300), 0.9, 0.9, any_time=any_time))
        for _ in range(RECALIBRATIONS)
    ]
    assert np.mean(np.array(reached) >= 0.9) >= 0.9


def test_a_share_is_reached_from_the_drives_needed_on() -> None:
    values = np.arange(299.0)
    assert tolerance_bound(values, 0.99, 0.95) == 0.0
    assert tolerance_bound(values[1:], 0.99, 0.95) == -math.inf


def test_values_that_are_no_numbers_are_the_least() -> None:
    values, least = np.ones(1000), np.ones(1000)
    values[::10], least[::10] = math.nan, -math.inf
    assert lower_bound(values, 0.95) == lower_bound(least, 0.95) == -math.inf
    assert tolerance_bound(values, 0.95, 0.95) == tolerance_bound(least, 0.95, 0.95) == -math.inf
    assert calibrate_online(np.ones((1000, 1, 3)), values[:, None]).radius == math.inf


def paths(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Predictions of two agents at ten steps, which approach the final robustness, and that robustness."""
    final = rng.normal(size=(count, 2))
    error = rng.normal(size=(count, 2, 10)) * np.linspace(1.0, 0.1, 10)
    return final[:, :, None] + error, final


def test_the_online_bound_covers_whole_drives() -> None:
    rng, covered = np.random.default_rng(5), []
    for _ in range(RECALIBRATIONS):
        bound = calibrate_online(*paths(rng, 90), confidence=0.9)
        predicted, final = paths(rng, 40)
        covered.append(float((predicted - bound.margins <= final[:, :, None]).all((1, 2)).mean()))
    assert np.mean(covered) >= 0.89  # 200 times 40 drives: a standard error of about .004
    assert bound.margins[0] > 3 * bound.margins[-1]
    assert bound.lower(3, 1.0) == pytest.approx(1.0 - bound.margins[3])
    assert bound.lower(99, 1.0) == bound.lower(9, 1.0)


def test_predictions_that_are_no_numbers() -> None:
    predicted, final = paths(np.random.default_rng(6), 90)
    predicted[40, 0, 0], predicted[41, 1, 3], final[42, 0] = -np.inf, np.nan, np.inf
    assert math.isfinite(calibrate_online(predicted, final).radius)
    final[43:60] = -np.inf
    assert calibrate_online(predicted, final).radius == math.inf
    assert calibrate_online(predicted[:6], final[:6]).radius == math.inf
