"""Flow, jumps, clamps, integrators, timers; a rollout is its steps, forwards and backwards."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.augment.timers import Timer, clock_of
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.switch import Hard, StraightThrough, Switch, Tanh
from stlc.dynamics.model.rollout import Stepper
from stlc.dynamics.model.step import build_step
from stlc.dynamics.system import System

Make = Callable[..., System]
SWITCHES = [Hard(), Tanh(20.0), StraightThrough(5.0)]

OSCILLATOR = """\
time: {{dt: {dt} s, horizon: 10 steps, integrator: {integrator}, substeps: {substeps}}}
state: {{p: {{}}, q: {{}}}}
control: {{u: {{range: [-1, 1]}}}}
flow: {{p: q, q: -p + u}}
init: {{mixture: [{{draw: {{p: 1, q: 0}}}}]}}
"""

RICH = """\
time: {{dt: 0.1 s, horizon: 8 steps, integrator: {integrator}, substeps: {substeps}}}
const: {{top: 2 m}}
state:
  x: {{unit: m, range: [-3, 3], clamp: true}}
  v: {{unit: m/s}}
  heat: {{}}
  odometer: {{unit: m}}
  mode: {{enum: {{eco: 0, sport: 1}}}}
  limit: {{unit: m/s, role: env}}
control:
  a: {{unit: m/s^2, range: [-4, 4]}}
  b: {{range: [0, 1]}}
def:
  fast: v > limit
flow:
  x: v * cos(heat)
  v: a - 0.3 * v * abs(v) / 1 m
  heat: ind(fast) - 0.5 * heat * b
  odometer: abs(v)
jump:
  - {{name: bounce, guard: x > top and v > 0, reset: {{v: -0.5 * v}}, sharpness: 50}}
  - {{name: shift, guard: heat > 0.3, reset: {{mode: sport, heat: heat / 2}}}}
  - {{name: rest, guard: mode == sport and heat < 0.2, reset: {{mode: eco}}, sharpness: 30}}
init:
  mixture: [{{draw: {{x: "uniform(-2, 2)", v: "uniform(-2, 2)", heat: "uniform(0, 0.5)", odometer: 0,
    mode: "choice(eco, sport)", limit: "uniform(0, 1)"}}}}]
"""


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("heun", 2), ("rk4", 4), ("ros2", 2)])
def test_integrators_have_their_order(make: Make, integrator: str, order: int) -> None:
    def error(steps: int) -> float:
        system = make(OSCILLATOR.format(dt=f"{1 / steps}", integrator=integrator, substeps=1))
        x = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
        end = system.rollout(x, torch.zeros(1, steps, 1, dtype=torch.float64))[0, -1]
        return float(torch.hypot(end[0] - math.cos(1.0), end[1] + math.sin(1.0)))

    assert math.log2(error(16) / error(32)) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("integrator", ["euler", "heun", "rk4", "ros2"])
def test_substeps_are_smaller_steps_with_the_same_control(make: Make, integrator: str) -> None:
    coarse = make(OSCILLATOR.format(dt="0.2", integrator=integrator, substeps=4))
    fine = make(OSCILLATOR.format(dt="0.05", integrator=integrator, substeps=1))
    x = torch.randn(50, 2, dtype=torch.float64)
    u = torch.rand(50, 1, dtype=torch.float64)
    want = x
    for _ in range(4):
        want = fine.step(want, u)
    assert torch.allclose(coarse.step(x, u), want, atol=1e-13)


@pytest.mark.parametrize("switch", SWITCHES)
@pytest.mark.parametrize(("integrator", "substeps"), [("euler", 1), ("euler", 3), ("heun", 2), ("rk4", 1)])
def test_a_rollout_is_its_steps(make: Make, integrator: str, substeps: int, switch: Switch) -> None:
    _is_its_steps(make(RICH.format(integrator=integrator, substeps=substeps)), switch)


@pytest.mark.parametrize("switch", SWITCHES)
def test_conditions_that_are_known_before_the_loop_have_the_slope_of_a_step(
    make: Make, switch: Switch
) -> None:
    system = make("""\
