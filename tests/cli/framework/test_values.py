"""Durations and lists of seeds, as they are written."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.diagnostics import UsageError
from stlc.options import MOST_SEEDS, parse_seconds, parse_seeds


@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 5)), min_size=1, max_size=5))
def test_seeds_are_those_of_the_ranges_each_once(ranges: list[tuple[int, int]]) -> None:
    text = ",".join(f"{low}..{low + more}" if more else str(low) for low, more in ranges)
    wanted = [seed for low, more in ranges for seed in range(low, low + more + 1)]
    assert parse_seeds(text) == tuple(dict.fromkeys(wanted))


@pytest.mark.parametrize("text", ["", "x", "3..1", "0..", "..2", "-1", "0,,1", f"0..{MOST_SEEDS}", "1.5"])
def test_other_texts_are_no_seeds(text: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse_seeds(text)
    assert caught.value.diagnostics[0].code == "U101"


@pytest.mark.parametrize(("text", "seconds"), [("60s", 60), ("5 min", 300), ("0.5", 0.5), ("1h", 3600)])
def test_durations(text: str, seconds: float) -> None:
    assert parse_seconds(text) == seconds


@pytest.mark.parametrize("text", ["", "s", "5m", "-1s", "0", "inf", "nan", "5 parsecs"])
def test_other_texts_are_no_durations(text: str) -> None:
    with pytest.raises(UsageError):
        parse_seconds(text)
