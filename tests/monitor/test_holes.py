"""Samples that are not known: verdicts hold whatever is put into the holes, and streams say the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers import formula_strategies as random_formulas
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir.holes import partial
from stlc.compile.ir.simplify import simplify
from stlc.monitor.explain.report import explain
from stlc.monitor.online.online import How
from stlc.monitor.values import Record, bounds, window_bounds
from stlc.monitor.verdict import Monitor

NAN = float("nan")


def holed(trace: dict[str, np.ndarray], seed: int, share: float) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: np.where(rng.random(x.shape) < share, NAN, x) for name, x in trace.items()}


def filled(trace: dict[str, np.ndarray], seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {name: np.where(np.isnan(x), rng.integers(-40, 40, x.shape) / 8, x) for name, x in trace.items()}


@settings(max_examples=12, deadline=None)
@given(
    written=random_formulas.formulas(held=()),
    trace=random_formulas.traces(1, 14, 2),
    ends=st.sampled_from(["open", "truncate"]),
    window=st.none() | st.integers(0, 5),
    seed=st.integers(0, 2**32 - 1),
    share=st.sampled_from([0.05, 0.3, 1.0]),
)
def test_bounds_hold_for_every_filling(written, trace, ends, window, seed, share) -> None:
    formula = simplify(random_formulas.GRID.lower(written, []))
    unknown = holed(trace, seed, share)
    record = Record.of(unknown, NUMPY)
    starts = range(record.samples)

    def judged(record: Record) -> Any:
        if window is None:
            return bounds(formula, record, starts, ends)
        return window_bounds(formula, record, starts, window, ends)

    low, high = judged(record)
    assert not np.isnan(low).any()
    assert not np.isnan(high).any()
    for k in range(4):
        least, most = judged(Record(filled(unknown, seed + k), NUMPY))
        assert (low <= least).all()
        assert (high >= most).all()
    least, most = judged(Record(trace, NUMPY))
    assert (low <= least).all()
    assert (high >= most).all()


REQUIREMENTS = {
    "bounded": "always[0 s, 0.4 s] (a > 0 or b > 0)",
    "windowed": "a > 0 -> eventually[0, T] b > 0",
    "beyond": "always[0, T] (a > -1 or eventually[0 s, 0.4 s] b > 0)",
    "window_to_end": "always[0, T] (once[0 s, 0.2 s] a > 0 or eventually[0, end] b > 0)",
    "always": "always (a > 1 -> eventually[0 s, 0.3 s] b > 0)",
    "whole_past": "always (once a > 1 or historically b > -1)",
    "under_a_window": "eventually[0 s, 0.4 s] always a > -1",
    "chosen": "always[0, T] (if a > 0 then b else 1) > 0",
    "frozen": "freeze a0 = a in always[0 s, 0.3 s] abs(b - a0) < 2",
    "change": "always[0, T] abs(delta(a)) < 2",
}


@pytest.mark.parametrize("name", REQUIREMENTS)
@settings(max_examples=6, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    samples=st.integers(1, 25),
    end=st.sampled_from(["open", "truncate"]),
    tolerance=st.sampled_from([1e-6, 0.0]),
)
def test_verdicts_with_holes(name: str, seed: int, samples: int, end: Any, tolerance: float) -> None:
    monitor = Monitor(f"signal a\nsignal b\nrequire r: {REQUIREMENTS[name]}\n", dt=0.1, horizon=0.6)
    rng = np.random.default_rng(seed)
    whole = {signal: rng.integers(-16, 16, samples) / 8 for signal in ("a", "b")}
    unknown = holed(whole, seed, 0.15)
    judged = monitor.check(unknown, end=end, tolerance=tolerance)["r"]
    for k in range(4):
        full = monitor.check(filled(unknown, seed + k), end=end, tolerance=tolerance)["r"]
        assert not (judged.holds & ~full.holds).any()
        assert not (judged.fails & ~full.fails).any()
    online = monitor.online(How(end=end, tolerance=tolerance, reasons=True))
    for k in range(samples):
        online.push({signal: float(values[k]) for signal, values in unknown.items()})
    tally = online.finish()["r"]
    assert tally.status == judged.overall
    assert (tally.low, tally.high) == (judged.low.min(), judged.high.min())
    cause = explain(monitor.check(unknown, end=end, tolerance=tolerance), "r")
    assert (cause is not None) == (judged.overall == "violated")
    if cause is not None:
        assert all("nan" not in reading.text for reading in cause.readings)
        assert all(not name.startswith("@") for name, _ in cause.tree.leaf.reads)


def test_what_is_known_decides() -> None:
    monitor = Monitor(
        "signal x\nrequire r: always[0 s, 0.4 s] x > 0\nrequire e: eventually[0 s, 0.4 s] x > 2", dt=0.1
    )
    assert monitor.check({"x": [1, NAN, 1, 1, 1]})["r"].status == "inconclusive"
    assert monitor.check({"x": [1, NAN, -1, 1, 1]})["r"].status == "violated"
    assert monitor.check({"x": [1, NAN, 3, 1, 1]})["e"].satisfied is True
    low, high = monitor.bounds({"x": [1, NAN, 1, 1, 1]}, at=0)
    assert (low, high) == (-np.inf, 1.0)
    assert np.isnan(monitor.robustness({"x": [1, NAN, 1, 1, 1]}, at=0))
    signal = monitor.requirement_robustness({"x": [1, NAN, 3, 1, 1, 1, 1]})["e"]
    np.testing.assert_array_equal(signal, [NAN, NAN, 1, NAN, NAN, NAN, NAN])


def test_infinite_values_are_known() -> None:
    monitor = Monitor("signal x\nrequire r: always x > 0", 0.1)
    assert monitor.check({"x": [1.0, np.inf]})["r"].bounds[1] == 1.0
    online = monitor.online()
    online.push({"x": NAN})
    online.push({"x": np.inf})
    assert online.gaps["x"].samples == 1


@pytest.mark.parametrize(
    ("formula", "bounds"),
    [
        ("always a - b > 3", (-np.inf, -4.0)),
        ("always abs(a - b) < 9", (-np.inf, 8.0)),
        ("eventually a < b", (1.0, np.inf)),
        ("0 <= a < b", (-np.inf, np.inf)),
        ("a < (if a - b > 1 then 1 else 2)", (-np.inf, np.inf)),
        ("always[0 s, 0.1 s] ind(a > b) == 1", (-np.inf, -0.5)),
        ("freeze z = a in always b - z < 2", (-np.inf, np.inf)),
    ],
)
@pytest.mark.parametrize("tolerance", [1e-6, 0.0])
def test_the_difference_of_infinities_is_unknown(
    formula: str, bounds: tuple[float, float], tolerance: float
) -> None:
    monitor = Monitor(f"signal a\nsignal b\nrequire r: {formula}", dt=0.1)
    trace = {"a": np.array([np.inf, 1.0]), "b": np.array([np.inf, 2.0])}
    judged, online = monitor.check(trace, tolerance=tolerance)["r"], monitor.online(How(tolerance=tolerance))
    online.feed(trace)
    tally = online.finish()["r"]
    assert judged.bounds == (tally.low, tally.high) == bounds
    low, high = bounds
    wanted = "violated" if high < 0 else "satisfied" if low > 0 else "inconclusive"
    assert judged.status == tally.status == wanted


COMPUTED = {
    "eventually": "eventually R > 1.5",
    "always": "always[0 s, 0.3 s] (R < 2 or b > 0)",
    "windowed": "R > 1 -> eventually[0, T] b > R",
    "window_to_end": "always[0, T] (R > 1 or eventually[0, end] b > 0)",
    "since": "(b >= R) since[0.3 s, inf] (R < shift(b, 1 steps))",
    "frozen": "freeze z = R in eventually[0 s, 0.2 s] b > z",
    "not": "not (R + b > 1 until[0 s, 0.2 s] b > 1)",
    "under_a_window": "eventually[0 s, 0.4 s] always R > 0",
}


@pytest.mark.parametrize("name", COMPUTED)
@settings(max_examples=6, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    samples=st.integers(1, 20),
    end=st.sampled_from(["open", "truncate"]),
    tolerance=st.sampled_from([1e-6, 0.0]),
)
def test_a_function_outside_of_its_domain_is_a_hole(
    name: str, seed: int, samples: int, end: Any, tolerance: float
) -> None:
    computed, holed = (
        Monitor(f"signal a\nsignal b\nrequire r: {COMPUTED[name].replace('R', number)}\n", 0.1, 0.6)
        for number in ("sqrt(a)", "a")
    )
    rng = np.random.default_rng(seed)
    a, b = rng.integers(-1, 5, samples), rng.integers(-16, 16, samples) / 8
    roots = [np.sqrt(x) if x >= 0 else NAN for x in a]
    wanted = holed.check({"a": roots, "b": b}, end=end, tolerance=tolerance)["r"]
    judged = computed.check({"a": a, "b": b}, end=end, tolerance=tolerance)["r"]
    np.testing.assert_array_equal(judged.low, wanted.low)
    np.testing.assert_array_equal(judged.high, wanted.high)
    assert judged.overall == wanted.overall
    online = computed.online(How(end=end, tolerance=tolerance))
    decided = []
    for k in range(samples):
        online.push({"a": float(a[k]), "b": float(b[k])})
        decided += online.verdicts()
    tally = online.finish()["r"]
    assert tally.status == judged.overall
    assert (tally.low, tally.high) == (judged.low.min(), judged.high.min())
    for each in (early for early in decided if early.start < judged.instants):
        assert (judged.fails if each.status == "violated" else judged.holds)[each.start, 0]


@pytest.mark.parametrize(
    ("number", "a", "bounds"),
    [
        ("(if a < 0 then 0 else sqrt(a))", -1.0, (0.0, 0.0)),
        ("(if sqrt(a) > 1 then 1 else 2)", -1.0, (-np.inf, np.inf)),
        ("(if a < 0 or sqrt(a) > 1 then 1 else 2)", -1.0, (1.5, 1.5)),
        ("ind(a > 0 and log(a) > 1)", -1.0, (0.5, 0.5)),
        ("ind(log(a) > 1)", -1.0, (-np.inf, np.inf)),
        ("a / a", 0.0, (-np.inf, np.inf)),
        ("a % a", 0.0, (-np.inf, np.inf)),
        ("a ^ 0.5", -1.0, (-np.inf, np.inf)),
        ("acos(a)", 2.0, (-np.inf, np.inf)),
        ("exp(a) - exp(a)", 1e4, (-np.inf, np.inf)),
        ("sqrt(a * a)", -2.0, (2.0, 2.0)),
    ],
)
def test_what_a_number_outside_of_a_domain_is_worth(
    number: str, a: float, bounds: tuple[float, float]
) -> None:
    monitor = Monitor(f"signal a\nrequire r: {number} >= 0\nrequire s: not ({number} < 0)", dt=0.1)
    verdict = monitor.check({"a": [a]})
    assert verdict["r"].bounds == verdict["s"].bounds == bounds
    online = monitor.online()
    online.push({"a": a})
    assert [(tally.low, tally.high) for tally in online.finish().values()] == [bounds, bounds]
    wanted = bounds[0] if bounds[0] == bounds[1] else NAN
    np.testing.assert_array_equal(monitor.requirement_robustness({"a": [a]})["r"], [wanted])


def test_a_cause_beside_a_number_outside_of_a_domain() -> None:
    monitor = Monitor("signal a\nsignal b\nrequire r: freeze z = sqrt(a) in always (b > z or b > 1)", dt=0.1)
    verdict = monitor.check({"a": [4.0, -1.0], "b": [3.0, 0.5]})
    cause = explain(verdict, "r")
    assert verdict.overall == "violated"
    assert cause is not None
    assert cause.sample == 1
    assert explain(monitor.check({"a": [-4.0, -1.0], "b": [3.0, 0.5]}), "r") is None


def test_which_formulas_call_a_function_outside_of_its_domain() -> None:
    def is_partial(number: str) -> bool:
        monitor = Monitor(f"signal a\nsignal b\nrequire r: {number} > 0", dt=0.1)
        return partial(monitor.compiled.requirements[0].formula)

    assert all(map(is_partial, ["sqrt(a)", "a / b", "b % a", "log(a + 1)", "asin(b)", "exp(a)", "a ^ b"]))
    total = ["a / 2", "a ^ 3", "sqrt(a ^ 2 + b ^ 2)", "b / (abs(a) + 1)", "asin(clip(a, -1, 1))", "tan(a)"]
    assert not any(map(is_partial, [*total, "norm([a, b])", "exp(-abs(clip(a, -9, 9)))", "a % 2"]))