time: {dt: 0.1 s, horizon: 8 steps}
state: {x: {}, y: {}, z: {}}
control: {u: {range: [-1, 1]}, v: {range: [-1, 1]}}
flow:
  x: if u > 0 then 0 else -x * y * v
  y: if u * u > 0.2 or v < 0.1 then y * cos(x) else y / 2
  z: if v > 0 then u else z
init: {mixture: [{draw: {x: "uniform(-1, 1)", y: "uniform(-1, 1)", z: "uniform(-1, 1)"}}]}
""")
    _is_its_steps(system, switch)


def _is_its_steps(system: System, switch: Switch) -> None:
    """The states of a rollout, and their gradients, are those of its steps one by one."""
    x0 = system.sample(200, seed=0, dtype=torch.float64).requires_grad_()
    u = torch.rand(200, 8, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 6 - 3
    u.requires_grad_()
    scheduled = system.rollout(x0, u, switch)
    states = [x0]
    for t in range(8):
        states.append(system.step(states[-1], u[:, t], switch))
    stepped = torch.stack(states, 1)
    assert (scheduled - stepped).abs().max() < 1e-10
    start = dict(zip(system.names, x0.detach().numpy().T[:, None], strict=True))
    inputs = dict(zip(system.control_names, u.detach().numpy().transpose(2, 1, 0), strict=True))
    stepper = Stepper(build_step(system.decl, soft=not switch.exact))
    by_numpy = stepper.rollout(start, inputs, 8, NUMPY, switch)
    for name, column in zip(system.names, scheduled.detach().numpy().T, strict=True):
        np.testing.assert_allclose(by_numpy[name], column, rtol=1e-9, atol=1e-9)
    weights = torch.randn(stepped.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    for ours, theirs in zip(
        torch.autograd.grad((scheduled * weights).sum(), [x0, u]),
        torch.autograd.grad((stepped * weights).sum(), [x0, u]),
        strict=True,
    ):
        assert (ours - theirs).abs().max() < 1e-8 * (1 + theirs.abs().max())


def test_guards_and_resets_read_the_start_of_the_step(make: Make) -> None:
    system = make("""\
time: {dt: 1 s, horizon: 3 steps}
state: {x: {}, y: {}, n: {}}
control: {u: {range: [-1, 1]}}
flow: {x: 1, y: 10 * u, n: 0}
jump:
  - {guard: x >= 1, reset: {y: x, n: n + 1}}
init: {mixture: [{draw: {x: 0, y: 0, n: 0}}]}
""")
    x = system.rollout(torch.zeros(1, 3), torch.ones(1, 3, 1))[0]
    assert x.tolist() == [[0, 0, 0], [1, 10, 0], [2, 1, 1], [3, 2, 2]]


def test_of_two_jumps_the_later_wins_component_by_component(make: Make) -> None:
    system = make("""\
time: {dt: 1 s, horizon: 3 steps}
state: {x: {}, y: {}, z: {}}
control: {u: {range: [-1, 1]}}
flow: {x: 1, y: 1, z: 1}
jump:
  - {guard: x > 0, reset: {x: 10, y: 20}}
  - {guard: x > 1, reset: {x: 30}}
init: {mixture: [{draw: {x: 0, y: 0, z: 0}}]}
""")
    start = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [2.0, 0, 0]])
    moved = system.step(start, torch.zeros(3, 1))
    assert moved.tolist() == [[1, 1, 1], [10, 20, 1], [30, 20, 1]]


def test_clamps_act_after_each_substep_and_on_resets(make: Make) -> None:
    system = make("""\
