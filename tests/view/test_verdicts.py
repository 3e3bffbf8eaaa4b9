"""The least margins of the agents that a scene shows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.source import Source
from stlc.trace import Trace, TraceMeta
from stlc.units import Unit
from stlc.view.verdicts import (
    FLASH,
    FLASHES,
    Event,
    events_of,
    judge_agents,
    judged_at_start,
    least,
    margins_of,
    marks,
    marks_of,
    monitor_of,
    strip_of,
    units_of,
    violating,
)


def test_the_least_of_all_agents_is_shown():
    rho = np.array([[1.0, 2.0, 3.0, np.nan], [-1.0, 5.0, np.nan, np.nan]])
    np.testing.assert_array_equal(least(rho), [-1, 2, 3, np.nan])


RULES = """spec rules
signal x
require low: always x < 2
require slow: (always[0.5 s, end] x - prev(x) < 3) and always x < 9
require ends: eventually[0, 1 s] x > 0
"""


@given(st.lists(st.lists(st.floats(-9, 9), min_size=6, max_size=6), min_size=1, max_size=3))
def test_a_strip_is_red_where_what_is_demanded_at_all_times_fails(rows):
    """By the specification for drives, whatever the plans' says; its least value is the robustness."""
    meta = TraceMeta(spec_text=TEXT, judge_text=RULES, horizon=3, dt=0.5)
    trace = Trace(Signature((Column("x"),)), 0.5, {"x": np.array(rows)}, meta=meta)
    judged = judge_agents(trace, len(rows), system=Path("none.yaml"))
    found = margins_of(judged.verdict)
    np.testing.assert_allclose(found["low"], 2 - trace.data["x"])
    assert judged_at_start(judged.verdict) == ["ends"]
    for judgement in judged.verdict:
        np.testing.assert_allclose(np.nanmin(found[judgement.name], axis=1), judgement.least, atol=1e-6)
    strip = strip_of(judged, None)
    red = {name for name, rho in strip.margins.items() if np.nanmin(rho) < -1e-6}
    violated = {event.requirement for event in events_of(judged.verdict, len(rows))}
    assert {"low", "slow"} & red == {"low", "slow"} & violated


def test_paths_are_violated_as_drives_are_judged():
    meta = TraceMeta(
        spec_text=TEXT, judge_text="spec rules\nsignal x\nrequire low: always x < 9\n", horizon=3, dt=0.5
    )
    trace = Trace(
        Signature((Column("x"),)), 0.5, {"x": np.array([[1.0] * 5, [5.0] * 5, [10.0] * 5])}, meta=meta
    )
    planned = monitor_of(trace).check(trace)
    assert violating(trace, planned).tolist() == [False, False, True]
    alone = replace(trace, meta=replace(meta, judge_text=""))
    assert violating(alone, planned).tolist() == [False, True, True]


def test_the_agents_of_the_first_seed_are_shown(recording, tmp_path):
    decisions = recording.extras["decision"][:10].T.astype(np.int64)
    decisions = np.concatenate([decisions, decisions[-1:]])
    judged = judge_agents(recording, 10, system=tmp_path / "none.yaml")
    strip = strip_of(judged, decisions)
    assert judged.verdict.traces == 10
    assert judged.marked == {"no_collision", "give_way", "red_light"}
    assert strip.rows == ["no_collision", "stop_sign", "give_way", "red_light"]
    assert strip.decisions.shape == (151, 10)
    assert np.isnan(strip.margins["red_light"][-25:]).all()


def test_what_is_judged_once_is_shown_as_it_was_judged():
    text = (
        "spec s\nsignal x [m]\nrequire plan: always[0, T] x > 0\n"
        "require once_only: always[0, 0.2 s] x > 0\nrequire clock: eventually@[0.1 s, 0.3 s] x > 2\n"
    )
    meta = TraceMeta(spec_text=text, horizon=2, dt=0.1)
    x = np.array([[1.0, 2, 3, -4, 5, 6], [7, 7, 7, 7, 7, 7]])
    trace = Trace(Signature((Column("x"),)), 0.1, {"x": x}, meta=meta)
    monitor = monitor_of(trace)
    verdict = monitor.check(trace)
    found = margins_of(verdict)
    assert judged_at_start(verdict) == ["once_only", "clock"]
    np.testing.assert_allclose(found["plan"], [[1, -4, -4, -4, np.nan, np.nan], [7] * 4 + [np.nan] * 2])
    np.testing.assert_allclose(found["once_only"], [[1] * 6, [7] * 6])  # not -4: nobody asks at 0.1 s
    np.testing.assert_allclose(found["clock"], [[1] * 6, [5] * 6])


def test_a_margin_has_the_unit_of_its_predicates():
    text = (
        "spec s\nsignal x [m]\nsignal v [km/h]\nsignal on : bool\nconst low = 2 m\n"
        "require place: always[0, T] (x > low and x < 9 m)\nrequire speed: eventually[0, T] v > 3\n"
        "require mixed: always[0, T] (x > 1 or v > 1)\nrequire switch: always[0, T] (on or x > 1)\n"
        "require apart: always[0, T] [x, x] not in circle([0, 0], 1)\n"
    )
    names = (("x", "m"), ("v", "km/h"))
    columns = (*(Column(name, Unit.parse(unit)) for name, unit in names), Column("on", kind="bool"))
    data = {name: np.ones((1, 4)) for name in ("x", "v", "on")}
    trace = Trace(Signature(columns), 0.1, data, meta=TraceMeta(spec_text=text, horizon=2, dt=0.1))
    verdict = monitor_of(trace).check(trace)
    assert units_of(verdict) == {"place": "m", "speed": "km/h", "apart": "m"}


