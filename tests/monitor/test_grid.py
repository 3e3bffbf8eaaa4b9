"""The step of a recording beside the windows of requirements."""

from __future__ import annotations

import numpy as np
import pytest

from stlc.diagnostics import TraceError
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.trace import Trace
from stlc.trace.recording import Clock


def recording(step: float, unit: str = "") -> Trace:
    data = {"x": np.zeros((1, 40))}
    return Trace(Signature((Column("x"),)), step, data, name="l.csv", clocks=(Clock("t", unit),))


@pytest.mark.parametrize(
    ("step", "window", "code"),
    [
        (100.0, "500 s", "E607"),  # ms
        (20000.0, "60000 s", "E607"),  # us
        (1e7, "2e7 s", "E607"),  # ns
        (500.0, "2 h", "E607"),
        (0.1, "5 s", None),
        (1.0, "5 s", None),
        (60.0, "600 s", None),  # minutes, hours, days
        (900.0, "3600 s", None),
        (86400.0, "864000 s", None),
        (10.0, "10 s", None),
        (30e6, "60e6 s", "E607"),  # ns
        (16666.7, "1e5 s", "E607"),  # us
        (100.0, "20000 s", None),  # many steps: seconds are as likely
        (0.1, "0.05 s", "E602"),
        (1000.0, "10 s", "E602"),
    ],
)
def test_steps_that_are_hardly_seconds(step: float, window: str, code: str | None) -> None:
    monitor = Monitor(f"signal x\nrequire r: always[0 s, {window}] x < 3")
    if code is None:
        monitor.check(recording(step))
        return
    with pytest.raises(TraceError) as caught:
        monitor.check(recording(step))
    (finding,) = caught.value.diagnostics
    assert finding.code == code
    assert finding.span is not None
    assert any("--clock t:" in line for line in finding.help)


def test_a_unit_that_is_stated_is_believed() -> None:
    assert Monitor("signal x\nrequire r: always[0 s, 500 s] x < 3").check(recording(100.0, "s")).satisfied
    assert Monitor("signal x\nrequire r: always x < 3").check(recording(100.0)).satisfied  # no window