time: {dt: 1 s, horizon: 3 steps, substeps: 2}
state: {x: {range: [0, 1], clamp: true}, y: {}}
control: {u: {range: [-9, 9]}}
flow: {x: u, y: x}
jump: [{guard: y > 100, reset: {x: 7}}]
init: {mixture: [{draw: {x: 0, y: 0}}]}
""")
    moved = system.step(torch.tensor([[0.0, 0.0], [0.5, 200.0]]), torch.tensor([[9.0], [0.0]]))
    assert moved.tolist() == [[1.0, 0.5], [1.0, 200.5]]  # y saw x = 0, then x = 1, not 4.5


def test_discrete_time_takes_next_values(make: Make) -> None:
    system = make("""\
time: {dt: 0.5 s, horizon: 4 steps, discrete: true}
state: {x: {unit: m}, y: {unit: m}}
control: {u: {unit: m, range: [-1, 1]}}
flow: {x: y, y: x + u}
init: {mixture: [{draw: {x: 1, y: 2}}]}
""")
    x = system.rollout(torch.tensor([[1.0, 2.0]]), torch.full((1, 4, 1), 0.5))[0]
    assert x.tolist() == [[1, 2], [2, 1.5], [1.5, 2.5], [2.5, 2.0], [2.0, 3.0]]


def test_units_of_columns_are_converted_at_every_door(make: Make) -> None:
    system = make("""\
time: {dt: 1 s, horizon: 3 steps}
const: {kick: 0.5 rad}
state: {psi: {unit: deg, range: [-180, 180]}, way: {unit: km}}
control: {r: {unit: deg/s, range: [-90, 90]}}
flow: {psi: r, way: 250 m/s * ind(psi > 30)}
jump: [{guard: psi > 90 deg, reset: {psi: kick, way: 3}}]
init: {mixture: [{draw: {psi: 45, way: 2 km}}]}
""")
    assert system.sample(2, seed=0).tolist() == [[45, 2], [45, 2]]
    moved = system.step(torch.tensor([[45.0, 2.0], [20.0, 2.0], [100.0, 2.0]]), torch.full((3, 1), 10.0))
    assert torch.allclose(moved, torch.tensor([[55.0, 2.25], [30.0, 2.0], [math.degrees(0.5), 3.0]]))


def test_timers_are_one_flow_and_one_jump(make: Make) -> None:
    system = make("""\
time: {dt: 0.5 s, horizon: 6 steps}
state:
  x: {}
  held: {unit: s, timer: up, run: x > 0, reset_when: x < -1}
  left: {unit: s, timer: down, run: x > 0, reset_when: x < -1, to: 4 s}
