"""The plants of the ARCH-COMP falsification category against simulations of their own, and known verdicts."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

import stlc
from stlc.controller.problem.task import Task
from stlc.dynamics.system import System

pytestmark = pytest.mark.apart

ROOT = Path(__file__).parent.parent.parent
Doubles = NDArray[np.float64]
Rate = Callable[[Doubles], Doubles]


def rk4(rate: Rate, x: Doubles, h: float) -> Doubles:
    """One step of the classical Runge-Kutta method."""
    a = rate(x)
    b = rate(x + 0.5 * h * a)
    c = rate(x + 0.5 * h * b)
    return x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))


def simulated(
    name: str, horizon: str, rows: int = 6, **changes: str
) -> tuple[System, dict[str, Doubles], dict[str, Doubles]]:
    """A system, random rollouts of it (rows, steps + 1), and the reference values of its input signals.

    The rollouts are computed in C, and some of their steps also in torch.
    """
    system = System.load(ROOT / f"examples/arch/{name}.yaml", {"time.horizon": horizon, **changes})
    task = Task.of(stlc.parse("require all: true"), system)
    assert task.native is not None
    x = task.rollout(
        system.sample(rows, seed=0, dtype=torch.float64),
        torch.zeros(rows, system.horizon, 0, dtype=torch.float64),
    )
    for k in (0, 3, system.horizon - 1):
        torch.testing.assert_close(
            system.step(x[:, k], torch.zeros(rows, 0)), x[:, k + 1], rtol=1e-9, atol=1e-9
        )
    columns = {each: x[:, :, i].numpy() for i, each in enumerate(system.names)}
    times = np.arange(system.horizon + 1) * system.dt
    signals = {
        each.name: each.at(np.stack([columns[n][:, 0] for n in each.columns], 1), times)
        for each in system.decl.inputs
    }
    for signal, values in signals.items():
        np.testing.assert_array_equal(columns[signal], values)
    return system, columns, signals


def tables(system: System) -> dict[str, Callable[..., Doubles]]:
    """The tables of a system, interpolated by SciPy with lines that go on."""
    found = {}
    for table in system.decl.tables:
        values = np.array(table.values)
        grid = RegularGridInterpolator(
            table.points, values[0] if len(table.points) == 1 else values, bounds_error=False, fill_value=None
        )
        found[table.name] = lambda *at, grid=grid: grid(np.stack(np.broadcast_arrays(*at), -1))
    return found


def constant(system: System, name: str) -> Doubles:
    """A constant of a system, as a vector if it is one."""
    known = system.decl.constants
    parts = [value for key, (value, _) in known.items() if key.startswith(f"{name}[")]
    return np.array(parts) if parts else np.array(known[name][0])


def switched(mode: list[int], y: Doubles) -> list[int]:
    """Modes of the followers (chasing 0, keeping 1, braking 2) after one switch of each that is due."""
    found = []
    for each, gap in zip(mode, np.diff(y), strict=True):
        kept = 0 if gap >= 15 else 2 if gap <= 5 else 1
        found.append([int(gap <= 10), kept, 0 if gap >= 20 else 2][each])
    return found


def test_chasing_cars() -> None:
    """Each switch is bracketed by bisection with steps of the integrator, not on a polynomial."""
    system, columns, signals = simulated("chasing_cars", "12 s", 1)
    names, switches = [f"{letter}{i}" for letter in "yv" for i in range(1, 6)], 0
    for row in range(1):
        x, mode = np.concatenate((np.arange(0.0, 50.0, 10.0), np.zeros(5))), [0, 0, 0, 0]
        for k in range(system.horizon):
            throttle, brake = (signals[name][row, k] for name in ("throttle", "brake"))

            def rate(x: Doubles, throttle: float = throttle, brake: float = brake) -> Doubles:
                v = x[5:]
                up = np.where(np.array(mode) == 1, v[1:], -v[1:])  # noqa: B023 - it is called at once
                pull = np.choose(mode, [np.ones(4), np.zeros(4), -v[1:]])  # noqa: B023
                return np.concatenate((v[:1], up, [-throttle - brake * v[0]], pull))

            left = system.dt
            while left > 1e-12:
                while switched(mode, x[:5]) != mode:
                    mode, switches = switched(mode, x[:5]), switches + 1
                low, high = 0.0, left
                if switched(mode, rk4(rate, x, left)[:5]) != mode:
                    while high - low > 1e-12:
                        middle = (low + high) / 2
                        due = switched(mode, rk4(rate, x, middle)[:5]) != mode
                        low, high = (low, middle) if due else (middle, high)
                x, left = rk4(rate, x, high), left - high
        np.testing.assert_allclose([columns[name][row, -1] for name in names], x, atol=2e-5)
    assert switches >= 8


def test_levitated_magnet() -> None:
    system, columns, signals = simulated("neural_maglev", "1 s")
    low, span, least, width = (
        constant(system, name) for name in ("pos_low", "pos_span", "current_low", "current_span")
    )
    weights = {n: np.stack([constant(system, f"{n}{k}") for k in range(9)]) for n in ("f", "g")}

    def net(name: str, x: Doubles) -> Doubles:
        hidden = np.tanh(x @ weights[name].T + constant(system, f"{name}_bias"))
        return hidden @ constant(system, f"{name}_out")

    state = np.tile([0.5, 0.0], (6, 1))
    before, one, two = np.zeros(6), np.zeros(6), np.zeros(6)
    for k in range(system.horizon):
        z = 2 * (state[:, 0] - low) / span - 1
        x = np.stack((z, before, one, two), 1)
        f = 0.9921675075327889 * (net("f", x) + 0.9079050764793414)
        scale = 0.0004116938262844689 * 0.5996797859290577 * -0.8613021600806045
        g = scale * (net("g", x) + 0.8636776698074995)
        wanted = (2 * (signals["ref"][:, k] - low) / span - 1 - f) / g
        current = np.clip((wanted + 1) * width / 2 + least, -1, 4)
        if k == 0:
            np.testing.assert_allclose(f + g * current, columns["predicted"][:, 0])
        before, one, two = z, 2 * (current - least) / width - 1, one

        def rate(s: Doubles, current: Doubles = current) -> Doubles:
            force = 5 * np.sign(current) * current**2 / s[:, 0]
            return np.stack((s[:, 1], -9.8 - 4 * s[:, 1] + force), 1)

        for _ in range(4):
            state = rk4(rate, state, system.dt / 4)
    np.testing.assert_allclose(columns["pos"][:, -1], state[:, 0], atol=1e-7)
    assert columns["predicted"][:, 0] == pytest.approx(-1.4129, abs=5e-5)


def test_steam_condenser() -> None:
    system, columns, signals = simulated("steam_condenser", "10 s")
    table, mixed = tables(system), np.stack([constant(system, f"V{j}") for j in (1, 2, 3)])
    u, b, r = (constant(system, name) for name in "ubr")
    x = np.tile([90.0, 90.0, 80.0, 107.8880952381, *[0.0] * 6], (6, 1))
    for k in range(system.horizon):
        goal, steam = 90.0 if k < 40 else 87.0, signals["steam"][:, k]

        def rate(x: Doubles, goal: float = goal, steam: Doubles = steam) -> Doubles:
            inside, p, outlet, flow, d = x[:, 0], x[:, 1], x[:, 2], x[:, 3], x[:, 4:]
            z = 2 * (p - goal + 3.7742393716738434) / (5.7997431225043385 + 3.7742393716738434) - 1
            a = np.tanh(z[:, None] * u + d @ mixed.T + b)
            c = (-0.33227866684137108 + a @ r + 1) * (66.879264965962932 + 30.855068745036114) / 2
            boiling = table["boiling"](inside)
            mean = (outlet - 60) / np.log((boiling - 60) / (boiling - outlet))
            heat = mean / (0.0872924756541668 / flow**0.8 + 0.00073786772008033)
            first = 0.153842 * (steam - heat / table["latent"](inside)) * boiling
            valve = np.clip(c - 30.855068745036114 + 107.8880952381, 0, 200)
            parts = (first, (inside - p) / 0.5, (heat / 4.2 + (60 - outlet) * flow) / 500, valve - flow)
            return np.concatenate((np.stack(parts, 1), a - 10 * d[:, :3], d[:, :3] - 10 * d[:, 3:]), 1)

        x = rk4(rate, x, system.dt)
    for i, name in enumerate(("inside", "p", "outlet", "flow")):
        np.testing.assert_allclose(columns[name][:, -1], x[:, i], atol=1e-9)


def test_transmission() -> None:
    system, columns, signals = simulated("transmission", "3 s", 3)
    table = tables(system)
    x = np.tile([1000.0, 0.0], (3, 1))
    gear, phase, entered = np.ones(3), np.zeros(3), np.zeros(3)
    for k in range(system.horizon + 1):
        throttle, brake = (signals[name][:, k] for name in ("throttle", "brake"))
        speed = x[:, 1] * 2 * np.pi * 60 / 5280
        np.testing.assert_allclose(columns["speed"][:, k], speed, atol=1e-9)
        np.testing.assert_allclose(columns["rpm"][:, k], x[:, 0], atol=1e-7)
        if k % 4 == 0:
            for i in range(3):
                up, down = (table[name](gear[i], throttle[i]).item() for name in ("up", "down"))
                waited = k // 4 - entered[i] >= 2
                beyond = speed[i] >= up if phase[i] > 0 else speed[i] <= down
                if phase[i] and waited:
                    gear[i], phase[i] = gear[i] + phase[i] * beyond, 0
                elif phase[i]:
                    phase[i] = phase[i] if beyond else 0
                else:
                    phase[i], entered[i] = int(speed[i] > up) - int(speed[i] < down), k // 4
        np.testing.assert_array_equal(columns["gear"][:, k], gear)

        def rate(x: Doubles, throttle: Doubles = throttle, brake: Doubles = brake) -> Doubles:
            ratio = np.array([2.393, 1.450, 1.000, 0.677])[gear.astype(int) - 1]
            s, mph = 3.23 * x[:, 1] * ratio / x[:, 0], x[:, 1] * 2 * np.pi * 60 / 5280
            impeller = (x[:, 0] / table["capacity"](s)) ** 2
            drag = np.sign(mph) * (brake + 40 + 0.02 * mph**2)
            engine = (table["torque"](throttle, x[:, 0]) - impeller) / 0.021991488283555904
            wheel = (3.23 * ratio * impeller * table["gain"](s) - drag) / 12.094147857312473
            return np.stack((engine, wheel), 1)

        x = rk4(rate, x, system.dt)
        x[:, 0] = np.clip(x[:, 0], 600, 6000)
    assert gear.max() > 1


class Engine:
    """Fuel control with a backward Euler step of the pressure by bisection, and a recorded exhaust."""

    def __init__(self, system: System, rpm: Doubles) -> None:
        self.rpm, self.w = rpm, rpm * np.pi / 30
        self.table = tables(system)

    def cylinder(self, p: Doubles) -> Doubles:
        w = self.w
        return 0.9 * (-0.366 + 0.08979 * p * w - 0.0337 * w * p**2 + 0.0001 * p * w**2)

    @staticmethod
    def air(theta: Doubles, p: Doubles) -> Doubles:
        area = 2.821 - 0.05231 * theta + 0.10299 * theta**2 - 0.00063 * theta**3
        ratio = np.minimum(p, 1 / p)
        choke = np.where(ratio < 0.5, 1.0, 2 * np.sqrt(ratio - ratio**2))
        return area * choke * np.sign(1 - p)

    def pressure(self, p: Doubles, theta: Doubles, h: float) -> Doubles:
        low, high = np.full_like(p, 0.05), np.ones_like(p)
        for _ in range(30):
            middle = (low + high) / 2
            above = middle - p > h * 0.41328 * (self.air(theta, middle) - self.cylinder(middle))
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        return (low + high) / 2

    def run(self, throttle: Doubles, seconds: float, h: float = 0.001) -> tuple[Doubles, Doubles]:
        """Measured air-fuel ratio and mu, every 10 ms; throttle as (rows, samples)."""
        rows, q = len(self.rpm), np.full(len(self.rpm), 0.982)
        opened, p, film = np.zeros(rows), np.full(rows, 0.982), np.full(rows, 0.0112)
        smooth, measured, total = np.full(rows, 14.7), np.full(rows, 14.7), np.zeros(rows)
        power, way = np.zeros(rows, bool), np.zeros(rows)
        ways = [np.full(rows, -9.0), np.full(rows, -1e-6)]
        ratios, found = [np.full(rows, 14.7)] * 2, []
        for k in range(round(seconds / 0.01) + 1):
            theta = np.clip(opened + 8.8, 0, 90)
            fuel, wanted = np.full(rows, 0.1726), np.full(rows, 14.7)
            if k:
                power = (theta >= 70) | (power & (theta >= 50))
                wanted = np.where((k >= 1000) & power, 12.5, 14.7)
                guess = self.cylinder(q) / 0.9
                q = q + 0.01 * 0.41328 * (self.air(theta, p) - guess)
                closed, error = (k >= 1000) & ~power, measured - wanted
                total = total + closed * 0.0014 * error
                trim = np.where(closed, np.maximum(0, 1 + 0.04 * error + total), 1)
                fuel = np.clip(guess / wanted * trim, 0.13, 1.66)
            found.append((measured, measured / wanted - 1 if k >= 100 else np.zeros(rows)))
            for _ in range(round(0.01 / h)):
                charge = np.pi * self.cylinder(p) / self.w
                kept, drying = (self.table[name](self.rpm, charge) for name in ("kept", "drying"))
                ways.append(way)
                ratios.append(self.cylinder(p) / (kept * fuel + film / drying))
                way = way + h / self.table["transport"](self.rpm, charge)
                past, known = np.array(ways[-600:]), np.array(ratios[-600:])
                late = np.array([np.interp(way[i] - 1, past[:, i], known[:, i]) for i in range(rows)])
                smooth, measured = (
                    smooth + 10 * h * (late - smooth),
                    measured + (1 - np.exp(-50 * h)) * (smooth - measured),
                )
                film = film + h * ((1 - kept) * fuel - film / drying)
                opened = opened + (1 - np.exp(-10 * h)) * (throttle[:, k] - opened)
                p = self.pressure(p, np.clip(opened + 8.8, 0, 90), h)
        return np.transpose(np.array(found), (1, 2, 0))[0], np.transpose(np.array(found), (1, 2, 0))[1]


def test_fuel_control() -> None:
    system, columns, signals = simulated("fuel_control", "1.6 s", 3)
    measured, mu = Engine(system, signals["speed"][:, 0]).run(signals["throttle"], 1.6, 0.002)
    # the first exhaust arrives suddenly, and up to one step apart; from 14.7 it rises to 37
    np.testing.assert_allclose(columns["ratio"], measured, atol=0.5)
    np.testing.assert_allclose(columns["ratio"][:, 70:], measured[:, 70:], atol=0.05)
    np.testing.assert_allclose(columns["mu"][:, 101:], mu[:, 101:], atol=0.004)


@pytest.mark.slow
def test_fuel_control_with_its_loop_closed() -> None:
    system, columns, signals = simulated("fuel_control", "15 s", 3, **{"inputs.throttle.duration": "15 s"})
    _, mu = Engine(system, signals["speed"][:, 0]).run(signals["throttle"], 15.0)
    np.testing.assert_allclose(columns["mu"][:, 1010:], mu[:, 1010:], atol=3e-4)
    assert np.abs(mu[:, 1010:]).max() > 0.0015


AEROBENCH = {
    0: (570.428, 0.0112245, 0.216377, -1.2352, -0.783518, -0.305537, 114.484, -122.741, 1808.75, 9.03738),
    1: (568.647, 0.0123565, 0.155471, -1.08707, -1.17802, -0.218863, 89.3154, -227.607, 1840.48, 9.03738),
}
"""Row -> some states after 1 s, by AeroBenchVVPython (github.com/stanleybak/AeroBenchVVPython, afa9f0a)."""


def test_f16() -> None:
    """Two trajectories, and the least altitudes in ft, are those of AeroBenchVVPython with its own RK45."""
    task = Task.load(ROOT / "specs/arch/f16.stl")
    names, const = task.system.names, partial(constant, task.system)
    x0 = task.sample(4, seed=0, dtype=torch.float64)
    shares = {"roll": [1.0, 0.0, 0.95, 1.0], "pitch": [0.0, 1.0, 0.0, 0.01], "yaw": [0.5, 0.0, 0.5, 0.5]}
    for (limits, share), name in zip(shares.items(), ("phi", "theta", "psi"), strict=True):
        low, high = const(limits)
        x0[:, names.index(name)] = torch.from_numpy(low + (high - low) * np.array(share))
    found = task.judge(x0, torch.zeros(4, task.horizon, 0, dtype=torch.float64))
    shown = ("V", "A", "phi", "theta", "psi", "p", "north", "east", "altitude", "power")
    for row, wanted in AEROBENCH.items():
        state = [found.columns[name][90, row].item() for name in shown]
        assert state == pytest.approx(wanted, rel=2e-3, abs=2e-3)
    least = found.columns["altitude"].min(0).values.numpy()
    np.testing.assert_allclose(least, [-0.0632, 448.6654, -0.2756, 3.3149], atol=0.02)
    np.testing.assert_allclose(found.requirements[:, 0], least * 0.3048, rtol=1e-6)


def judged(
    spec: str, inputs: list[tuple[float | tuple[float, ...], ...]]
) -> tuple[dict[str, list[float]], dict[str, torch.Tensor]]:
    """Robustness by requirement, and states, under input signals: a constant, or a value for each piece."""
    task = Task.load(ROOT / f"specs/arch/{spec}.stl")
    names = task.system.names
    x0 = task.sample(len(inputs), seed=0, dtype=torch.float64)
    for decl, values in zip(task.system.decl.inputs, zip(*inputs, strict=True), strict=True):
        pieces = np.stack([np.broadcast_to(value, decl.points) for value in values])
        for name, column in zip(decl.values, pieces.T, strict=True):
            x0[:, names.index(name)] = torch.tensor(column, dtype=torch.float64)
        x0[:, names.index(decl.name)] = torch.tensor(pieces[:, 0], dtype=torch.float64)
    found = task.judge(x0, torch.zeros(len(inputs), task.horizon, 0, dtype=torch.float64))
    return {rule.name: found.requirements[:, i].tolist() for i, rule in enumerate(task.rules)}, dict(
        found.columns
    )


def test_settled_pressures_of_the_condenser() -> None:
    rho, columns = judged("steam_condenser", [(3.99,), (4.0,), (4.01,)])
    np.testing.assert_allclose(columns["p"][-1], [87.258, 87.293, 87.328], atol=5e-4)
    assert min(rho["SC"]) > 0.17


@pytest.mark.slow
def test_constant_inputs_that_falsify() -> None:
    cars, _ = judged("chasing_cars", [(1, 0), (0, 0), (0, 1)])
    assert cars["CC1"][0] < -100
    assert max(cars["CC2"][1:]) == pytest.approx(-5.0)
    assert cars["CC3"][0] < -1
    drive, columns = judged("transmission", [(100, 0), (100, 325), (50, 0)])
    assert drive["AT1"][0] == pytest.approx(-0.213, abs=5e-4)
    assert drive["AT2"][1] == pytest.approx(-10.6, abs=0.05)
    assert columns["rpm"][:1000, 2].max().item() == pytest.approx(3024, abs=1)
    rapid = [tuple([0.0, 61.1][k % 2] for k in range(10)), tuple([61.2, 81.2][k % 2] for k in range(10))]
    fuel, columns = judged("fuel_control", [(rapid[0], 1100)])
    assert columns["mu"][1100:].abs().max().item() == pytest.approx(0.0093, abs=2e-4)
    assert fuel["AFC27"][0] == pytest.approx(-0.00057, abs=2e-4)
    power, columns = judged("fuel_control_power", [(rapid[1], speed) for speed in (900, 1000, 1100)])
    assert columns["mu"][1100:].abs().max().item() < 0.0057
    assert min(power["AFC33"]) > 0.001
    overshoot, _ = judged("neural_maglev_narrow", [(ref,) for ref in np.linspace(1.95, 2.05, 40)])
    assert min(overshoot["NNx"]) == pytest.approx(0.0397, abs=2e-4)
