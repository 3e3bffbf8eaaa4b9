"""Resampling neither hides nor invents a violation: bounds contain the value on the recorded samples."""

from __future__ import annotations

import numpy as np
import pytest

from stlc.compile.semantics.tolerance import End
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.trace import Reading, Trace, trace_of
from stlc.trace.recording import ClockGroup, Recording
from stlc.trace.resample import Between

STEP, RATIO = 0.25, 4  # seconds of the grid; samples in a step of it


def formula(rng: np.random.Generator, depth: int) -> str:
    """A random formula over `x` and `y`, whose windows are whole steps of the grid."""
    if depth == 0 or rng.random() < 0.15:
        sides = [("x", "0.3"), ("y", "-0.2"), ("x", "y"), ("x + y", "0.1"), ("abs(x)", "0.5")]
        one, other = sides[rng.integers(len(sides))]
        return f"{one} {rng.choice(['<', '>'])} {other}"
    first = int(rng.integers(0, 3))
    last = first + int(rng.integers(0, 4))
    window = f"[{first * STEP} s, {last * STEP} s]"
    part = formula(rng, depth - 1)
    kind = rng.choice(
        ["always", "eventually", "once", "historically", "and", "or", "->", "until", "since", "not"]
    )
    if kind in ("always", "eventually", "once", "historically"):
        return f"({kind}{window} ({part}))" if rng.random() < 0.8 else f"({kind} ({part}))"
    if kind == "not":
        return f"(not ({part}))"
    other = formula(rng, depth - 1)
    if kind in ("until", "since"):
        return f"(({part}) {kind}{window} ({other}))"
    return f"(({part}) {kind} ({other}))"


def recording(x: np.ndarray, y: np.ndarray, times: np.ndarray) -> Recording:
    return Recording("r", (ClockGroup({"x": x, "y": y, "t": times}, None),))


@pytest.mark.parametrize("seed", range(150))
def test_bounds_contain_those_on_all_samples(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = RATIO * int(rng.integers(3, 9)) + 1
    x, y = (np.round(rng.normal(size=count), 1) for _ in range(2))
    text = f"signal x, y\nrequire r: {formula(rng, int(rng.integers(1, 4)))}"
    dense = STEP / RATIO
    whole = Trace(Signature((Column("x"), Column("y"))), dense, {"x": x[None], "y": y[None]})
    end: End = "open" if seed % 2 else "truncate"
    wanted = Monitor(text).check(whole, end=end)["r"]
    reading = Reading(resample=STEP, read={"x": False, "y": False}, words={"x": {}, "y": {}})
    coarse = trace_of(recording(x, y, dense * np.arange(count)), reading)
    assert coarse.samples == (count - 1) // RATIO + 1
    found = Monitor(text).check(coarse, end=end)["r"]
    (low, high), (least, most) = found.bounds, wanted.bounds
    assert low <= least + 1e-9, text
    assert high >= most - 1e-9, text
    if found.status != "inconclusive":
        assert found.status == wanted.status, text


@pytest.mark.parametrize("seed", range(60))
def test_a_grid_of_the_recorded_step_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(5, 30))
    x, y = (np.round(rng.normal(size=count), 1) for _ in range(2))
    text = f"signal x, y\nrequire r: {formula(rng, int(rng.integers(1, 4)))}"
    whole = Trace(Signature((Column("x"), Column("y"))), STEP, {"x": x[None], "y": y[None]})
    reading = Reading(resample=STEP, read={"x": False, "y": False}, words={"x": {}, "y": {}})
    again = trace_of(recording(x, y, STEP * np.arange(count)), reading)
    wanted, found = (Monitor(text).check(each)["r"] for each in (whole, again))
    assert found.bounds == wanted.bounds
    assert found.status == wanted.status


@pytest.mark.parametrize(("written", "status"), [("x > 0", "satisfied"), ("x > 1.5", "violated")])
def test_a_window_to_the_end_ends_within_the_last_step(written: str, status: str) -> None:
    x, times = np.array([1.0, -1, 0.5, -1, 1, 0.5]), np.array([0, 0.3, 0.5, 1.2, 2.0, 2.3])
    reading = Reading(resample=1.0, read={"x": False, "y": False}, words={"x": {}, "y": {}})
    trace = trace_of(recording(x, x, times), reading)
    monitor = Monitor(f"signal x, y\nrequire r: always eventually {written}")
    assert monitor.check(trace)["r"].status == status


@pytest.mark.parametrize("end", ["open", "truncate"])
def test_the_start_of_a_window_is_an_instant_of_the_grid(end: End) -> None:
    x, times = np.array([1.0, 1, 1, -2, 1, 1]), np.array([0, 1, 2, 2.75, 3, 4])
    reading = Reading(resample=1.0, read={"x": False, "y": False}, words={"x": {}, "y": {}})
    trace = trace_of(recording(x, x, times), reading)
    cause = Monitor("signal x, y\nrequire r: always[0, 1] x > 0").check(trace, at=2, end=end)["r"].cause
    assert cause is not None
    assert (cause.time, cause.started_at, cause.started) == (2.75, 2.0, "t = 2 s")


