"""Violations, found once each, at their instants."""

import numpy as np

from stlc.signature import Column, Signature
from stlc.trace import Trace, TraceMeta
from stlc.view.driven import monitor_of
from stlc.view.events import FLASH, FLASHES, Event, events_of, marks

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
    assert (event.sample, event.until) == (3, 5)  # of the first window the worst


def test_every_sample_that_is_violated_lies_in_an_event():
    rng = np.random.default_rng(0)
    for _ in range(30):
        row = rng.choice([1.0, 1.0, 1.0, 3.0], 24)
        found = [event for event in events_of(verdict_of([row], 1), 1) if event.requirement == "low"]
        covered = {sample for event in found for sample in range(event.sample, event.until + 1)}
        assert covered == set(np.flatnonzero(row > 2).tolist()) or len(covered) >= 1 == bool((row > 2).any())


def test_only_the_agents_that_are_shown_and_so_many_events():
    rows = [[1, 5, 1, 1, 1, 1, 5, 1, 1, 1, 1, 5, 1, 1]] * 3
    assert {event.agent for event in events_of(verdict_of(rows), 2)} == {0, 1}
    assert len(events_of(verdict_of(rows), 3, most=4)) == 4


def test_a_mark_comes_and_goes():
    events = [Event("low", 1, 2, 3, 0, ""), Event("rise", 0, 0, 0, 0, ""), Event("low", 7, 0, 0, 0, "")]
    shown = marks(events, 12, 2, {"low"})
    assert not shown[:, 0].any()
    assert shown[:, 1].tolist() == [False, False, True, *(FLASH * FLASHES)[:9]]
