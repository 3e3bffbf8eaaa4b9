"""The clock of a recording, its unit, and several objects in one table."""

from __future__ import annotations

import numpy as np
import pytest

from stlc.diagnostics import TraceError
from stlc.trace import Reading, Trace, trace_of, traces_of
from stlc.trace.clocks import ClockSetting
from stlc.trace.recording import ClockGroup, Recording

STEPS = np.arange(10)


def table(units: dict[str, str] | None = None, **arrays: object) -> Recording:
    found = {name.replace("__", "+"): np.asarray(values) for name, values in arrays.items()}
    return Recording("r", (ClockGroup(found, None),), units=units or {})


def read(recording: Recording, *names: str, clock: str = "", **more: object) -> Trace:
    setting = ClockSetting.parse(clock) if clock else ClockSetting()
    wanted = dict.fromkeys(names or ("v",), False)
    words: dict[str, dict[str, float]] = {name: {} for name in wanted}
    return trace_of(recording, Reading(read=wanted, words=words, clock=setting, **more))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "values", "unit"),
    [
        ("t", 0.1 * STEPS, ""),
        ("time_ms", 100 * STEPS, "ms"),
        ("timestamp_us", 100_000 * STEPS + 20_321_827, "us"),
        ("TimeUS", 100_000 * STEPS, "us"),
        ("t_ns", 100_000_000 * STEPS, "ns"),
        ("%time", 1_600_000_000_000_000_000 + 100_000_000 * STEPS, "ns"),
        ("timestamp", 1_700_000_000 + 0.1 * STEPS, "s"),
        ("timestamp", 1_700_000_000_000 + 100 * STEPS, "ms"),
        ("timestamp", 1_700_000_000_000_000 + 100_000 * STEPS, "us"),
        ("stamp", 1_700_000_000_000_000_000 + 100_000_000 * STEPS, "ns"),
        ("time", [f"2026-01-31T12:00:00.{k}" for k in range(10)], "dates"),
        ("time", [f"2026-01-31 12:00:00.{k}+02:00" for k in range(10)], "dates"),
        ("Time", [f"31.01.2026 12:00:00.{k}" for k in range(10)], "dates"),
        ("Time", [f"2026/01/31 12:00:00,{k}" for k in range(10)], "dates"),
        ("Time", [f"23:59:59.{k}" for k in range(10)], "time of day"),
        ("time", np.datetime64("2026-01-31T12:00", "ns") + np.timedelta64(100, "ms") * STEPS, "dates"),
        ("time", [f"{0.1 * k:.1f}" for k in range(10)], ""),
    ],
)
def test_the_unit_of_a_clock(name: str, values: object, unit: str) -> None:
    trace = read(table(**{name: values, "v": STEPS}))  # type: ignore[arg-type]
    assert trace.dt == pytest.approx(0.1)
    assert [each.unit for each in trace.clocks] == [unit]


@pytest.mark.parametrize(
    ("unit", "dt"), [("ms", 0.001), ("us", 1e-6), ("[s]", 1.0), ("min", 60.0), ("h", 3600.0)]
)
def test_the_unit_in_a_header(unit: str, dt: float) -> None:
    trace = read(table({"t": unit.strip("[]")}, t=STEPS, v=STEPS))
    assert trace.dt == pytest.approx(dt)


def test_times_over_midnight_and_a_change_of_daylight_saving() -> None:
    words = ["23:59:59.8", "23:59:59.9", "00:00:00.0", "00:00:00.1"]
    assert read(table(time=words, v=STEPS[:4])).dt == pytest.approx(0.1)
    words = ["2024-03-31T01:59:59.9+01:00", "2024-03-31T03:00:00.0+02:00", "2024-03-31T03:00:00.1+02:00"]
    assert read(table(time=words, v=STEPS[:3])).dt == pytest.approx(0.1)


def test_clocks_in_two_columns() -> None:
    days, times = ["2026-01-01"] * 3, ["10:30:25.000", "10:30:25.100", "10:30:25.200"]
    assert read(table(Date=days, Time=times, v=STEPS[:3])).dt == pytest.approx(0.1)
    stamped = table(sec=[7, 7, 8], nanosec=[800_000_000, 900_000_000, 0], v=STEPS[:3])
    assert read(stamped).dt == pytest.approx(0.1)


