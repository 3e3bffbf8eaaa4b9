"""FMUs of both versions and interfaces, against solutions that are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.plants import read, simulated
from scipy.integrate import solve_ivp

from stlc.monitor.verdict import Monitor
from stlc.plants.kind import UnfitError
from stlc.plants.plant import Plant
from stlc.plants.worker import ControlledPlant
from stlc.toolchain import compiler

pytest.importorskip("fmpy")
if compiler() is None:
    pytest.skip("no C compiler", allow_module_level=True)

from helpers.fmus import MODELS, build

FMIS = (2, 3)
INTERFACES = ("co-simulation", "model exchange")
BALL = """\
plant: 1
name: ball
fmu: {{file: ball.fmu, interface: {interface}, tolerance: 1e-9}}
time: {{dt: 10 ms, duration: 1.5 s}}
initial: {{h: {{unit: m, range: [0.5, 2]}}}}
param: {{e: {{range: [0.5, 0.9]}}, lifetime: {{unit: s, range: [0, 1e6]}}, frozen: {{range: [0, 1]}}}}
input: {{force: {{range: [-1, 1]}}}}
output: {{h: {{unit: m}}, v: {{unit: m/s}}, bounces: }}
"""
DECAY = """\
plant: 1
name: decay
fmu: {{file: decay.fmu, interface: {interface}, tolerance: 1e-9}}
time: {{dt: 50 ms, duration: 2 s}}
initial: {{x: {{range: [0, 5]}}}}
param: {{k: {{range: [0, 5]}}}}
input: {{force: {{range: [-5, 5]}}}}
output: {{x: , slope: {{from: der(x)}}}}
"""
OSCILLATOR = """\
plant: 1
name: oscillator
fmu: {{file: oscillator.fmu, interface: {interface}, tolerance: 1e-9}}
time: {{dt: 0.1 s, duration: 10 s}}
param: {{mu: {{range: [0, 5]}}}}
input: {{force: 0}}
output: {{x0: , x1: }}
"""
both = pytest.mark.parametrize("interface", INTERFACES)


@pytest.fixture(scope="module", params=FMIS, ids=["fmi2", "fmi3"])
def folder(request, tmp_path_factory):
    path = tmp_path_factory.mktemp(f"fmi{request.param}")
    for model in MODELS:
        build(path, model, request.param)
    return path


def ran(text, folder, tmp_path, interface, values, inputs=None):
    return simulated(read(text.format(interface=interface), folder), tmp_path, values, inputs)


def bounced(h, e, g, times):
    """Height and velocity of a ball, from the times of its bounces."""
    rows = []
    for t in times:
        start, speed, height, fall = 0.0, 0.0, h, np.sqrt(2 * h / g)
        while t > start + fall:
            start, height, speed = start + fall, 0.0, e * abs(speed - g * fall)
            fall = 2 * speed / g
        s = t - start
        rows.append((height + speed * s - g * s * s / 2, speed - g * s))
    return np.array(rows)


@both
def test_a_ball_bounces(folder, tmp_path, interface):
    found = ran(
        BALL, folder, tmp_path, interface, {"h": 1.4, "e": 0.8, "lifetime": 1e6}, np.full((150, 1), 0.5)
    )
    wanted = bounced(1.4, 0.8, 9.31, 0.01 * np.arange(151))
    assert found[:, :2] == pytest.approx(wanted, abs=1e-5)
    assert found[-1, 2] == 2


@both
def test_inputs_are_constant_during_a_step(folder, tmp_path, interface):
    u = np.repeat([[1.0], [-2.0]], 20, axis=0)
    found = ran(DECAY, folder, tmp_path, interface, {"x": 3.0, "k": 1.5}, u)
    t = 0.05 * np.arange(21)
    first = u[0] / 1.5 + (3.0 - u[0] / 1.5) * np.exp(-1.5 * t)
    second = u[-1] / 1.5 + (first[-1] - u[-1] / 1.5) * np.exp(-1.5 * t)
    assert found[:, 0] == pytest.approx(np.concatenate((first, second[1:])), abs=1e-6)
    assert found[10, 1] == pytest.approx(1.0 - 1.5 * found[10, 0])


@both
def test_the_oscillator_is_that_of_van_der_pol(folder, tmp_path, interface):
    found = ran(OSCILLATOR, folder, tmp_path, interface, {"mu": 2.0})
    slope = lambda _t, x: [x[1], 2.0 * (1 - x[0] ** 2) * x[1] - x[0]]  # noqa: E731
    wanted = solve_ivp(slope, (0, 10), [2, 0], t_eval=0.1 * np.arange(101), rtol=1e-10, atol=1e-10).y.T
    assert found == pytest.approx(wanted, abs=1e-4)


@both
def test_an_fmu_may_end_the_simulation(folder, tmp_path, interface):
    found = ran(BALL, folder, tmp_path, interface, {"h": 1.0, "e": 0.8, "lifetime": 0.305})
    assert 31 <= len(found) <= 33


@both
def test_a_truth_value_is_a_parameter(folder, tmp_path, interface):
    found = ran(BALL, folder, tmp_path, interface, {"h": 1.0, "frozen": 1.0, "lifetime": 1e6})
    assert (found[:, 0] == 1.0).all()


def test_instances_are_independent(folder, tmp_path):
    simulator = ControlledPlant(read(BALL.format(interface="model exchange"), folder).layout(str(tmp_path)))
    rows = []
    for h in (1.0, 1.7, 1.0):
        simulator.start({"seed": 0}, np.array([[h, 0.7, 1e6, 0.0, 0.0]]))
        rows.append(simulator.advance({}, np.zeros((80, 1))).array)
    assert (rows[0] == rows[2]).all()
    assert (rows[0] != rows[1]).any()


def test_units_are_those_of_the_fmu(folder, tmp_path):
    units = ControlledPlant(read(BALL.format(interface="co-simulation"), folder).layout(str(tmp_path))).units
    assert units == {"h": "m^1", "v": "m^1*s^-1"}


@pytest.mark.parametrize(
    ("old", "new", "place", "said"),
    [
        ("ball.fmu", "bal.fmu", "", "no file"),
        ("ball.fmu", "stubs.h", "", "not an FMU|cannot be read"),
        ("{{h: {{unit: m}}", "{{height: {{unit: m}}", "output.height", "no variable `height`"),
        ("{{force:", "{{u: {{from: h, value: 0}}, force:", "input.u", "its inputs: force"),
        (
            "initial: {{h:",
            "initial: {{der: {{from: der(h), value: 1}}, h:",
            "initial.der",
            "cannot|can be set",
        ),
    ],
)
def test_what_the_fmu_lacks_is_refused(folder, tmp_path, old, new, place, said):
    assert old in BALL
    text = BALL.replace(old, new)
    with pytest.raises(UnfitError, match=said) as caught:
        ran(text, folder, tmp_path, "co-simulation", {})
    assert caught.value.place == place


@pytest.mark.bench
@both
def test_memory_does_not_grow_with_a_simulation(folder, interface):
    """A million steps take as much memory as a hundred thousand, in the plant's process and in this one."""
    peaks = []
    for seconds in (10_000, 100_000):
        text = OSCILLATOR.format(interface=interface).replace("duration: 10 s", f"duration: {seconds} s")
        spec = "signal x0\nrequire low: always x0 <= 3\nrequire returns: always eventually[0 s, 20 s] x0 <= 0"
        with Plant(read(text + "limit: {time: 1 h}\n", folder)) as plant:
            online = Monitor(spec, dt=0.1).online()
            assert plant.watch(np.array([1.0]), online) is None
            worker = plant._processes[0]._process.pid
            peaks.append((_peak(worker), _resident()))
        assert online.samples == 10 * seconds + 1
        assert online.finish()["low"].status == "satisfied"
    (plant_before, here_before), (plant_after, here_after) = peaks
    assert plant_after - plant_before < 2_000  # kilobytes; a million samples of two signals are 16,000
    assert here_after - here_before < 4_000


def _peak(pid: int) -> int:
    """Greatest resident memory of a process until now, in kilobytes."""
    return _status(pid, "VmHWM")


def _resident() -> int:
    """Resident memory of this process, in kilobytes."""
    return _status("self", "VmRSS")


def _status(pid: int | str, name: str) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1])
