"""Certificates: what is counted as one observation, and what is said about it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.assurance.bounds import Tally, betting_lower, betting_upper, clopper_pearson_lower
from stlc.assurance.certificate import (
    ALL,
    Assessment,
    Claim,
    Judged,
    Noun,
    Sample,
    StoredStatement,
    joined,
    together,
    wrong_numbers,
)
from stlc.jsontext import plain
from stlc.records import read


def judged(robustness: list[float], name: str = "near") -> Judged:
    values = np.array(robustness, dtype=float)
    known = np.isfinite(values)
    return Judged(name, "m", known & (values >= 0), known & (values < 0), values)


def sample(robustness: list[float], units: list[int] | None = None, noun: Noun = "drive") -> Sample:
    each = judged(robustness)
    where = np.arange(len(robustness)) if units is None else np.array(units)
    return Sample(together([each]), (each,), where, noun)


def test_drives_of_a_world_are_one_observation() -> None:
    found = sample([1, -1, 2, 3, 4, 5], [0, 0, 1, 1, 2, 2], "world").assess(Claim())
    overall = found.overall
    assert (overall.drives, overall.units, overall.satisfied, overall.whole) == (6, 3, 5, 2)
    assert overall.share == pytest.approx(5 / 6)
    assert overall.shares.lower == betting_lower(Tally.of([0.5, 1, 1]))
    assert overall.whole_lower == clopper_pearson_lower(2, 3)
    assert overall.shares.fixed is None
    assert "a world is one observation" in " ".join(found.assumptions)


def test_a_drive_without_a_verdict_counts_against_both_bounds() -> None:
    found = sample([1] * 60 + [-np.inf] * 5).assess(Claim(any_time=True)).overall
    assert (found.satisfied, found.undecided) == (60, 5)
    assert found.shares.lower == betting_lower(Tally.counted(60, 65))
    assert found.shares.upper == betting_upper(Tally.counted(65, 65)) == 1.0
    assert found.next_robustness == -np.inf


def test_all_requirements_are_the_least_of_them_by_weight() -> None:
    near, slow = judged([1, -1, 4]), judged([2, 2, 2], "slow")
    both = together([near, slow], {"slow": 0.5})
    assert (both.name, both.unit) == (ALL, "")
    assert both.robustness.tolist() == [1, -1, 1]
    assert both.satisfied.tolist() == [True, False, True]
    assert together([near]).unit == "m"


def test_samples_are_joined_with_their_worlds_apart() -> None:
    first, second = sample([1, 2], [0, 0], "world"), sample([3, -4], [0, 1], "world")
    found = joined([first, second])
    assert found.units.tolist() == [0, 0, 1, 2]
    assert found.least(found.overall.robustness).tolist() == [1, 3, -4]
    other = Sample(together([judged([1], "far")]), (judged([1], "far"),), np.zeros(1, dtype=int), "drive")
    with pytest.raises(ValueError, match="different requirements"):
        joined([first, other])


@settings(max_examples=12)
@given(
    st.lists(st.sampled_from([-1.0, 1.0, -np.inf]), min_size=1, max_size=80),
    st.booleans(),
    st.sampled_from([None, 0.5, 0.9]),
    st.sampled_from([0.0, 0.05, 0.0123456789]),
)
def test_a_certificate_is_consistent(
    values: list[float], any_time: bool, share: float | None, shift: float
) -> None:
    units = [index // 2 for index in range(len(values))]
    found = sample(values, units, "world").assess(Claim(share, shift=shift, any_time=any_time))
    document: Any = plain(found)
    whole, *each = (read(StoredStatement, one) for one in (document["overall"], *document["requirements"]))
    assert wrong_numbers(whole, each, found.claim, document["answer"]) == []
    bounds = found.overall.shares
    assert 0 <= bounds.interval.low <= bounds.lower <= bounds.upper <= bounds.interval.high <= 1
    assert found.overall.deployed <= bounds.lower
    assert found.exit_code == answer_code(found)


def answer_code(found: Assessment) -> int:
    """The exit code by its definition."""
    share = found.claim.share
    if share is None or found.overall.deployed >= share:
        return 0
    return 1 if found.overall.shares.upper - found.claim.shift < share else 4


def test_only_the_first_units_calibrate_where_results_stop_the_drives() -> None:
    values = [float(value) for value in range(100, 0, -1)]
    assert sample(values).assess(Claim(any_time=True, calibration=40)).overall.next_robustness == 62.0
    assert sample(values).assess(Claim()).overall.next_robustness == 5.0