def test_a_stated_unit_precedes_a_name_and_it_is_told() -> None:
    trace = read(table(time=STEPS, timestamp_us=100_000 * STEPS, v=STEPS))
    assert trace.dt == pytest.approx(0.1)
    assert str(trace.clocks[0]) == "`timestamp_us` (us), not `time`"


def test_equal_candidates_are_an_error_that_names_them() -> None:
    with pytest.raises(TraceError, match="which of `t`, `time` is the clock"):
        read(table(t=20 + 0.5 * STEPS, time=0.1 * STEPS, v=STEPS))
    assert read(table(t=20 + 0.5 * STEPS, time=0.1 * STEPS, v=STEPS), clock="time").dt == pytest.approx(0.1)
    assert read(table(t=20 + 0.1 * STEPS, time=0.1 * STEPS, v=STEPS)).dt == pytest.approx(0.1)


def test_a_signal_and_what_does_not_rise_is_no_clock() -> None:
    assert read(table(t=20 + 0.5 * STEPS, time=0.1 * STEPS, v=STEPS), "v", "t").dt == pytest.approx(0.1)
    assert read(table(t=np.sin(STEPS), time=0.1 * STEPS, v=STEPS)).dt == pytest.approx(0.1)


def test_the_unit_is_said() -> None:
    boot = table(timestamp=20_321_827 + 10_000 * STEPS, v=STEPS)
    assert read(boot).dt == pytest.approx(10_000.0)
    assert read(boot, clock="timestamp:us").dt == pytest.approx(0.01)
    with pytest.raises(TraceError, match="has no signal `tine`"):
        read(boot, clock="tine:us")


def test_frames_have_the_step_that_is_given() -> None:
    frames = table(frame=[0, 1, 2, 4], v=STEPS[:4])
    with pytest.raises(TraceError, match="has no `t`"):
        read(table(frame=[0, 1, 2, 3], v=STEPS[:4]))
    setting = ClockSetting(step=0.04)
    trace = trace_of(table(frame=[0, 1, 2, 3], v=STEPS[:4]), Reading(read={"v": False}, clock=setting))
    assert trace.dt == pytest.approx(0.04)
    with pytest.raises(TraceError, match="samples are missing"):
        trace_of(frames, Reading(read={"v": False}, clock=setting))


def test_a_clock_is_as_long_as_its_signals_and_near_them_by_name() -> None:
    rates = table(
        t=0.1 * STEPS, v=STEPS, t2=0.5 * np.arange(4), w=np.arange(4), A=np.eye(4), b=np.zeros((4, 2))
    )
    assert read(rates).dt == pytest.approx(0.1)
    log = Recording(
        "r",
        (
            ClockGroup(
                {
                    "log.a.Time": 0.1 * STEPS,
                    "log.a.Data": STEPS,
                    "log.b.Time": 0.2 * STEPS,
                    "log.b.Data": STEPS,
                },
                None,
            ),
        ),
    )
    assert read(log, "log.a.Data").dt == pytest.approx(0.1)
    assert read(log, "log.b.Data").dt == pytest.approx(0.2)


def test_what_is_not_read_never_matters() -> None:
    odd = table(
        {"w": "no unit"}, t=0.1 * STEPS, v=STEPS, w=STEPS, text=["a"] * 10, z=1j * STEPS, m=np.zeros((3, 3))
    )
    trace = read(odd)
    assert list(trace.data) == ["v"]


# -------------------------------------------------------------------------------- objects


def test_objects_of_different_lengths_are_traces_of_their_own() -> None:
    rows = table(t=[0, 1, 2, 1, 2, 3, 4], agent=[1, 1, 1, 2, 2, 2, 2], v=np.arange(7.0))
    traces = traces_of(rows, Reading(read={"v": False}))
    assert [(each.name, each.samples, each.t0) for each in traces] == [
        ("r (agent=1)", 3, 0.0),
        ("r (agent=2)", 4, 1.0),
    ]
    with pytest.raises(TraceError, match="2 objects of different times"):
        trace_of(rows, Reading(read={"v": False}))


