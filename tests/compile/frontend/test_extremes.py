"""Extremes over a window in a comparison mean what a direct computation gives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stlc
from stlc.diagnostics import SpecError

SIGNS = {"<": 1, "<=": 1, ">": -1, ">=": -1}


def robustness(text: str, x: np.ndarray, y: np.ndarray, at: int) -> float:
    monitor = stlc.Monitor(f"signal x\nsignal y\nrequire r: {text}", dt=1)
    return float(monitor.robustness({"x": x, "y": y}, at=at))


@settings(max_examples=24)
@given(
    st.sampled_from(["max", "min"]),
    st.tuples(st.integers(-4, 4), st.integers(-4, 4)).map(sorted),
    st.sampled_from(sorted(SIGNS)),
    st.sampled_from(
        ["{w}", "-{w}", "{w} - y", "y - {w}", "2 * {w} + y", "{w} * -3", "y - {w} / -2", "-(y - {w})"]
    ),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_the_robustness_is_that_of_the_number(op, window, sign, form, mirrored, seed):
    low, high = window
    x, y = np.random.default_rng(seed).integers(-9, 10, (2, 9)).astype(float)
    at = 4
    number = form.format(w=f"{op}[{low} s, {high} s](x + y)")
    text = f"2 {sign} {number}" if mirrored else f"{number} {sign} 2"
    peak = getattr(np, op)((x + y)[at + low : at + high + 1])
    value = {
        "{w}": peak, "-{w}": -peak, "{w} - y": peak - y[at], "y - {w}": y[at] - peak,
        "2 * {w} + y": 2 * peak + y[at], "{w} * -3": -3 * peak,
        "y - {w} / -2": y[at] + peak / 2, "-(y - {w})": peak - y[at],
    }[form]  # fmt: skip
    expected = (2 - value) * SIGNS[sign] * (-1 if mirrored else 1)
    assert robustness(text, x, y, at) == pytest.approx(expected)


def test_a_chain_of_comparisons():
    x, y = np.arange(9.0), np.zeros(9)
    assert robustness("1 < max[0 s, 2 s](x) < 9", x, y, 4) == 3.0
    assert robustness("1 < x <= max[-2 s, 0 s](x) < 9", x, y, 4) == 0.0


@pytest.mark.parametrize(
    "text",
    [
        "max[0 s, 1 s](x) == 3",
        "max[0 s, 1 s](x) - min[0 s, 1 s](x) < 3",
        "max[0 s, 1 s](x) * y < 3",
        "2 / max[0 s, 1 s](x) < 3",
        "abs(max[0 s, 1 s](x)) < 3",
        "max[0 s, 1 s](x) in [0, 1]",
        "x > 0 -> max[0 s, 1 s](x)",
        "max[0 s, 1 s](max[0 s, 1 s](x)) < 1",
    ],
)
def test_what_is_not_monotone_is_refused_by_name(text):
    with pytest.raises(SpecError) as caught:
        stlc.Monitor(f"signal x\nsignal y\nrequire r: {text}", dt=1)
    assert "E016" in {one.code for one in caught.value.diagnostics}


def test_a_component_of_a_vector_called_max_is_no_window():
    monitor = stlc.Monitor("signal max: real[2]\nrequire r: max[1] < 3", dt=1)
    assert monitor.robustness({"max": np.array([[0.0, 1.0], [0.0, 5.0]])}, at=0) == 2.0