# ---------------------------------------------------------------------- test_events


TEXT = "spec s\nsignal x\n@safety\nrequire low: always[0, T] x < 2\nrequire rise: eventually[0, T] x > 0\n"


def verdict_of(rows, horizon=3):
    meta = TraceMeta(spec_text=TEXT, horizon=horizon, dt=0.5)
    trace = Trace(Signature((Column("x"),)), 0.5, {"x": np.array(rows, dtype=float)}, meta=meta)
    return monitor_of(trace).check(trace)


def test_an_instant_is_found_once_though_many_windows_hold_it():
    events = events_of(verdict_of([[1, 1, 1, 1, 5, 1, 1, 1, 1, 6, 1, 1, 1, 1]]), 1)
    assert [(event.requirement, event.sample, event.start) for event in events] == [
        ("low", 4, 1),
        ("low", 9, 6),
    ]
    assert "x = 5, at t = 2 s" in events[0].because


def test_violations_that_follow_one_another_are_one():
    (event,) = events_of(verdict_of([[1, 1, 3, 4, 5, 4, 1, 1, 1, 1]]), 1)
    assert (event.sample, event.until) == (2, 5)


@pytest.mark.parametrize(
    ("written", "row", "found"),
    [
        ("always historically[0 s, 1 s] x < 2", [1, 1, 5, 1, 1, 1, 1], [(2, 4, 2)]),
        ("always (freeze k = x in historically[0 s, 1 s] x < k + 2)", [3, 3, 3, 2, 0, 3], [(4, 4, 2)]),
        ("not eventually x > 2", [1, 3, 3, 1, 4], [(1, 2, 1), (4, 4, 4)]),
        ("always (x > 2 -> eventually[0.5 s, 1 s] x < 0)", [1, 3, 1, 1, 3, 1, -1], [(1, 1, 2)]),
        ("always x < 2 and always x > -2", [1, 3, -4, 1, 3], [(1, 2, 1), (4, 4, 4)]),
        ("eventually x > 9", [1, 3, 2], [(0, 0, 1)]),
        ("x > 3 or always x < 2", [1, 3, 2], [(0, 0, 1)]),
        ("always always[0 s, 1 s] x < 2", [1, 1, 3, 1, 1, 1, 3, 1, 1], [(2, 2, 2), (6, 6, 6)]),
    ],
)
def test_an_event_lies_where_the_requirement_is_violated_and_names_its_cause(written, row, found):
    text = f"spec s\nsignal x\nrequire r: {written}\n"
    verdict = Monitor(text, dt=0.5).check({"x": np.array(row, dtype=float)})
    events = events_of(verdict, 1)
    assert [(event.sample, event.until, event.cause) for event in events] == found
    assert all(f"t = {event.cause / 2:g} s" in event.because for event in events)


def test_every_sample_that_is_violated_lies_in_an_event():
    rng = np.random.default_rng(0)
    for _ in range(30):
        row = rng.choice([1.0, 1.0, 1.0, 3.0], 24)
        found = [event for event in events_of(verdict_of([row], 1), 1) if event.requirement == "low"]
        covered = {sample for event in found for sample in range(event.sample, event.until + 1)}
        assert covered == set(np.flatnonzero(row > 2).tolist())


def test_only_the_agents_that_are_shown_and_so_many_events():
    rows = [[1, 5, 1, 1, 1, 1, 5, 1, 1, 1, 1, 5, 1, 1]] * 3
    assert {event.agent for event in events_of(verdict_of(rows), 2)} == {0, 1}
    assert len(events_of(verdict_of(rows), 3, most=4)) == 4


def test_a_mark_comes_and_goes():
    events = [
        Event("low", 1, 2, 3, 0, "", 2),
        Event("rise", 0, 0, 0, 0, "", 0),
        Event("low", 7, 0, 0, 0, "", 0),
    ]
    shown = marks(events, 12, 2, {"low"})
    assert not shown[:, 0].any()
    assert shown[:, 1].tolist() == [False, False, True, *(FLASH * FLASHES)[:9]]


def test_marks_are_in_the_units_of_the_trace_and_name_the_deciding_sample():
    text = "spec s\nsignal x [m]\nrequire up: always (x < 4 m -> eventually[0 s, 2 s] x > 0.8 m)\n"
    column = Column("x", unit=Unit.parse("cm"))
    trace = Trace(
        Signature((column,)), 1.0, {"x": np.array([[500.0, 300.0, 20.0, 79.0, 500.0, 500.0, 500.0]])}
    )
    verdict = Monitor(Spec.parse(Source("s.stl", text))).check(trace)
    assert marks_of(verdict, trace).thresholds == {"x": pytest.approx([400.0, 80.0])}
    assert not marks_of(verdict, trace).deciding  # it comes back in time
    trace.data["x"][0, 4:] = 70.0
    verdict = Monitor(Spec.parse(Source("s.stl", text))).check(trace)
    (only,) = marks_of(verdict, trace).deciding
    first, last = only.window
    assert first <= only.sample <= last
    assert trace.data["x"][0, only.sample] == trace.data["x"][0, first : last + 1].max()
