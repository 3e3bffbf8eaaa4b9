"""The monitor node runs without ROS, in simulated time: verdicts with causes on /diagnostics."""

from __future__ import annotations

import sys
from types import ModuleType

import pytest
from helpers.exported import ROOT

from stlc import Monitor


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "examples")
    monkeypatch.delitem(sys.modules, "ros2_monitor", raising=False)
    monkeypatch.delitem(sys.modules, "ros2_standins", raising=False)
    return __import__("ros2_monitor")


def test_verdicts_come_on_diagnostics(example: ModuleType) -> None:
    from ros2_standins import Odometry

    monitor = Monitor(
        "signal v [m/s]\nrequire slow: always v < 2 m/s\nrequire moves: eventually[0, 1 s] v > 0.5 m/s"
    )
    node = example.MonitorNode(monitor, 0.1, {"v": "/odom:twist.twist.linear.x"}, {"/odom": Odometry})
    told = []
    node.create_subscription(example.DiagnosticArray, "/diagnostics", told.append, 10)
    odometry, speeds = node.create_publisher(Odometry, "/odom", 1), iter([0.0] * 5 + [1.0] * 5 + [3.0] * 100)

    def measured() -> None:
        message = Odometry()
        message.twist.twist.linear.x = next(speeds)
        odometry.publish(message)

    node.create_timer(0.1, measured)
    example.Node.bus.spin(2.0)
    found = {status.name: status for array in told for status in array.status}
    assert {name: status.level for name, status in found.items()} == {
        "stlc: slow": b"\x02",
        "stlc: moves": b"\x00",
    }
    assert "v = 3 m/s" in found["stlc: slow"].message
    assert found["stlc: moves"].values[0].value == "0 s"


def test_a_violation_is_not_told_with_the_cause_of_a_worse_one(example: ModuleType) -> None:
    node = example.MonitorNode(
        Monitor("signal x\nrequire r: always[0, T] x > 0", horizon=2.0), 1.0, {"x": "/x:data"}, {}
    )
    told = []
    node.create_subscription(
        example.DiagnosticArray, "/diagnostics", lambda each: told.extend(each.status), 10
    )
    for value in (1, -5, 1, 1, -1, 1):
        node.latest["x"] = float(value)
        node.on_timer()
    messages = {status.values[0].value: status.message for status in told}
    assert messages["0 s"] == messages["1 s"] == "`x > 0` is false where x = -5, at t = 1 s"
    assert messages["2 s"] == messages["4 s"] == "violated"


def test_every_signal_needs_a_topic(example: ModuleType) -> None:
    with pytest.raises(SystemExit, match="no topic for the signals v"):
        example.MonitorNode(Monitor("signal v\nrequire r: v > 0"), 0.1, {}, {})


@pytest.mark.parametrize("signal", ["v", "v=/odom", "v=/odom:", "=/odom:x"])
def test_a_signal_is_named_with_its_topic_and_field(
    example: ModuleType, signal: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["ros2_monitor.py", "v.stl", "--dt", "1", "--signal", signal])
    with pytest.raises(SystemExit):
        example.main()
    assert f"--signal {signal} is not NAME=TOPIC:FIELD" in capsys.readouterr().err