def spiked(count: int = 1000) -> Recording:
    values = np.ones(count)
    values[503] = 9.0
    return Recording("r", (ClockGroup({"v": values, "t": 0.001 * np.arange(count)}, None),))


def test_one_sample_between_two_instants_is_a_violation_with_its_own_time() -> None:
    from stlc.monitor.explain.report import explain

    monitor = Monitor("signal v\nrequire limit: always v < 3\nrequire peak: eventually v > 8")
    verdict = monitor.check(trace_of(spiked(), Reading(resample=0.01)))
    assert verdict["limit"].status == "violated"
    assert verdict["limit"].robustness == -6.0
    assert verdict["peak"].status == "satisfied"
    cause = explain(verdict, "limit")
    assert cause is not None
    assert cause.time == pytest.approx(0.503)
    assert cause.readings[0].value == 9.0


def grouped(**signals: tuple[list[float], list[float]]) -> Recording:
    groups = tuple(
        ClockGroup({name: np.array(values, dtype=np.float64)}, np.array(times, dtype=np.float64))
        for name, (times, values) in signals.items()
    )
    return Recording("r", groups)


def test_values_between_samples_are_those_that_were_recorded() -> None:
    monitor = Monitor("signal s\nrequire low: always[0 s, 9 s] s < 30")
    sparse = grouped(s=([0.0, 10.0, 12.0, 14.0, 20.0], [20.5, 80.5, 80.5, 20.5, 20.5]))
    statuses = {
        how: monitor.check(trace_of(sparse, Reading(resample=1.0, between=between)))["low"].status
        for how, between in {
            "either": {},
            "hold": {"s": Between("hold")},
            "linear": {"s": Between("linear")},
        }.items()
    }
    assert statuses == {"either": "inconclusive", "hold": "satisfied", "linear": "violated"}


def test_a_held_value_that_is_too_old_is_unknown() -> None:
    monitor = Monitor("signal go\nsignal x\nrequire alive: always go > 0")
    dead = grouped(go=([0.0, 0.1, 0.2], [1.0, 1.0, 1.0]), x=([0.0, 1.0], [0.0, 0.0]))
    aged = Reading(resample=0.1, between={"go": Between("hold", 0.5)})
    assert monitor.check(trace_of(dead, aged))["alive"].status == "inconclusive"
    assert monitor.check(trace_of(dead, Reading(resample=0.1, between={"go": Between("hold")})))[
        "alive"
    ].satisfied


def test_an_angle_turns_the_shorter_way() -> None:
    monitor = Monitor("signal yaw\nrequire back: always abs(yaw) > 3")
    turning = grouped(yaw=([0.0, 0.1, 0.23, 0.3], [3.10, 3.12, -3.13, -3.11]))
    found = monitor.check(trace_of(turning, Reading(resample=0.01, between={"yaw": Between("angle")})))
    assert found["back"].status == "satisfied"


def test_a_requirement_is_judged_where_its_own_signals_were_seen() -> None:
    monitor = Monitor(
        "signal v\nsignal stop\nrequire limit: always v < 3\nrequire both: always (stop > 0 -> v < 8)"
    )
    late = grouped(
        v=(list(np.arange(0, 6.05, 0.1)), [9.0 if k == 5 else 1.0 for k in range(61)]),
        stop=(list(np.arange(1.0, 5.95, 0.1)), [1.0] * 50),
    )
    verdict = monitor.check(trace_of(late, Reading(resample=0.1)))
    assert verdict["limit"].status == "violated"
    assert verdict["limit"].part is not None
    assert verdict["limit"].part.seen is None
    part = verdict["both"].part
    assert part is not None
    assert part.seen is not None
    assert (part.first, part.stop) == (10, 60)
    assert (part.seen.first, round(part.seen.last, 9)) == (1.0, 5.9)
    assert verdict["both"].satisfied
    strict = monitor.check(trace_of(late, Reading(resample=0.1)), strict=True)
    assert strict["both"].status == "inconclusive"
    assert strict["limit"].status == "violated"


def test_samples_of_one_stamp_all_count() -> None:
    monitor = Monitor("signal v\nrequire limit: always v < 3")
    burst = grouped(v=([0.0, 0.1, 0.1, 0.1, 0.2], [1.0, 1.0, 9.0, 1.0, 1.0]))
    assert monitor.check(trace_of(burst, Reading(resample=0.1)))["limit"].status == "violated"


def test_freeze_compares_all_recorded_values() -> None:
    monitor = Monitor("signal v\nrequire still: freeze v0 = v in always (v - v0 < 5)")
    assert monitor.check(trace_of(spiked(), Reading(resample=0.01)))["still"].status != "satisfied"


def test_an_infinite_sample_on_the_grid_keeps_its_value() -> None:
    arrays = {"t": np.array([0.0, 0.1, 0.2]), "x": np.array([1.0, np.inf, 2.0])}
    recording = Recording("gap", (ClockGroup(arrays, None),))
    trace = trace_of(recording, Reading(resample=0.1, between={"x": Between("linear")}))
    assert trace.data["x"].tolist() == [[1.0, np.inf, 2.0]]
