"""`if … then … else …` between formulas, between bools, and between numbers."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from stlc.diagnostics import SpecError
from stlc.monitor.verdict import Monitor

HEAD = """\
signal x, y
signal p : bool
signal q : bool
signal r : bool
signal f : bool[2]
signal g : bool[2]
"""
SIGNALS = {
    name: np.array(values, float)
    for name, values in zip(
        "xypqr",
        zip(*product([0.3, -0.329, 0.7, 0.0], [0.1, -2.0], [0, 1], [0, 1], [0, 1]), strict=True),
        strict=True,
    )
}
SIGNALS["f"] = np.stack([SIGNALS["p"], SIGNALS["q"]], axis=1)
SIGNALS["g"] = np.stack([SIGNALS["q"], SIGNALS["r"]], axis=1)


def robustness(text: str) -> Any:
    return Monitor(f"{HEAD}require spec: {text}", dt=1).robustness(SIGNALS, end="truncate")


@pytest.mark.parametrize(
    ("choice", "meaning"),
    [
        ("if x > 0 then p else p", "(x > 0 and p) or (not x > 0 and p)"),
        ("if x > 0 then p else q", "(x > 0 and p) or (not x > 0 and q)"),
        ("if x > 0 then y > 0 else q", "(x > 0 and y > 0) or (not x > 0 and q)"),
        ("if p then x > 0 else y > 0", "(p and x > 0) or (not p and y > 0)"),
        ("not if x > 0 then p else q", "(not x > 0 or not p) and (x > 0 or not q)"),
        (
            "if x > 0 then (if y > 0 then p else q) else r",
            "(x > 0 and ((y > 0 and p) or (not y > 0 and q))) or (not x > 0 and r)",
        ),
        ("if next(p) then p else q", "(next(p) and p) or (not next(p) and q)"),
        ("if once x > 0.5 then p else q", "((once x > 0.5) and p) or (not (once x > 0.5) and q)"),
        ("if x > 0 then true else q", "x > 0 or (not x > 0 and q)"),
        ("next(if x > 0 then p else q)", "next((x > 0 and p) or (not x > 0 and q))"),
        ("(if x > 0 then f else g)[1]", "(x > 0 and q) or (not x > 0 and r)"),
        ("next(if x > 0 then f else g)[1]", "next((x > 0 and q) or (not x > 0 and r))"),
        ("(if x > 0 then p else q) == r", "((x > 0 and p) or (not x > 0 and q)) <-> r"),
        ("(if x > 0 then p else q) != r", "((x > 0 and p) or (not x > 0 and q)) xor r"),
        ("rise(if x > 0 then p else q)", "rise((x > 0 and p) or (not x > 0 and q))"),
        ("always[0 s, 2 s] if x > 0 then p else q", "always[0 s, 2 s] ((x > 0 and p) or (not x > 0 and q))"),
    ],
)
def test_a_choice_between_truths_has_the_margin_of_its_condition(choice: str, meaning: str) -> None:
    found, wanted = robustness(choice), robustness(meaning)
    assert np.isfinite(wanted).any()
    np.testing.assert_array_equal(found, wanted)


def test_a_choice_between_bools_is_still_a_number() -> None:
    """It may be kept by `freeze`, be one of several numbers, and stand among numbers."""
    kept = robustness("freeze b = (if x > 0 then p else q) in always[1 s, 1 s] (b or p)")
    plain = robustness("(((x > 0 and p) or (not x > 0 and q)) or next(p))")
    told = plain[:-1] != 0
    np.testing.assert_array_equal(np.sign(kept[:-1][told]), np.sign(plain[:-1][told]))
    number = robustness("(if y > 0 then (if x > 0 then p else q) else 2) >= 1")
    assert set(number) == {-1.0, 0.0, 1.0}


def test_a_choice_between_numbers_asks_only_for_the_truth_of_its_condition() -> None:
    found = robustness("(if x > 0 then y else -y) > 0")
    np.testing.assert_array_equal(found, np.where(SIGNALS["x"] > 0, SIGNALS["y"], -SIGNALS["y"]))
    with pytest.raises(SpecError, match="other times"):
        robustness("(if once x > 0 then y else -y) > 0")


def test_the_bounds_of_an_open_trace_take_the_margin_of_the_condition_in() -> None:
    text = """\
signal x, y, z
signal b : bool
signal c : bool
require r: alw[0, T - 3000 ms) (not x <= -1.24 & if z > 0.47 then b else (c) & (y <= 0.38))
"""
    monitor = Monitor(text, dt=1, horizon=4)
    signals = {
        "x": np.ones(14),
        "y": np.zeros(14),
        "z": np.full(14, 0.799),
        "b": np.zeros(14),
        "c": np.ones(14),
    }
    assert monitor.robustness(signals) == pytest.approx(-0.329)
    assert monitor.bounds(signals)[0] == pytest.approx(-0.329)
    stream = monitor.online()
    for k in range(14):
        stream.push({name: values[k] for name, values in signals.items()})
        for _, low, high in stream.open_starts("r"):
            assert low - 1e-9 <= -0.329 <= high + 1e-9
