"""Samples one by one against the evaluator that sees the whole trace: values, bounds, verdicts and memory."""

from __future__ import annotations

import gc
import os
import tracemalloc
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import StlcError, TraceError, UsageError
from stlc.monitor.online.history import ColumnHistory
from stlc.monitor.online.online import How
from stlc.monitor.prefix_bounds import FAR, lengthened, prefix_bound, with_seen
from stlc.monitor.values import Record
from stlc.monitor.verdict import Monitor

EXAMPLES = int(os.environ.get("STLC_CASES", "30"))
"""Number of random formulas and traces."""


def at_ends(
    formula: ir.Formula, known: dict[str, np.ndarray], starts: range, *, cut: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds wherever the trace ends, by the evaluator: endless windows run over many unknown samples."""
    record = Record(with_seen(known, NUMPY), NUMPY)
    low, high = (
        record.values(
            [lengthened(prefix_bound(formula, end, cut=cut), record.samples + 60)], starts, end, FAR
        )
        for end in ("lower", "upper")
    )
    return low[0][:, 0], high[0][:, 0]


# ------------------------------------------------------------------ through the monitor

HEAD = "spec small\nsignal a\nsignal b\nsignal q: real[2]\n"
REQUIREMENTS = {
    "state": "a > 0",
    "windowed": "a > 0 -> eventually[0, T] b > 0",
    "nested": "always[0, T] (a > 0 or eventually[0.1 s, 0.3 s] b > 0)",
    "beyond_the_window": "always[0, T] (a > -1 or eventually[0 s, 0.4 s] b > 0)",
    "bounded": "always[0 s, 0.4 s] (a > 0 or b > 0)",
    "always": "always (a > 1 -> eventually[0 s, 0.3 s] b > 0)",
    "response": "always (a > 1 -> eventually b > 0)",
    "infinitely_often": "always eventually (a > 0 and eventually[0.2 s, 0.4 s] b > 0)",
    "until": "a > -1 until b > 1",
    "late_until": "a > -1 until[0.3 s, inf] b > 0",
    "past": "always[0, T] (once[0 s, 0.2 s] a > 0 or historically[0 s, 0.3 s] b > 0)",
    "whole_past": "always (once a > 1 or historically b > -1)",
    "since": "always[0, T] (a > -1 since b > 0)",
    "window_to_end": "always[0, T] (a > 0 or eventually[0, end] b > 0)",
    "window_to_end_with_past": "always[0, T] (once[0 s, 0.2 s] a > 0 or eventually[0, end] b > 0)",
    "past_beyond_the_window": "(a < 1 release(T, inf] a >= 1) until[0 s, 0.9 s] historically b > -2",
    "end_under_a_window": "eventually[0 s, 0.4 s] always a > -1",
    "edge": "always (rise(a > 0) -> b > -1)",
    "vector": "always norm(q) < 3",
}
T = 6


@cache
def monitor_of(*names: str) -> Monitor:
    body = "".join(f"require r_{name}: {REQUIREMENTS[name]}\n" for name in names)
    return Monitor(HEAD + body, dt=0.1, horizon=T / 10)


def signals(samples: int, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    columns = {name: rng.integers(-16, 16, samples) / 8 for name in ("a", "b")}
    return columns | {"q": rng.integers(-16, 16, (samples, 2)) / 8}


@pytest.mark.parametrize("name", REQUIREMENTS)
@settings(max_examples=4, deadline=None)
@given(
    tolerance=st.sampled_from([1e-6, 0.0]),
    samples=st.integers(1, 30),
    seed=st.integers(0, 2**32 - 1),
    end=st.sampled_from(["open", "truncate"]),
)
def test_the_end_of_a_stream_is_the_verdict_of_the_monitor(
    name: str, tolerance: float, samples: int, seed: int, end: Any
) -> None:
    monitor, whole = monitor_of(name), signals(samples, seed)
    wanted = monitor.check(whole, end=end, tolerance=tolerance)["r_" + name]
    pushed = monitor.online(How(end=end, tolerance=tolerance))
    fed = monitor.online(How(end=end, tolerance=tolerance))
    decided: dict[int, str] = {}
    for k in range(samples):
        pushed.push({key: values[k].tolist() for key, values in whole.items()})
        for decision in pushed.verdicts():
            assert decision.start not in decided
            decided[decision.start] = decision.status
    cuts = [0, samples // 3, samples // 2, samples]
    for low, high in pairwise(cuts):
        if high > low:
            fed.feed({key: values[low:high] for key, values in whole.items()})
    for online in (pushed, fed):
        tally = online.finish()["r_" + name]
        assert (tally.status, tally.instants) == (wanted.overall, wanted.instants)
        np.testing.assert_array_equal(tally.robustness, wanted.robustness)
        assert tally.holds / tally.instants == wanted.share
        if wanted.overall != "inconclusive":
            assert (tally.high_at if tally.fails else tally.low_at) == wanted.worst[1]
    for i in range(wanted.instants):  # what was decided stays so
        if i in decided:
            assert decided[i] == ("satisfied" if wanted.holds[i, 0] else "violated")


@pytest.mark.parametrize(
    "written",
    [
        "always eventually[0.3 s, inf] once b > 0",  # the last windows are empty, wherever the end is
        "next(always once b > 0)",
        "rise(b > 0) release[0 s, 0.2 s] (false until[0, end] b < 0)",
        "eventually[0.3 s, 0.5 s] once b > 0",  # the end may cut the window away
        "always[0.3 s, 0.5 s] not once b > 0",
        "not next(always[0.3 s, inf] once b > 0)",
        "prev(b > 0 since[1 steps, inf] false)",
        "eventually not next(always b > -3)",  # true where there is no next sample
        "always (b > 4 or not next(eventually b > 3))",
        # alike until the trace ends
        "(always (b > 4 or next(always b > 3))) or (always (b > 4 or not next(eventually not (b > 3))))",
        "(always (b > 4 or not next(eventually not (b > 3)))) or (always (b > 4 or next(always b > 3)))",
    ],
)
def test_a_verdict_is_never_taken_back(written: str) -> None:
    monitor = Monitor(f"{HEAD}require r: {written}\n", dt=0.1)
    whole = {"b": np.arange(1.0, 13.0) / 8}
    for end in ("open", "truncate"):
        online = monitor.online(How(end=end))
        low, high, said = -np.inf, np.inf, set()
        for k in range(12):
            online.push({"b": whole["b"][k]})
            said |= {decision.status for decision in online.verdicts()}
            for _, least, most in online.open_starts("r"):
                low, high = max(low, least), min(high, most)
            final = online.finish()["r"]
            assert low <= final.low <= final.high <= high, (end, k)
            assert said <= {final.status}, (end, k)
            known = {"b": whole["b"][: k + 1]}
            assert (final.low, final.high) == monitor.check(known, end=end)["r"].bounds, (end, k)


def test_a_stream_that_is_shorter_than_the_horizon() -> None:
    """`end` is `T` after the start, and not where the stream happens to stop."""
    monitor, whole = monitor_of("window_to_end"), {"a": [-1.0] * 3, "b": [-1.0] * 3}
    for end, known in (("open", (-np.inf, np.inf)), ("truncate", (-1.0, -1.0))):
        online = monitor.online(How(end=end))
        online.feed(whole)
        tally = online.finish()["r_window_to_end"]
        assert (tally.low, tally.high) == monitor.check(whole, end=end)["r_window_to_end"].bounds == known
    online = monitor.online(How(end="strict"))
    online.feed(whole)
    for judge in (lambda: monitor.check(whole, end="strict"), online.finish):
        with pytest.raises(StlcError, match=r"E306.*needs 0\.6 s of signal; the trace has 0\.2 s"):
            judge()


@pytest.mark.parametrize("name", ["bounded", "always", "windowed", "until"])
def test_verdicts_come_as_soon_as_they_are_decided(name: str) -> None:
    monitor, whole = monitor_of(name), signals(40, 3)
    online = monitor.online()
    seen = 0
    for k in range(40):
        count = online.push({key: values[k] for key, values in whole.items()})
        found = online.verdicts()
        assert len(found) == count
        for decision in found:
            known = {key: values[: k + 1] for key, values in whole.items()}
            before = {key: values[:k] for key, values in whole.items()}
            rule = monitor.compiled.requirements[0]
            low, high = lasting(rule.formula, known, decision.start)
            assert online.bounds(decision.requirement, decision.start) == (low, high)
            assert decision.sample == k
            assert decision.time == pytest.approx(0.1 * decision.start)
            if k > decision.start:
                low, high = lasting(rule.formula, before, decision.start)
                assert low < -1e-6 <= high
            seen += 1
    assert seen


def lasting(formula: ir.Formula, known: dict[str, np.ndarray], start: int) -> tuple[float, float]:
    columns = {name: values[:, None] for name, values in known.items() if values.ndim == 1}
    low, high = at_ends(formula, columns, range(start, start + 1))
    return float(low[0]), float(high[0])


def grown(push: Callable[[int], object], samples: int) -> int:
    """Bytes that are kept of pushes after the first 300.

    The interpreter keeps thousands of freed tuples of every length for the next one of that length; a
    collection gives them back, so that what is left is what somebody holds.
    """
    sizes = []
    tracemalloc.start()
    try:
        for first, stop in ((0, 300), (300, samples)):
            for k in range(first, stop):
                push(k)
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    return sizes[1] - sizes[0]


@pytest.mark.apart
@pytest.mark.parametrize("samples", [600, pytest.param(100_000, marks=pytest.mark.slow)])
def test_memory_does_not_grow(samples: int) -> None:
    online = monitor_of("bounded", "past").online(How(at="all"))
    values = np.sin(np.arange(997.0)).tolist()
    kept: list[int] = []

    def push(k: int) -> None:
        online.push({"a": values[k % 997], "b": values[(7 * k) % 997]})

    assert grown(push, samples) < 4_000
    assert online.standing("r_bounded").instants == samples
    assert grown(kept.append, 700) > 4_000


def test_samples_that_come_one_by_one_are_stored_in_few_arrays() -> None:
    history = ColumnHistory()
    for sample in range(5_000):
        history.take({"x": np.full((1, 1), float(sample))})
    assert len(history._blocks) < 200
    history.forget(1_000)
    assert history.columns(2_000)["x"].ravel().tolist() == list(range(2_000, 5_000))


def test_open_starts_and_standing() -> None:
    online = monitor_of("windowed", "bounded").online()
    for k in range(3):
        assert not online.push({"a": 1.0, "b": -1.0, "q": [0.0, 0.0]}) or k == 0
    assert [start for start, _, _ in online.open_starts("r_windowed")] == [0, 1, 2]
    assert online.standing("r_bounded").status == "inconclusive"
    assert (online.standing("r_bounded").low, online.standing("r_bounded").high) == (-np.inf, 1.0)
    with pytest.raises(StlcError, match="no requirement `bound`"):
        online.standing("bound")


def test_every_start() -> None:
    monitor, whole = monitor_of("bounded"), signals(20, 1)
    online = monitor.online(How(at="all"))
    online.feed(whole)
    wanted = monitor.check(whole, at="all")["r_bounded"]
    tally = online.finish()["r_bounded"]
    assert (tally.instants, tally.status, tally.robustness) == (
        wanted.instants,
        wanted.overall,
        wanted.robustness,
    )
    with pytest.raises(StlcError, match="runs to the end"):
        monitor_of("always").online(How(at="all"))


def test_strict_ends_and_streams_without_samples() -> None:
    online = monitor_of("bounded").online(How(end="strict"))
    with pytest.raises(StlcError, match="E605"):
        online.finish()
    online.push({"a": 1, "b": 1, "q": [0, 0]})
    with pytest.raises(StlcError, match="E306"):
        online.finish()


def test_samples_that_are_refused() -> None:
    online = monitor_of("vector", "state").online()
    online.push({"a": 1, "b": 2, "q": [0.0, 1.0], "more": "ignored"})
    with pytest.raises(StlcError, match="E601"):
        online.push({"q": [0.0, 0.0]})
    with pytest.raises(StlcError, match=r"E605.*`a` has 2"):
        online.push({"a": [1.0, 2.0], "b": 0.0, "q": [0.0, 0.0]})
    assert online.samples == 1


def test_assumptions_say_what_is_in_scope() -> None:
    assumed = "assume start: a > 0\nassume soon: eventually[0 s, 0.2 s] a > 1\n"
    text = f"spec s\nsignal a\n{assumed}require r: always a > -1\n"
    online = Monitor(text, dt=0.1).online()
    assert online.in_scope is None
    online.push({"a": 0.5})
    assert online.in_scope is None
    online.push({"a": 2})
    assert online.in_scope is True
    online.push({"a": 0})
    assert online.in_scope is True
    other = Monitor(text, dt=0.1).online()
    other.push({"a": -0.5})
    assert other.in_scope is False


def test_what_every_instant_has_for_itself_is_refused_before_the_first_sample() -> None:
    text = "signal x\nrequire r: always (freeze a = x in eventually[0 s, {} s] x > a)"
    with pytest.raises(UsageError) as caught:
        Monitor(text.format(100_000), dt=1.0).online()
    (finding,) = caught.value.diagnostics
    assert finding.code == "E313"
    assert finding.span is not None
    assert finding.span.text.startswith("freeze a = x in")
    Monitor(text.format(100), dt=1.0).online()


@pytest.mark.parametrize(
    "formula", ["1 > 0", "freeze a = 1 in a > 0", "always once norm([1, 2]) > 3", "true"]
)
@pytest.mark.parametrize("end", ["open", "truncate"])
@pytest.mark.parametrize("tolerance", [1e-6, 0.0])
def test_requirements_that_read_no_signal(formula: str, end: Any, tolerance: float) -> None:
    monitor = Monitor(f"signal x\nrequire r: {formula}\nrequire q: x > 0", dt=1.0)
    online = monitor.online(How(end=end, tolerance=tolerance))
    for value in (1.0, 2.0):
        online.push({"x": value})
    whole = monitor.check({"x": np.array([1.0, 2.0])}, end=end, tolerance=tolerance)
    assert {name: tally.status for name, tally in online.finish().items()} == {
        judgement.name: judgement.status for judgement in whole
    }


@pytest.mark.parametrize(("end", "at"), [("open", None), ("truncate", 4)])
@pytest.mark.parametrize(
    "formula",
    [
        "always[0.4 s, inf] (freeze p = x in (eventually[0 s, 0.2 s] (x > p - 1 or y > 0)))",
        "eventually (freeze p = y in (p > 1.8 and historically[0.1 s, 0.3 s] x < p))",
    ],
)
def test_values_that_are_final_need_no_samples(formula: str, end, at: int | None) -> None:
    monitor, rng = Monitor(f"signal x\nsignal y\nrequire r: {formula}\n", dt=0.1), np.random.default_rng(5)
    trace = {name: rng.normal(size=150) for name in ("x", "y")}
    trace["y"][77] = np.nan
    online = monitor.online(How(at=at, end=end))
    for k in range(150):
        online.push([trace[name][k] for name in online.signals])
        if end == "open" and k in (5, 90, 140):
            low, high = monitor.bounds({name: x[: k + 1] for name, x in trace.items()}, at=at or 0)
            ((_, least, most),) = online.open_starts("r")
            assert (least, most) == ((-np.inf, high) if formula.startswith("always") else (low, np.inf))
    assert len(next(iter(online._history.columns().values()))) < 100
    wanted, found = monitor.check(trace, at=at, end=end)["r"], online.finish()["r"]
    assert (found.low, found.high, found.status) == (*wanted.bounds, wanted.overall)


@pytest.mark.parametrize("rows", [[["1", "2"]], [[None, 1.0]], [[1.0, 2.0], [3.0]], [[1.0]], 3.0, [{}]])
@pytest.mark.parametrize("formula", ["x > y", "freeze z = x in y > z"])
def test_a_block_that_is_no_numbers_is_refused(rows: object, formula: str) -> None:
    online = Monitor(f"signal x, y\nrequire r: {formula}", dt=1).online()
    with pytest.raises(TraceError, match="E605: a sample is one number for each of x, y"):
        online.push_block(rows)  # type: ignore[arg-type]
    assert online.samples == 0
