"""Bounds on shares: against scipy, and their coverage with fixed and with random numbers of drives."""

from __future__ import annotations

import math
from bisect import bisect_left
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special, stats

from stlc.assurance.bounds import (
    Tally,
    betting,
    betting_lower,
    betting_upper,
    certifies,
    clopper_pearson,
    clopper_pearson_lower,
    clopper_pearson_upper,
    drives_needed,
    log_capital,
    regularised_beta,
)

RECALIBRATIONS = 200
POSITIVE = st.floats(-1, 4).map(lambda exponent: 10.0**exponent)
COUNTS = st.integers(1, 3000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


@given(POSITIVE, POSITIVE, st.floats(0, 1))
def test_the_incomplete_beta_function_is_scipys(a: float, b: float, x: float) -> None:
    assert regularised_beta(x, a, b) == pytest.approx(special.betainc(a, b, x), rel=1e-8, abs=1e-14)


@given(COUNTS, st.sampled_from([0.5, 0.9, 0.95, 0.999]))
def test_exact_bounds_are_scipys(counts: tuple[int, int], confidence: float) -> None:
    successes, trials = counts
    exact = stats.binomtest(successes, trials)
    ends = exact.proportion_ci(confidence, method="exact")
    found = clopper_pearson(successes, trials, confidence)
    assert (found.low, found.high) == pytest.approx((ends.low, ends.high), abs=1e-9)
    lower = stats.beta.ppf(1 - confidence, successes, trials - successes + 1) if successes else 0.0
    assert clopper_pearson_lower(successes, trials, confidence) == pytest.approx(lower, abs=1e-9)
    upper = stats.beta.ppf(confidence, successes + 1, trials - successes) if successes < trials else 1.0
    assert clopper_pearson_upper(successes, trials, confidence) == pytest.approx(upper, abs=1e-9)


@given(COUNTS)
def test_any_time_costs_something(counts: tuple[int, int]) -> None:
    tally = Tally.counted(*counts)
    assert betting_lower(tally) <= clopper_pearson_lower(*counts) + 1e-12
    assert betting_upper(tally) >= clopper_pearson_upper(*counts) - 1e-12
    both = betting(tally)
    assert both.low <= betting_lower(tally) <= counts[0] / counts[1] <= betting_upper(tally) <= both.high


@given(st.lists(st.floats(0, 1), min_size=1, max_size=30), st.floats(0.05, 0.95))
def test_the_capital_is_a_product_of_bets(values: list[float], mean: float) -> None:
    """A slow reference: the mean over bets of the product of their gains, drive by drive."""
    angles = [(2 * k + 1) * math.pi / 200 for k in range(100)]
    bets = [(1 - math.cos(angle)) / 2 for angle in angles]
    capital = sum(math.prod(1 - u + u * x / mean for x in values) for u in bets) / len(bets)
    assert log_capital(Tally.of(values), mean) == pytest.approx(math.log(capital), abs=1e-9)


@given(st.lists(st.sampled_from([0.0, 0.25, 1.0]), min_size=1, max_size=40), st.floats(0.1, 0.9))
def test_a_fair_game_does_not_pay(values: list[float], mean: float) -> None:
    """One more drive with a mean of at most the hypothesis does not raise the expected capital."""
    before = math.exp(log_capital(Tally.of(values), mean))
    after = [math.exp(log_capital(Tally.of([*values, last]), mean)) for last in (0.0, 1.0)]
    assert (1 - mean) * after[0] + mean * after[1] <= before * (1 + 1e-9)


def test_values_between_0_and_1_count() -> None:
    whole = betting_lower(Tally.of([1.0] * 50 + [0.0] * 50))
    half = betting_lower(Tally.of([0.5] * 100))
    assert whole < half < 0.5


@pytest.mark.parametrize("bad", [[-0.1], [1.1], [math.nan]])
def test_observations_are_shares(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="outside"):
        Tally.of(bad)


@pytest.mark.parametrize(("successes", "trials", "confidence"), [(3, 2, 0.9), (-1, 2, 0.9), (1, 2, 1.0)])
def test_counts_are_counts(successes: int, trials: int, confidence: float) -> None:
    with pytest.raises(ValueError, match=r"successes|confidence"):
        clopper_pearson_lower(successes, trials, confidence)


@pytest.mark.parametrize(
    ("share", "confidence", "failures", "needed"),
    [(0.99, 0.95, 0, 299), (0.95, 0.95, 0, 59), (0.99, 0.95, 1, 473), (0.999, 0.99, 0, 4603)],
)
def test_the_drives_needed_are_the_known_ones(
    share: float, confidence: float, failures: int, needed: int
) -> None:
    assert drives_needed(share, confidence, failures=failures) == needed
    anytime = drives_needed(share, confidence, failures=failures, any_time=True)
    assert needed < anytime < 2 * needed
    for count, found in ((anytime, True), (anytime - 1, False)):
        assert certifies(count - failures, count, share, confidence, any_time=True) is found


def test_the_page_states_the_drives_needed() -> None:
    page = (Path(__file__).parents[2] / "docs/assurance.md").read_text(encoding="utf-8")
    for share in (0.9, 0.95, 0.99, 0.999):
        fixed, anytime = (drives_needed(share, any_time=each) for each in (False, True))
        assert f"| {f'{share:g}'.removeprefix('0')} | {fixed:,} | {anytime:,} |" in page


@pytest.mark.parametrize("share", [0.6, 0.95])
def test_the_bounds_cover_the_share(share: float) -> None:
    rng = np.random.default_rng(1)
    drawn = rng.binomial(150, share, RECALIBRATIONS)
    for bound in (
        lambda s: clopper_pearson_lower(s, 150, 0.9),
        lambda s: betting_lower(Tally.counted(s, 150), 0.9),
    ):
        assert np.mean([bound(int(s)) <= share for s in drawn]) >= 0.9


def test_stopping_by_the_results_breaks_only_the_exact_bound() -> None:
    """The drives stop as soon as the bound exceeds the true share, which no bound should do."""
    share, most, rng = 0.8, 400, np.random.default_rng(2)
    wrong = {"exact": 0, "any time": 0}
    limits = {
        kind: [
            bisect_left(
                range(n + 1), True, key=lambda s: certifies(s, n, share, 0.9, any_time=kind != "exact")
            )
            for n in range(1, most + 1, 3)
        ]
        for kind in wrong
    }
    for _ in range(RECALIBRATIONS):
        totals = np.cumsum(rng.random(most) < share)[::3]
        for kind, least in limits.items():
            wrong[kind] += bool((totals >= np.array(least)).any())
    assert wrong["any time"] <= 0.1 * RECALIBRATIONS
    assert wrong["exact"] > 0.2 * RECALIBRATIONS
