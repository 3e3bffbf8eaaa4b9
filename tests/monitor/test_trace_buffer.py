"""Causes of violations in a stream: those that `explain` gives for the whole recording."""

from __future__ import annotations

import numpy as np
import pytest

from stlc.monitor.explain.report import Cause, explain
from stlc.monitor.online import trace_buffer
from stlc.monitor.online.online import How, Online
from stlc.monitor.verdict import Monitor

REQUIREMENTS = {
    "state": "a > 1",
    "window": "always[0, T] (a > 0.5 -> eventually[0 s, 0.3 s] b > 0.5)",
    "to_the_end_of_the_window": "always[0, T] (a > 1 or eventually[0, end] b > 1)",
    "past": "always[0, T] (once[0 s, 0.4 s] a > 1 or b > 0)",
    "once": "eventually[0 s, 0.8 s] a > 2",
    "lasting": "always a > -1",
    "later": "always[0.5 s, inf] b > -1",
    "response": "always (a > 1.5 -> eventually[0 s, 0.4 s] b > 1)",
    "lasting_past": "always (a < 1.5 or historically[0 s, 0.5 s] b > -1)",
    "whole_past": "always (historically a > -1)",
    "never_met": "eventually a > 5",
    "nested": "always eventually a > 5",
    "never": "eventually[0.3 s, 0.5 s] (a > 5 and false)",
    "never_and_edges": "always (rise(a > 0) unless[0 s, 0.4 s] b > 5) and false",
    "never_and_forever": "always (a > -9 and false and eventually b > 3)",
}
SAMPLES = 120


def monitor_of(written: str) -> Monitor:
    return Monitor(f"signal a\nsignal b\nrequire r: {written}\n", dt=0.1, horizon=0.6)


def fed(online: Online, whole: dict[str, np.ndarray], step: int) -> Cause | None:
    for k in range(0, SAMPLES, step):
        piece = {name: values[k : k + step] for name, values in whole.items()}
        if step == 1:
            online.push({name: values[0] for name, values in piece.items()})
        else:
            online.feed(piece)
    assert online.finish()["r"].status == "violated"
    return online.cause("r")


@pytest.mark.parametrize("name", REQUIREMENTS)
@pytest.mark.parametrize("step", [1, 17])
def test_a_stream_is_explained_as_the_recording(name: str, step: int) -> None:
    monitor, compared = monitor_of(REQUIREMENTS[name]), 0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        whole = {signal: rng.normal(size=SAMPLES) for signal in ("a", "b")}
        verdict = monitor.check(whole)
        wanted = explain(verdict, "r")
        if wanted is None:
            continue
        found = fed(monitor.online(How(reasons=True)), whole, step)
        assert found is not None
        assert (found.sample, found.start) == (wanted.sample, wanted.start)
        assert found.because == wanted.because
        assert found.time == pytest.approx(wanted.time)
        assert [label.text for label in found.labels] == [label.text for label in wanted.labels]
        assert found.readings == wanted.readings
        compared += 1
    assert compared


LONG = {
    "response": "always (a > 2.4 -> eventually[0 s, 0.4 s] b > 9)",
    "whole_past": "always (historically a > -3)",
    "never_met": "eventually a > 5",
    "since": "always (b < 3 since a > -9)",
}


@pytest.mark.parametrize("name", LONG)
def test_a_cause_is_remembered_when_its_samples_are_gone(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trace_buffer, "_MOST", 100)
    monitor = monitor_of(LONG[name])
    whole = {signal: np.random.default_rng(3).normal(size=900) for signal in ("a", "b")}
    whole["a"][30], whole["b"][31] = -4.0 if name == "whole_past" else 4.9, 3.9
    online = monitor.online(How(reasons=True))
    for k in range(900):
        online.push({signal: float(values[k]) for signal, values in whole.items()})
    wanted, found = explain(monitor.check(whole), "r"), online.cause("r")
    assert online._buffer is not None
    assert online._buffer._history.samples - online._buffer._history.first <= 202
    assert wanted is not None
    assert found is not None
    assert (found.sample, found.because, found.readings) == (wanted.sample, wanted.because, wanted.readings)


def test_reasons_are_asked_for() -> None:
    whole = {signal: np.random.default_rng(0).normal(size=SAMPLES) for signal in ("a", "b")}
    online = monitor_of(REQUIREMENTS["lasting"]).online()
    assert fed(online, whole, 1) is None
