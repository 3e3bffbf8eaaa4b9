"""Held values: computed at samples before the flow, constant in between, with values of earlier samples."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

import stlc
from stlc.controller.problem.task import Task
from stlc.diagnostics import StlcError
from stlc.dynamics.system import System

Make = Callable[..., System]
PLANT = (
    "time: {dt: 0.1 s, horizon: 20 steps, integrator: rk4}\n"
    "state: {x: {unit: m}, y: {unit: m}}\n"
    "init: {mixture: [{draw: {x: 'uniform(0, 2)', y: 1}}]}\n"
)


def rolled(system: System, rows: int = 4) -> dict[str, np.ndarray]:
    """Columns (batch, steps) of a rollout, which step by step gives, too."""
    x0 = system.sample(rows, seed=0, dtype=torch.float64)
    u = torch.zeros(rows, system.horizon, 0, dtype=torch.float64)
    x = system.rollout(x0, u)
    one = x0
    for k in range(system.horizon):
        one = system.step(one, u[:, k])
        torch.testing.assert_close(one, x[:, k + 1], atol=1e-12, rtol=1e-12)
    return {name: x[:, :, i].numpy() for i, name in enumerate(system.names)}


def test_a_sampled_controller_acts_without_delay_and_is_constant_within_a_step(make: Make) -> None:
    system = make(PLANT + "held: {u: {value: -2 * x / 1 s}}\nflow: {x: u}\n")
    columns = rolled(system)
    np.testing.assert_allclose(columns["x"], columns["x"][:, :1] * 0.8 ** np.arange(21), atol=1e-12)
    np.testing.assert_allclose(columns["u"], -2 * columns["x"], atol=1e-12)


def test_a_period_holds_the_value_between_its_samples(make: Make) -> None:
    system = make(PLANT + "held: {u: {every: 0.3 s, value: x}}\nflow: {x: 1 m/s}\n")
    columns = rolled(system)
    np.testing.assert_array_equal(columns["u"], columns["x"][:, np.arange(21) // 3 * 3])
    assert columns["step_count"][0].tolist() == list(range(21))


def test_values_of_earlier_samples(make: Make) -> None:
    system = make(
        PLANT + "held:\n"
        "  sum: {value: prev(sum) + x, before: 0}\n"
        "  three: {value: prev(prev(prev(x)))}\n"
        "  fib: {value: prev(fib) + prev(prev(fib)), before: 1}\n"
        "  mean: {every: 2 steps, value: (x + prev(x)) / 2}\n"
        "  slow: {every: 2 steps, value: prev(prev(slow)) + 1, before: 0}\n"
        "flow: {x: 1 m/s}\n"
    )
    columns = rolled(system)
    x = columns["x"]
    np.testing.assert_allclose(columns["sum"], np.cumsum(x, 1), atol=1e-12)
    np.testing.assert_array_equal(columns["three"], x[:, np.maximum(np.arange(21) - 3, 0)])
    assert columns["fib"][0, :8].tolist() == [2, 3, 5, 8, 13, 21, 34, 55]
    ticks = np.arange(21) // 2 * 2
    np.testing.assert_allclose(
        columns["mean"], (x[:, ticks] + x[:, np.maximum(ticks - 2, 0)]) / 2, atol=1e-12
    )
    assert columns["slow"][0, :10].tolist() == [1, 1, 1, 1, 2, 2, 2, 2, 3, 3]


def test_order_follows_from_what_is_read(make: Make) -> None:
    system = make(PLANT + "held: {b: {value: 2 * a}, a: {value: x + c}, c: {value: y}}\nflow: {x: 1 m/s}\n")
    columns = rolled(system)
    np.testing.assert_allclose(columns["b"], 2 * (columns["x"] + columns["y"]))


def test_modes_vectors_and_truth(make: Make) -> None:
    system = make(
        PLANT + "held:\n"
        "  mode:\n    enum: [low, high]\n    before: low\n"
        "    value: if prev(mode) == low then (if x > 1.5 m then high else low)"
        " else if x < 1 m then low else high\n"
        "  v: {size: 2, unit: m, value: '[x, prev(v[0])]', before: 0}\n"
        "  over: {bool: true, value: x > 1 m}\n"
        "flow: {x: if mode == low then 1 m/s else -1 m/s}\n"
    )
    columns = rolled(system)
    mode, wanted = np.zeros(4), np.zeros((4, 21))
    for k, x in enumerate(columns["x"].T):
        mode = np.where(mode == 0, x > 1.5, ~(x < 1)).astype(float)
        wanted[:, k] = mode
    np.testing.assert_array_equal(columns["mode"], wanted)
    assert 0 < wanted.mean() < 1
    np.testing.assert_array_equal(columns["over"], columns["x"] > 1)
    np.testing.assert_array_equal(columns["v[1]"][:, 1:], columns["x"][:, :-1])
    assert system.decl.signature["mode"].labels == (("low", 0.0), ("high", 1.0))


def test_c_agrees_with_torch(make: Make) -> None:
    system = make(
        PLANT + "inputs: {w: {unit: m/s, range: [-1, 1], pieces: 4, interpolate: linear}}\n"
        "held: {u: {every: 0.2 s, value: -tanh(prev(x) / 1 m) + prev(u) / 2, before: 0}}\n"
        "flow: {x: u * 1 m/s + w}\n"
    )
    task = Task.of(
        stlc.parse("state signal x [m]\nstate signal u\nrequire r: always x < 1 m and u < 1"), system
    )
    x0, u = task.sample(20, seed=1, dtype=torch.float64), torch.zeros(20, 20, 0, dtype=torch.float64)
    assert task.native is not None
    judged = task.judge(x0, u)
    _, columns = task._judged_by_torch(x0, u)
    for name in system.names:
        torch.testing.assert_close(judged.columns[name], columns[name], atol=1e-12, rtol=0)


def test_gradients_pass_through_held_values(make: Make) -> None:
    system = make(PLANT + "held: {u: {value: -2 * x / 1 s}}\nflow: {x: u}\n")
    x0 = system.sample(1, seed=0, dtype=torch.float64).requires_grad_()
    last = system.rollout(x0, torch.zeros(1, 20, 0, dtype=torch.float64))[:, -1, 0]
    (gradient,) = torch.autograd.grad(last.sum(), x0)
    names = system.names
    # the first step is moved by the initial value of u, every later one by x
    assert gradient[0, names.index("x")].item() == pytest.approx(0.8**19)
    assert gradient[0, names.index("u")].item() == pytest.approx(0.1 * 0.8**19)


def test_what_policies_see_and_what_is_shown(make: Make) -> None:
    system = make(PLANT + "held: {u: {every: 0.2 s, value: prev(x)}}\n")
    assert [num.name for num in system.decl.policy.observe] == ["x", "y", "u"]
    assert set(system.decl.hidden) == {"step_count", "x_1_ago_of_2"}
    assert "u       any  = prev(x)" in system.decl.describe()


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("held: {u: {value: prev(u) + x}}", "S102"),
        ("held: {u: {value: u + x}}", "S202"),
        ("control: {a: {range: [-1, 1]}}\nheld: {u: {value: x / (1 m) + a}}", "S202"),
        ("control: {a: {range: [-1, 1]}}\nheld: {u: {value: prev(a)}}", "S202"),
        ("control: {a: {range: [-1, 1]}}\ndelay: {d: {of: a, by: 0.2 s}}", "S202"),
        ("held: {a: {value: b}, b: {value: a}}", "S202"),
        ("held: {u: {value: next(x)}}", "S201"),
        ("held: {u: {value: 'always[0 s, 1 s] x > 0 m'}}", "S201"),
        ("held: {u: {value: 'uniform(0, 1)'}}", "S201"),
        ("held: {u: {every: 0.25 s, value: x}}", "S103"),
        ("held: {u: {unit: s, value: x}}", "E203"),
        ("held: {u: {every: 0.2 s}}", "S102"),
        ("held: {x: {value: 1}}", "E102"),
        ("held: {u: {value: x}}\nflow: {u: 1}", "S202"),
        ("held: {u: {value: x}}\njump: [{guard: x > 1 m, reset: {u: 0}}]", "S202"),
        ("flow: {x: prev(y)}", "S201"),
        ("def: {d: prev(y)}", "S201"),
    ],
)
def test_wrong_declarations(make: Make, text: str, code: str) -> None:
    with pytest.raises(StlcError) as error:
        make(PLANT + text + "\n")
    assert code in [finding.code for finding in error.value.diagnostics]


# -------------------------------------------------------------------------------- delays


def test_delays(make: Make) -> None:
    system = make(
        PLANT + "inputs: {w: {unit: m/s, range: [-1, 1], pieces: 5}}\n"
        "delay:\n"
        "  one: {unit: m, of: x, by: 1}\n"
        "  late: {unit: cm, of: 2 * x + y, by: 0.5 s, before: 7 cm}\n"
        "  wind: {of: w, by: 3 steps}\n"
        "flow: {x: wind, y: (late - y) / 1 s}\n"
    )
    columns = rolled(system)
    steps = np.arange(21)
    np.testing.assert_array_equal(columns["one"], columns["x"][:, np.maximum(steps - 1, 0)])
    np.testing.assert_array_equal(columns["wind"], columns["w"][:, np.maximum(steps - 3, 0)])
    value = 100 * (2 * columns["x"] + columns["y"])
    wanted = np.where(steps < 5, 7.0, value[:, np.maximum(steps - 5, 0)])
    np.testing.assert_allclose(columns["late"], wanted, atol=1e-9)
    assert {"one_now", "late_now", "late_now_4_ago"} <= set(system.decl.hidden)
    assert [num.name for num in system.decl.policy.observe] == ["x", "y", "w", "one", "late", "wind"]


VARYING = (
    "time: {dt: 0.1 s, horizon: 60 steps, integrator: rk4}\n"
    "state: {phase: {}, x: {unit: m}}\n"
    "def: {wait: 0.5 s + 0.3 s * sin(phase), value: 1 m * cos(2 * phase)}\n"
    "flow: {phase: 1 / (1 s), x: late / (1 s)}\n"
    "init: {mixture: [{draw: {phase: 'uniform(0, 6)', x: 0}}]}\n"
)


@pytest.mark.parametrize("transport", [False, True])
def test_delays_that_vary(make: Make, transport: bool) -> None:
    keys = "of: value, by: wait, at_most: 0.8 s, before: 20 cm" + ", transport: true" * transport
    system = make(VARYING + f"delay: {{late: {{unit: cm, {keys}}}}}\n")
    columns = rolled(system)
    time, fine = np.arange(61) * 0.1, np.linspace(0, 6, 6001)
    for row, phase in enumerate(columns["phase"][:, 0]):
        wait = 0.5 + 0.3 * np.sin(phase + fine)
        if transport:  # the way passed so far; what leaves the pipe entered it one length before
            way = np.concatenate(([0.0], np.cumsum(0.0005 * (1 / wait[1:] + 1 / wait[:-1]))))
            at = np.interp(np.interp(time, fine, way) - 1, way, fine, left=np.nan)
        else:
            at = time - np.interp(time, fine, wait)
        known = at >= 0
        wanted = 100 * np.cos(2 * (phase + at))
        np.testing.assert_allclose(columns["late"][row, known], wanted[known], atol=0.6)
        np.testing.assert_array_equal(columns["late"][row, :2], 20)
    # within a step the value moves, so that the integral is that of the trapezoidal rule
    moved = np.diff(columns["x"]) / 0.1 * 100
    middle = (columns["late"][:, 13:] + columns["late"][:, 12:-1]) / 2
    np.testing.assert_allclose(moved[:, 12:], middle, atol=1.2 if transport else 3.5)
    assert [num.name for num in system.decl.policy.observe] == ["phase", "x", "late"]


def test_a_delay_that_varies_in_c_and_its_gradient(make: Make) -> None:
    keys = "of: value, by: wait, at_most: 0.8 s, transport: true"
    system = make(VARYING + f"delay: {{late: {{unit: cm, {keys}}}}}\n")
    task = Task.of(stlc.parse("state signal x [m]\nrequire r: always x < 1 m"), system)
    x0, u = task.sample(5, seed=1, dtype=torch.float64), torch.zeros(5, 60, 0, dtype=torch.float64)
    assert task.native is not None
    judged = task.judge(x0, u)
    _, columns = task._judged_by_torch(x0, u)
    for name in system.names:
        torch.testing.assert_close(judged.columns[name], columns[name], atol=1e-10, rtol=0)
    start = x0[:1].clone().requires_grad_()
    last = system.rollout(start, u[:1])[:, -1, 1].sum()
    (gradient,) = torch.autograd.grad(last, start)
    moved = x0[:1].clone()
    moved[:, 0] += 1e-6
    change = (system.rollout(moved, u[:1])[:, -1, 1].sum() - last) / 1e-6
    assert gradient[0, 0].item() == pytest.approx(change.item(), rel=1e-4)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("delay: {d: {of: x}}", "S102"),
        ("delay: {d: {unit: m, of: x, by: y / (1 m/s), transport: true}}", "S102"),
        ("delay: {d: {unit: m, of: x, by: y / (1 m/s)}}", "S103"),
        ("delay: {d: {unit: m, of: x, by: y, at_most: 1 s}}", "E203"),
        ("delay: {d: {unit: m, of: x, by: 0.2 s, at_most: 101 s}}", "S103"),
        ("delay: {d: {unit: m, of: x, by: 0.2 s, at_most: 1 s}}\nflow: {d: 1 m/s}", "S202"),
        ("delay: {d: {of: x, by: 0.25 s}}", "S103"),
        ("delay: {d: {of: x, by: 1001}}", "S103"),
        ("delay: {d: {unit: s, of: x, by: 1}}", "E203"),
        ("delay: {d: {of: prev(x), by: 1}}", "S201"),
        ("delay: {x: {of: y, by: 1}}", "E102"),
        ("delay: {d: {of: d, by: 2, before: 0}, e: {of: x, by: 1}}\nflow: {d: 1}", "S202"),
    ],
)
def test_wrong_delays(make: Make, text: str, code: str) -> None:
    with pytest.raises(StlcError) as error:
        make(PLANT + text + "\n")
    assert code in [finding.code for finding in error.value.diagnostics]
