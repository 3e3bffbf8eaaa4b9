"""Whole numbers: what is one, whatever its arguments are, compares by `==` and has margins of halves."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.diagnostics import SpecError
from stlc.monitor.verdict import Monitor

HEAD = "signal x [m]\nsignal y\nsignal far [km]\nsignal n, k : int\nsignal b : bool\n"
WHOLE: dict[str, Callable[[SimpleNamespace], float]] = {
    "sign(x)": lambda at: np.sign(at.x),
    "floor(x)": lambda at: np.floor(at.x),
    "ceil(y)": lambda at: np.ceil(at.y),
    "round(y * 3)": lambda at: np.round(at.y * 3),
    "ind(b) + ind(x > 0 m)": lambda at: at.b + (at.x > 0),
    "2 * n - floor(y) * sign(x)": lambda at: 2 * at.n - np.floor(at.y) * np.sign(at.x),
    "n ^ 3": lambda at: at.n**3,
    "min(n, sign(y), 4)": lambda at: min(at.n, np.sign(at.y), 4),
    "abs(clip(n, -2, k))": lambda at: abs(min(max(at.n, -2), at.k)),
    "(if b then n else ind(y > 0))": lambda at: at.n if at.b else float(at.y > 0),
    "relu(n) % 3": lambda at: max(at.n, 0) % 3,
}
REAL = [
    "x",
    "n / 2",
    "n ^ 0.5",
    "n ^ k",
    "n ^ -1",
    "sqrt(n)",
    "sin(n)",
    "floor(y) * 0.5",
    "floor(far)",
    "norm(n, k)",
]


@cache
def monitor(text: str) -> Monitor:
    """`text` beside an int signal, by every sign."""
    signs = {"eq": "==", "ne": "!=", "ge": ">=", "lt": "<"}
    requirements = "".join(f"require {name}: {text} {sign} other\n" for name, sign in signs.items())
    return Monitor(f"{HEAD}signal other: int\n{requirements}require set: {text} in {{2}}\n", dt=1)


@pytest.mark.parametrize("text", WHOLE)
@given(
    x=st.floats(-4, 4),
    y=st.floats(-4, 4),
    n=st.integers(-3, 3),
    k=st.integers(0, 3),
    b=st.integers(0, 1),
    other=st.integers(-4, 4),
)
@settings(max_examples=12)
def test_a_whole_number_is_compared_exactly(text: str, **drawn: float) -> None:
    signals = {name: np.array([value]) for name, value in drawn.items()}
    found = {
        each.name: float(each.robustness)
        for each in monitor(text).check({**signals, "far": signals["x"]}, at=0)
    }
    value = float(WHOLE[text](SimpleNamespace(**drawn)))
    gap = value - drawn["other"]
    exact = {"eq": 0.5 - abs(gap), "ne": abs(gap) - 0.5, "ge": gap + 0.5, "lt": -gap - 0.5}
    assert found == {**exact, "set": 0.5 - abs(value - 2)}


@pytest.mark.parametrize("text", REAL)
def test_a_number_that_need_not_be_whole_is_not(text: str) -> None:
    with pytest.raises(SpecError) as caught:
        Monitor(f"{HEAD}require r: {text} == 2\n", dt=1)
    assert caught.value.diagnostics[0].code == "E204"
