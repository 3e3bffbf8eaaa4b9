"""Input signals of a system file: as in the reference, in torch and C, and no policy sees them ahead."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import stlc
from stlc.controller.problem.task import Task
from stlc.diagnostics import StlcError
from stlc.dynamics.declaration.inputs import InputDecl
from stlc.dynamics.model.samplers import Rows
from stlc.dynamics.system import System

Make = Callable[..., System]
PLANT = (
    "time: {dt: 0.1 s, horizon: 30 steps, integrator: rk4, substeps: 2}\n"
    "state: {x: {unit: m}, y: {unit: m}}\n"
    "init: {mixture: [{draw: {x: 0, y: 0}}]}\n"
)
SIGNALS = PLANT + (
    "inputs:\n"
    "  step: {unit: m/s, range: [-1, 3], pieces: 4, duration: 2 s}\n"
    "  late: {unit: m/s, range: [-1, 3], pieces: 3, times: free}\n"
    "  ramp: {unit: m/s, range: [0, 1], pieces: 3, interpolate: linear, duration: 2.5 s, times: free}\n"
    "  bend: {unit: km/h, range: [0, 10], pieces: 4, interpolate: pchip, duration: 3 s}\n"
    "  load: {range: [1, 2]}\n"
    "flow: {x: step + late + ramp, y: bend / load}\n"
)


def nothing(system: System, rows: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """The only plan of a system without controls."""
    return torch.zeros(rows, system.horizon, 0, dtype=dtype)


def signals(system: System, x: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Recorded and reference values of the input signals in states (batch, steps, n)."""
    times = np.arange(x.shape[1]) * system.dt
    found = {}
    for decl in system.decl.inputs:
        numbers = x[:, 0, [system.names.index(name) for name in decl.columns]]
        found[decl.name] = x[:, :, system.names.index(decl.name)], decl.at(numbers, times)
    return found


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-13), (torch.float32, 2e-6)])
def test_rollouts_follow_the_reference(make: Make, dtype: torch.dtype, atol: float) -> None:
    system = make(SIGNALS)
    x0 = system.sample(32, seed=1, dtype=dtype)
    x = system.rollout(x0, nothing(system, 32, dtype))
    for recorded, wanted in signals(system, x.double().numpy()).values():
        np.testing.assert_allclose(recorded, wanted, atol=4 * atol)
    one = x0
    for _ in range(7):
        one = system.step(one, nothing(system, 32, dtype)[:, 0])
    torch.testing.assert_close(one, x[:, 7], atol=1e-4 if dtype == torch.float32 else 1e-12, rtol=0)


def test_held_signals_are_constant_within_a_step_and_linear_ones_are_not(make: Make) -> None:
    system = make(
        PLANT + "inputs: {a: {range: [0, 1], pieces: 3, duration: 3 s},"
        " b: {range: [0, 1], pieces: 3, duration: 3 s, interpolate: linear}}\nflow: {x: a, y: b}\n"
    )
    x = system.rollout(system.sample(8, seed=0, dtype=torch.float64), nothing(system, 8))
    a, b = (x[:, :, system.names.index(name)] for name in ("a", "b"))
    torch.testing.assert_close(x[:, 1:, 0], 0.1 * a[:, :-1].cumsum(1))
    torch.testing.assert_close(x[:, 1:, 1], 0.05 * (b[:, :-1] + b[:, 1:]).cumsum(1))


def test_c_agrees_with_torch_and_gradients_with_differences(make: Make) -> None:
    system = make(SIGNALS)
    task = Task.of(
        stlc.parse(
            "signal x [m]\nsignal bend [km/h]\nsignal load\n"
            "require r: always (x < 1 m and bend < 8 km/h and load < 1.9)"
        ),
        system,
    )
    x0 = task.sample(20, seed=2, dtype=torch.float64)
    assert task.native is not None
    judged = task.judge(x0, nothing(system, 20))
    each, columns = task._judged_by_torch(x0, nothing(system, 20))
    torch.testing.assert_close(judged.requirements, each, atol=1e-12, rtol=0)
    for name in system.names:
        torch.testing.assert_close(judged.columns[name], columns[name], atol=1e-12, rtol=0)
    start = x0[:4].clone().requires_grad_()

    def last(states: torch.Tensor) -> torch.Tensor:
        return task.system.rollout(states, nothing(system, 4))[:, -1, :2].sum()

    (gradient,) = torch.autograd.grad(last(start), start)
    for name in ("step_values[1]", "ramp_values[2]", "ramp_times[1]", "bend_values[1]"):
        at = system.names.index(name)
        moved = x0[:4].repeat(2, 1, 1)
        moved[0, :, at] += 1e-6
        moved[1, :, at] -= 1e-6
        slope = (last(moved[0]) - last(moved[1])) / 2e-6
        torch.testing.assert_close(gradient[:, at].sum(), slope, atol=1e-5, rtol=1e-5)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 5), st.booleans(), st.sampled_from(("hold", "linear", "pchip")), st.integers(0, 99))
