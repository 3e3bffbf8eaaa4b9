"""The ROS 2 example runs without ROS, in simulated time, and stops on what gives no decision."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from helpers.exported import ROOT, untrained

from stlc.export.write import export
from stlc.runtime import Controller

PATH = ROOT / "examples" / "ros2_callback.py"
SPEC = """spec pond
state signal x, y [m] in [-8, 8]
@safety
require no_pond: always[0, T] [x, y] not in circle([0 m, 1 m], 1.5 m)
"""


@pytest.fixture(scope="module")
def controller(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pond")
    (folder / "pond.stl").write_text(SPEC)
    run = untrained(folder / "pond.stl", ROOT / "examples" / "unicycle.yaml", folder / "runs")
    return export(run, "onnx", folder / "controller").folder


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(PATH.parent)
    monkeypatch.delitem(sys.modules, "ros2_callback", raising=False)
    monkeypatch.delitem(sys.modules, "ros2_standins", raising=False)
    return __import__("ros2_callback")


@pytest.mark.apart
def test_the_program_runs_in_simulated_time(controller: Path) -> None:
    command = [sys.executable, str(PATH), str(controller), "--seconds", "1.5"]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    verdicts = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(verdicts) == 15
    assert {verdict["rule"] for verdict in verdicts} <= {"policy", "kept"}
    assert all(math.isfinite(verdict["no_pond"]) for verdict in verdicts)


def test_the_vehicle_goes_where_the_decisions_lead(controller: Path, example: ModuleType) -> None:
    vehicle = example.Vehicle(0.1)
    example.ControllerNode(Controller.load(controller))
    example.Node.bus.spin(1.05)
    alone, state = Controller.load(controller), np.array([0.0, -4.0, math.pi / 2, 0.0])
    for _ in range(10):
        omega, accel = alone.decide(state).control
        _, _, psi, v = state
        step = 0.1 * np.array([v * math.cos(psi), v * math.sin(psi), omega, accel])
        state = np.clip(state + step, [-9, -9, -9, 0.0], [9, 9, 9, 4.0])
    np.testing.assert_allclose([vehicle.x, vehicle.y, vehicle.psi, vehicle.v], state, rtol=0.0, atol=1e-4)


def test_a_measurement_that_is_no_number_stops_the_vehicle(controller: Path, example: ModuleType) -> None:
    commands, verdicts = [], []
    node = example.ControllerNode(Controller.load(controller))
    node.create_subscription(example.Twist, "/cmd_vel", commands.append, 1)
    node.create_subscription(example.String, "/verdict", verdicts.append, 1)
    node.on_timer()
    assert commands == []  # nothing has been measured
    message = example.Odometry()
    message.pose.pose.position.x = math.nan
    node.on_odometry(message)
    node.on_timer()
    assert commands == [example.Twist()]
    assert "R107" in json.loads(verdicts[0].data)["stopped"]