control: {u: {range: [-9, 9]}}
flow: {x: u}
init: {mixture: [{draw: {x: 1, held: 0, left: 4}}]}
""")
    u = torch.tensor([[[0.0], [-4.0], [-4.0], [0.0], [8.0], [0.0]]])
    x = system.rollout(torch.tensor([[1.0, 0.0, 4.0]]), u)[0]
    assert x[:, 0].tolist() == [1, 1, -1, -3, -3, 1, 1]
    assert x[:, 1].tolist() == [0, 0.5, 1.0, 1.0, 0.0, 0.0, 0.5]
    assert x[:, 2].tolist() == [4, 3.5, 3.0, 3.0, 4.0, 4.0, 3.5]


def test_clocks_are_appended_and_count_whole_steps(car: System) -> None:
    system = car.augmented((clock_of("clock", 15),))
    assert system.names == (*car.names, "clock")
    assert system.observed_count == 8
    x0 = system.sample(4000, seed=3)
    assert torch.equal(x0[:, :7], car.sample(4000, seed=3))
    assert set(x0[:, 7].tolist()) == {0.0}
    clock = system.rollout_columns(x0, torch.zeros(4000, 25, 1))["clock"]
    want = torch.arange(26.0).clamp(max=15.0)[:, None].expand(26, 4000)
    assert torch.equal(clock, want)
    assert torch.equal(system.step(x0, torch.zeros(4000, 1))[:, 7], want[1])


def test_timers_follow_from_the_states_before(car: System) -> None:
    """A rollout is its steps, `added_later` is what a step does, and no gradient goes through a timer."""
    moving = ir.Where(
        ir.Predicate(ir.Op("sub", (ir.Signal("v"), ir.Const(2.0)))), ir.Const(1.0), ir.Signal("fast")
    )
    fast = Timer("fast", "latch", 0.0, moving, 0.0, 1.0)
    system = car.augmented((clock_of("clock", 40), fast))
    x0 = system.sample(64, seed=5, dtype=torch.float64)
    u = torch.randn(64, 25, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 8
    u.requires_grad_()
    x = system.rollout(x0, u)
    state = x0
    for k in range(25):
        assert torch.equal(system.added_later(state), x[:, k + 1, 7:])
        state = system.step(state, u[:, k])
        torch.testing.assert_close(state, x[:, k + 1])
    ever = (x[:, :-1, 1] >= 2.0).cumsum(1) > 0
    assert torch.equal(x[:, 1:, 8] > 0.5, ever)
    assert 0 < int(ever[:, -1].sum()) < 64
    assert x[..., :7].requires_grad
    (grad,) = torch.autograd.grad(x.sum(), u)
    (bare,) = torch.autograd.grad(car.rollout(x0[:, :7], u).sum(), u)
    torch.testing.assert_close(grad, bare)
    assert car.added_later(x0[:, :7]).shape == (64, 0)


def test_plans_of_the_wrong_shape_are_refused(car: System) -> None:
    with pytest.raises(ValueError, match=r"u \(B, T, 1\)"):
        car.rollout(car.sample(3, seed=0), torch.zeros(3, 25, 2))
    with pytest.raises(ValueError, match="x0"):
        car.rollout(torch.zeros(3, 6), torch.zeros(3, 25, 1))


@settings(max_examples=15)
@given(st.lists(st.sampled_from("abcd"), min_size=1, max_size=4, unique=True), st.data())
def test_any_net_of_dependencies_is_scheduled_right(
    make: Make, names: list[str], data: st.DataObject
) -> None:
    terms = [*names, "u", "0.5", "2"]
    flows = {
        name: " + ".join(data.draw(st.lists(st.sampled_from(terms), min_size=1, max_size=3)))
        for name in names
    }
    reset = data.draw(st.sampled_from(names))
    guard = data.draw(st.sampled_from([*names, "u"]))
    value = data.draw(st.sampled_from([*names, "1"]))
    system = make(
        "time: {dt: 0.1 s, horizon: 5 steps}\n"
        f"state: {{{', '.join(f'{name}: {{}}' for name in names)}}}\n"
        "control: {u: {range: [-1, 1]}}\n"
        f"flow: {{{', '.join(f'{name}: {flow}' for name, flow in flows.items())}}}\n"
        f"jump: [{{guard: {guard} > 0.3, reset: {{{reset}: {value}}}}}]\n"
        f"init: {{mixture: [{{draw: {{{', '.join(f'{name}: 0' for name in names)}}}}}]}}\n"
    )
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(20, len(names), generator=generator, dtype=torch.float64) - 0.5
    u = torch.rand(20, 5, 1, generator=generator, dtype=torch.float64) * 2 - 1
    got = system.rollout(x, u)
    for t in range(5):
        env = {name: x[:, i] for i, name in enumerate(names)} | {"u": u[:, t, 0]}
        moved = {
            name: env[name]
            + 0.1
            * sum(env.get(term, float(term) if term[0].isdigit() else 0.0) for term in flow.split(" + "))
            for name, flow in flows.items()
        }
        target = env[value] if value in env else torch.ones(20, dtype=torch.float64)
        moved[reset] = torch.where(env[guard] > 0.3, target, moved[reset])
        x = torch.stack([moved[name] for name in names], 1)
        assert torch.allclose(got[:, t + 1], x, atol=1e-12)