def test_initial_states_draw_what_uniform_numbers_give(
    make: Make, pieces: int, free: bool, interpolate: str, seed: int
) -> None:
    times = "free" if free else "fixed"
    system = make(
        PLANT
        + f"inputs: {{u: {{range: [-2, 5], pieces: {pieces}, times: {times}, interpolate: {interpolate}}}}}\n"
    )
    (decl,) = system.decl.inputs
    x0 = system.sample(6, seed=seed, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    uniforms = torch.stack([Rows(6, generator).uniforms() for _ in decl.columns], 1)
    wanted = decl.drawn(uniforms.numpy())
    at = [system.names.index(name) for name in decl.columns]
    np.testing.assert_allclose(x0[:, at].numpy(), wanted, atol=1e-12)


def test_init_and_overrides_give_the_values(make: Make) -> None:
    text = PLANT.replace("{x: 0, y: 0}", '{x: 0, y: 0, u_values: "[1, 2, 3]"}')
    system = make(text + "inputs: {u: {range: [0, 10], pieces: 3}}\n")
    x0 = system.sample(2, seed=0, dtype=torch.float64)
    columns = [system.names.index(name) for name in ("u", *system.decl.inputs[0].columns)]
    assert x0[:, columns].tolist() == [[1.0, 1.0, 2.0, 3.0]] * 2
    changed = make(text + "inputs: {u: {range: [0, 10], pieces: 3}}\n", u_values="[7, 8, 9]")
    assert changed.sample(1, seed=0)[:, columns].tolist() == [[7.0, 7.0, 8.0, 9.0]]


def test_policies_do_not_observe_what_is_to_come(make: Make) -> None:
    system = make(PLANT + "inputs: {u: {range: [0, 1], pieces: 3, times: free}}\n")
    assert [num.name for num in system.decl.policy.observe] == ["x", "y", "u"]
    assert set(system.decl.hidden) == {*system.decl.inputs[0].columns, "step_count"}
    seen = make(PLANT + 'inputs: {u: {range: [0, 1], pieces: 3}}\npolicy: {observe: [x, "u_values[2]"]}\n')
    assert seen.observed_count == 2


def test_the_declaration(make: Make) -> None:
    system = make(PLANT + "inputs: {u: {unit: m, range: [0 cm, 20 cm], pieces: 3, interpolate: pchip}}\n")
    (decl,) = system.decl.inputs
    assert isinstance(decl, InputDecl)
    assert (decl.low, decl.high, decl.pieces, decl.duration, decl.free_times) == (0.0, 0.2, 3, 3, False)
    assert "u  [m]  [0, 0.2]  3 pieces, pchip, 3 s" in system.decl.describe()
    assert "u_values" not in system.decl.describe()


def test_an_input_signal_of_a_discrete_system(make: Make) -> None:
    text = PLANT.replace("integrator: rk4, substeps: 2", "discrete: true")
    system = make(
        text + "inputs: {u: {unit: m, range: [0, 1], pieces: 2, interpolate: linear}}\nflow: {x: x + u}\n"
    )
    x = system.rollout(system.sample(3, seed=0, dtype=torch.float64), nothing(system, 3))
    ((recorded, wanted),) = signals(system, x.numpy()).values()
    np.testing.assert_allclose(recorded, wanted, atol=1e-13)
    np.testing.assert_allclose(x[:, 1:, 0], np.cumsum(wanted[:, :-1], 1), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("inputs: {u: {pieces: 3}}", "S102"),
        ("inputs: {u: {range: [0, 1], pieces: 0}}", "S103"),
        ("inputs: {u: {range: [0, 1], pieces: 1000}}", "S103"),
        ("inputs: {u: {range: [0, 1], interpolate: cubic}}", "S103"),
        ("inputs: {u: {range: [1, 0]}}", "S204"),
        ("inputs: {x: {range: [0, 1]}}", "E102"),
        ("inputs: {u: {range: [0, 1], size: 2}}", "S101"),
        ("inputs: {u: {range: [0, 1], duration: -1 s}}", "S103"),
        ("inputs: {u: {range: [0, 1]}, u_values: {range: [0, 1]}}", "E102"),
        ("inputs: {step_count: {range: [0, 1], pieces: 2}}", "E102"),
        ("inputs: {u: {range: [0, 1]}}\ndef: {u: x}", "E102"),
        ("inputs: {u: {unit: m, range: [0 s, 1 s]}}", "E203"),
    ],
)
def test_wrong_declarations(make: Make, text: str, code: str) -> None:
    with pytest.raises(StlcError) as error:
        make(PLANT + text + "\n")
    assert code in [finding.code for finding in error.value.diagnostics]


def test_the_signal_itself_cannot_be_drawn(make: Make) -> None:
    text = PLANT.replace("y: 0}", "y: 0, u: 1}") + "inputs: {u: {range: [0, 1]}}\n"
    with pytest.raises(StlcError, match="follows from the other states") as error:
        make(text)
    assert error.value.diagnostics[0].help == ("draw `u_values`",)
    with pytest.raises(StlcError, match="follows from the other states"):
        make(PLANT + "inputs: {u: {range: [0, 1]}}\n", u="3")
