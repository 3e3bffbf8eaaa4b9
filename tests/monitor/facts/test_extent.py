"""Samples that a formula can read: no other sample changes its robustness."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.monitor.facts.extent import samples_read
from stlc.monitor.verdict import Monitor

SAMPLES = 12
FORMULAS = [
    "x < 3",
    "historically[0 s, 2 s] x < 3",
    "always[2 s, 4 s] x < 3",
    "x > 1 -> eventually[0 s, 3 s] x < 0",
    "always[0 s, 2 s] once[0 s, 3 s] x < 1",
    "always@[3 s, 5 s] x < 3",
    "x < 3 until[1 s, 4 s] x > 2",
    "next(next(x < 3))",
    "eventually[1 s, 2 s] shift(x, 2) > 0",
    "always[0 s, 1 s] x < 3 and always[5 s, 6 s] x > 0",
    "freeze x0 = x in eventually[0 s, 2 s] x > x0",
    "always[3 s, inf] x < 2",
]


def read(text: str) -> list[range]:
    (rule,) = Monitor(f"signal x\nrequire r: {text}", dt=1.0).compiled.requirements
    return list(samples_read(rule.formula, range(1), SAMPLES))


@pytest.mark.parametrize("text", FORMULAS)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_sample_that_is_not_read_changes_nothing(text: str, seed: int) -> None:
    rng, ranges = np.random.default_rng(seed), read(text)
    assert ranges
    x = rng.normal(size=SAMPLES)
    others = np.setdiff1d(
        np.arange(SAMPLES),
        np.concatenate([np.arange(SAMPLES)[each] for each in (slice(r.start, r.stop) for r in ranges)]),
    )
    assert len(others)
    changed = x.copy()
    changed[others] = 5.0 * rng.normal(size=len(others))
    monitor = Monitor(f"signal x\nrequire r: {text}", dt=1.0)
    assert monitor.check({"x": x})["r"].bounds == monitor.check({"x": changed})["r"].bounds


@pytest.mark.parametrize(
    ("text", "ranges"),
    [
        ("x < 3", [range(1)]),
        ("always[2 s, 4 s] x < 3", [range(2, 5)]),
        ("always@[3 s, 5 s] x < 3", [range(3, 6)]),
        ("always[0 s, 1 s] x < 3 and always[5 s, 6 s] x > 0", [range(2), range(5, 7)]),
        ("always x < 3", []),
        ("always[0 s, 11 s] x < 3", []),
        ("always[4 s, 90 s] x < 3", [range(4, 12)]),
        ("always (x > 1 -> once[0 s, 2 s] x < 0)", []),
    ],
)
def test_samples(text: str, ranges: list[range]) -> None:
    assert read(text) == ranges


def test_starts_that_were_chosen_are_known() -> None:
    (rule,) = Monitor("signal x\nrequire r: x < 3", dt=1.0).compiled.requirements
    assert samples_read(rule.formula, range(4, 5), SAMPLES) == ()