def test_objects_are_told_apart_only_if_time_falls_back() -> None:
    rows = table(t=0.1 * STEPS, id=STEPS, v=STEPS)
    assert read(rows).samples == 10
    interleaved = table(t=[0, 0, 1, 1, 2, 2], track_id=[7, 9] * 3, v=np.arange(6.0))
    assert read(interleaved).data["v"].tolist() == [[0, 2, 4], [1, 3, 5]]
    numbered = table(t=[0, 1, 2, 0, 1, 2], id=np.arange(6), v=np.arange(6.0))
    with pytest.raises(TraceError, match="runs backwards"):
        read(numbered)


def test_the_column_that_tells_objects_apart_is_said() -> None:
    rows = table(t=[0, 1, 2, 0, 1, 2], which=["a"] * 3 + ["b"] * 3, v=np.arange(6.0))
    with pytest.raises(TraceError, match="runs backwards"):
        read(rows)
    assert read(rows, group="which").traces == 2
    named = Reading({"trace": "which"}, read={"v": False}, dt=0.5)
    assert trace_of(table(which=[1, 1, 2, 2], v=STEPS[:4]), named).traces == 2


def test_two_columns_that_could_tell_objects_apart_are_an_error() -> None:
    rows = table(
        t=[0, 1, 0, 1, 0, 1, 0, 1], run=[0, 0, 1, 1, 2, 2, 3, 3], id=[3, 3, 3, 0, 0, 5, 5, 5], v=STEPS[:8]
    )
    assert read(rows, group="run").traces == 4


@pytest.mark.parametrize(
    ("clocks", "agree"),
    [
        ({"t": 0.1 * STEPS, "time_ms": 100 * STEPS}, True),
        ({"t": 0.1 * STEPS, "time_ms": 110 * STEPS}, False),
        ({"t": 0.1 * STEPS, "time_ms": 100.5 * STEPS}, True),  # a crystal drifts
        ({"time_s": 0.1 * STEPS, "timestamp": 100 * STEPS}, True),  # ms, which nothing says
        ({"time_s": 0.1 * STEPS, "timestamp": 250 * STEPS}, False),
        ({"time_ms": 100 * STEPS, "time": 1.0 * STEPS}, True),  # it counts rows
        ({"t": 0.1 * STEPS, "gps_time": 7.0 * STEPS}, False),
        ({"time": 0.1 * STEPS, "time_received": STEPS}, False),
        ({"time": 0.1 * STEPS, "t_host": 0.01 * STEPS}, False),
        ({"time": 0.1 * STEPS, "time_to_collision": STEPS}, True),
        ({"t": 0.1 * STEPS, "motor_time": 7.0 * STEPS}, True),  # its last word only is that of a clock
        ({"t": 0.1 * STEPS, "time_ms": np.tile([0.0, 40.0], 5)}, True),  # it does not rise
        ({"t": 0.1 * STEPS, "timestamp": 1_700_000_000 + 0.1 * STEPS}, True),
        ({"t": 0.1 * STEPS, "timestamp": 1_700_000_000 + 0.2 * STEPS}, False),
    ],
)
def test_two_clocks_agree_or_are_an_error(clocks: dict[str, np.ndarray], agree: bool) -> None:
    recording = table(**clocks, v=STEPS)
    if agree:
        assert read(recording).samples == len(STEPS)
        return
    with pytest.raises(TraceError, match=r"E606: `r` has two clocks: `.*` with a step of .* s"):
        read(recording)
    for name in clocks:
        assert read(recording, clock=name).clocks[0].name == name  # the user says which one counts


def test_columns_of_objects_in_one_trace_are_told() -> None:
    recording = table(t=0.1 * STEPS, car_id=STEPS % 2, lap_id=STEPS, v=STEPS)
    assert read(recording).labels == {"car_id": 2}
    assert read(recording, group="none").labels == {}
    assert read(recording, "v", "car_id").labels == {}
