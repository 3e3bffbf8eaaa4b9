"""Jumps that are located within a step: instants, chains at one instant, and what they refuse."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

import stlc
from stlc.controller.problem.task import Task
from stlc.diagnostics import StlcError
from stlc.dynamics.system import System

Make = Callable[..., System]
BALL = """\
time: {dt: 0.1 s, horizon: 30 steps, integrator: rk4}
state: {y: {unit: m}, v: {unit: m/s}, bounces: {}}
flow: {y: v, v: -10 m/s^2}
jump:
  - {guard: y <= 0 m and v < 0 m/s, reset: {v: -0.8 * v, bounces: bounces + 1}, located: true}
init: {mixture: [{draw: {y: "uniform(2, 4)", v: 0, bounces: 0}}]}
"""


def rolled(system: System, rows: int = 5) -> dict[str, np.ndarray]:
    """Columns (batch, steps + 1) of a rollout in torch."""
    x0 = system.sample(rows, seed=0, dtype=torch.float64)
    x = system.rollout(x0, torch.zeros(rows, system.horizon, 0, dtype=torch.float64))
    return {name: x[:, :, i].numpy() for i, name in enumerate(system.names)}


def test_a_ball_bounces_when_it_hits_the_ground(make: Make) -> None:
    columns = rolled(make(BALL))
    times = np.arange(31) * 0.1
    for row, height in enumerate(columns["y"][:, 0]):
        start, fall = 0.0, math.sqrt(2 * height / 10)
        start, speed = fall, 0.8 * 10 * fall
        y, bounces = height - 5 * times**2, np.zeros(31)
        while start < 3.0:
            after = times >= start
            y[after] = (speed * (times - start) - 5 * (times - start) ** 2)[after]
            bounces += after
            start, speed = start + 2 * speed / 10, 0.8 * speed
        np.testing.assert_allclose(columns["y"][row], y, atol=2e-5)
        np.testing.assert_array_equal(columns["bounces"][row], bounces)


def test_jumps_at_the_end_of_a_step_are_the_default(make: Make) -> None:
    columns = rolled(make(BALL.replace(", located: true", "")))
    assert columns["y"].min() < -0.1


CHAIN = """\
time: {{dt: 0.5 s, horizon: 4 steps, integrator: euler{more}}}
state: {{x: {{}}, mode: {{enum: [a, b, c, d]}}, count: {{}}, other: {{}}}}
flow: {{x: 1 / (1 s)}}
jump:
  - {{guard: mode == a and x >= 0, reset: {{mode: b}}, located: true}}
  - {{guard: mode == b and x >= 0, reset: {{mode: c}}, located: true}}
  - {{guard: x >= 0, reset: {{count: count + 1}}, located: true}}
  - {{guard: x >= 0.3, reset: {{other: x}}, located: true, once: true}}
  - {{guard: x >= 0.7, reset: {{mode: d}}}}
init: {{mixture: [{{draw: {{x: 0, mode: a, count: 0, other: 0}}}}]}}
"""


def test_chains_at_one_instant_and_guards_that_stay(make: Make) -> None:
    columns = {name: column[0].tolist() for name, column in rolled(make(CHAIN.format(more="")), 1).items()}
    assert columns["mode"] == [0, 2, 2, 3, 3]  # two switches at time 0; the last jump is not located
    assert columns["count"] == [0, 1, 2, 3, 4]  # a guard that stays makes it happen once a step
    assert columns["other"][1:] == pytest.approx([0.3] * 4, abs=1e-6)
    finer = rolled(make(CHAIN.format(more=", substeps: 2")), 1)
    assert finer["count"][0].tolist() == [0, 2, 4, 6, 8]


def test_c_agrees_with_torch(make: Make) -> None:
    system = make(BALL)
    task = Task.of(stlc.parse("state signal y [m]\nrequire r: always y > -1 m"), system)
    x0, u = task.sample(20, seed=1, dtype=torch.float64), torch.zeros(20, 30, 0, dtype=torch.float64)
    assert task.native is not None
    judged = task.judge(x0, u)
    _, columns = task._judged_by_torch(x0, u)
    for name in system.names:
        torch.testing.assert_close(judged.columns[name], columns[name], atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (("state:", "control: {u: {range: [0, 1]}}\nstate:"), "E015"),
        (("integrator: rk4", "discrete: true"), "E015"),
        (("located: true", "located: 3"), "S103"),
    ],
)
def test_what_is_refused(make: Make, change: tuple[str, str], code: str) -> None:
    with pytest.raises(StlcError) as error:
        make(BALL.replace(*change))
    assert code in [finding.code for finding in error.value.diagnostics]
