"""A stream that is judged at one of its samples."""

from __future__ import annotations

import numpy as np
import pytest

from stlc.diagnostics import StlcError
from stlc.monitor.explain.report import explain
from stlc.monitor.online.online import How
from stlc.monitor.verdict import Monitor

REQUIREMENTS = {
    "state": "a > 0",
    "window": "a > 0 -> eventually[0, T] b > 0",
    "past": "historically[0 s, 0.3 s] a > -1.5 or eventually[0 s, 0.4 s] b > 1",
    "whole_past": "(once a > 1.5) and always[0 s, 0.2 s] (a > -1 since b > 0)",
    "to_the_end_of_the_window": "always[0, T] (a > 0 or eventually[0, end] b > 0)",
    "lasting": "always (a > 1.5 -> eventually[0 s, 0.3 s] b > 0.5)",
    "response": "always (a > 1.5 -> eventually b > 0.5)",
    "until": "a > -1.5 until[0.3 s, inf] b > 1",
    "met": "eventually[0.2 s, inf] (a > 1.5 and once b > 1)",
    "end_under_a_window": "eventually[0 s, 0.4 s] always a > -1.9",
}
SAMPLES = 40


@pytest.mark.parametrize("name", REQUIREMENTS)
@pytest.mark.parametrize(("end", "at"), [("open", 0), ("truncate", 0), ("truncate", 9), ("open", 39)])
def test_it_is_judged_as_the_recording_is(name: str, end, at: int) -> None:
    text = f"signal a\nsignal b\nrequire r: {REQUIREMENTS[name]}\n"
    monitor = Monitor(text, dt=0.1, horizon=0.6)
    rng = np.random.default_rng(3)
    whole = {signal: rng.integers(-16, 16, SAMPLES) / 8 for signal in ("a", "b")}
    verdict = monitor.check(whole, at=at, end=end)
    wanted = verdict["r"]
    pushed, fed = (monitor.online(How(at=at, end=end, reasons=True)) for _ in range(2))
    decided = []
    for k in range(SAMPLES):
        pushed.push({key: values[k] for key, values in whole.items()})
        decided += pushed.verdicts()
        assert not decided or k >= at
    for low, high in ((0, 7), (7, 8), (8, SAMPLES)):
        fed.feed({key: values[low:high] for key, values in whole.items()})
    for online in (pushed, fed):
        tally = online.finish()["r"]
        assert (tally.low, tally.high) == wanted.bounds
        assert (tally.status, tally.instants, tally.low_at, tally.high_at) == (wanted.overall, 1, at, at)
        cause, known = online.cause("r"), explain(verdict, "r")
        if cause is not None and known is not None:
            assert (cause.start, cause.sample, cause.because) == (known.start, known.sample, known.because)
    assert [each.start for each in decided] in ([], [at])
    for each in decided:
        assert each.status == wanted.overall


def test_there_has_to_be_such_a_sample() -> None:
    online = Monitor("signal a\nrequire r: a > 0\n", dt=0.1).online(How(at=3))
    online.push({"a": 1.0})
    with pytest.raises(StlcError, match=r"U101.*no sample 3"):
        online.finish()
