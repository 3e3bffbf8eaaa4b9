"""Tubes contain what is simulated under every error within the bounds of a scenario."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from stlc.assurance.verification.tubes import DEVIATIONS, TubeModel, tube
from stlc.compile.backends.torch.ops import TORCH
from stlc.controller.problem.task import Task
from stlc.diagnostics import UsageError
from stlc.dynamics.declaration.perturbable import perturbable
from stlc.dynamics.load import parse_system
from stlc.dynamics.model.samplers import Drawing
from stlc.dynamics.scenario import under
from stlc.dynamics.system import System
from stlc.dynamics.uncertainty.disturbance import Disturbance, ErrorSizes
from stlc.dynamics.uncertainty.perturbed import PerturbedSystem
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.source import Source

ROOT = Path(__file__).parents[3]

CART = """\
stlc: 1
name: cart
doc: A cart on a line, pushed and braked by friction.
time: {dt: 0.1 s, horizon: 12 steps, integrator: rk4, substeps: 1}
const: {k: 0.5, wall: 4 m}
state:
  p: {unit: m, range: [-5, 5]}
  v: {unit: m/s, range: [-3, 3], clamp: true}
control: {a: {unit: m/s^2, range: [-4, 4]}}
flow: {p: v, v: "a - k * v * abs(v) / (1 m) + 0.1 m/s^2 * sin(p / (1 m))"}
jump:
  - {name: bounce, guard: p > wall, reset: {v: "-0.5 * v"}}
init: {mixture: [{name: all, draw: {p: "uniform(-3, 3)", v: "uniform(-2, 2)"}}]}
test: {steps: 50}
scenario:
  all:
    disturb: {p: "uniform(-0.2 m/s, 0.1 m/s) * (1 + 0.1 * sin(t / (1 s)))", v: "normal(0, 0.2 m/s^2)"}
    noise: {p: "truncnorm(0, 1, -0.1, 0.1) * (1 m)"}
    model_mismatch: {k: 0.6}
    errors: {actuator_gain: 0.1, parameters: 0.1, actuator_noise: 0.05, sensor_noise: 0.01}
  choices:
    disturb: {v: "(choice(-0.3, 0.1, 0.5) + 0.2 * ind(bernoulli(0.5)) + 0.01 * randint(0, 2)) * (1 m/s^2)"}
  gusts: {disturb: {v: "if t > 1 s then 0.4 m/s^2 * sin(t / (1 s)) else 0"}}
  dependent: {noise: {p: "normal(0, 0.1) * p"}}
"""
SPEC = """\
signal p [m]
signal v [m/s]
@safety
require left_of_the_wall: always[0, T] p < 3.5 m
@safety
require slow: always[0, T] (p > 1 m -> p * abs(v) < 6 m^2/s)
require turns: eventually[0, 1 s] (v < 0 and always[0, 0.2 s] p > -4 m)
"""


@cache
def cart(scenario: str | None) -> Task:
    decl = parse_system(Source("cart.yaml", CART), Path("cart.yaml"), {})
    return Task.of(Spec.parse(Source("cart.stl", SPEC)), System(under(decl, scenario) if scenario else decl))


@cache
def task_of(spec: str, system: str, scenario: str) -> Task:
    files = ROOT / "specs" / f"{spec}.stl", ROOT / "examples" / f"{system}.yaml"
    return Task.of(Spec.parse(File(files[0]).read()), System.load(files[1], scenario=scenario))


class Sampled:
    """Simulation with random errors within the bounds, about half of them at the ends."""

    def __init__(self, task: Task, rows: int, generator: torch.Generator) -> None:
        self.task, self.rows, self.generator = task, rows, generator
        self.sizes = ErrorSizes.of(task.plain)
        scenario = task.plain.decl.scenario
        self.pushes = [Drawing(each) for each in scenario.disturb] if scenario else []
        self.noises = [Drawing(each) for each in scenario.noise] if scenario else []
        self.gain = 1.0 + self.share(len(self.sizes.gain)) * self.sizes.gain
        self.offset = self.share(len(self.sizes.gain)) * self.sizes.offset
        truth = task.plain.truth
        if self.sizes.parameters:
            loose = perturbable(truth.decl)
            truth = PerturbedSystem(loose, 1.0 + self.sizes.parameters * self.share(len(loose.numbers)))
        self.truth = truth

    def share(self, count: int) -> Tensor:
        """Numbers from -1 to 1, (rows, count)."""
        inner = 2.0 * torch.rand(self.rows, count, generator=self.generator, dtype=torch.float64) - 1.0
        ends = torch.where(inner > 0, 1.0, -1.0).double()
        return torch.where(torch.rand(inner.shape, generator=self.generator) < 0.5, inner, ends)

    def draw(self, sampler: str, args: list[Any]) -> Any:
        share = self.share(1)[:, 0]
        match sampler, args:
            case ("uniform", [low, high]) | ("truncnorm", [_, _, low, high]):
                return low + (high - low) * 0.5 * (1.0 + share)
            case "randint", [low, high]:
                return torch.round(low + (high - low) * 0.5 * (1.0 + share))
            case "normal", [mean, deviation]:
                return mean + DEVIATIONS * deviation * share
            case "bernoulli", _:
                return (share > 0).double()
        which = torch.randint(len(args), (self.rows,), generator=self.generator)
        return torch.stack([each.expand(self.rows) for each in args]).gather(0, which[None])[0]

    def drawn(self, drawings: list[Drawing], x: Tensor, time: float) -> dict[str, Tensor]:
        env = dict(zip(self.task.plain.names, x.unbind(1), strict=False))
        env["t"] = torch.full((self.rows,), time, dtype=torch.float64)
        return {each.name: each.value(env, TORCH, self.draw).expand(self.rows) for each in drawings}

    def start(self, seen: Tensor) -> Tensor:
        """True states for measured states."""
        count, names = len(self.sizes.blur), self.task.plain.names
        x = seen.clone()
        x[:, :count] -= DEVIATIONS * self.sizes.blur * self.share(count)
        for name, off in self.drawn(self.noises, seen, self.time).items():
            x[:, names.index(name)] -= off
        return x

    def follow(self, seen: Tensor, plans: Tensor, steps: int) -> Tensor:
        """States under plans, (B, T+1, n); the first `steps` steps have errors."""
        decl, count = self.task.plain.decl, len(self.task.plain.names)
        self.time = float(torch.rand(1, generator=self.generator)) * decl.test.steps * self.task.plain.dt
        scale = 1.0 if decl.discrete else self.task.plain.dt
        x = self.start(seen) if steps else seen
        states = [x]
        for step in range(plans.shape[1]):
            known = x[:, :count]
            if step < steps:
                acted = self.task.system.commanded(x, plans[:, step]) * self.gain + self.offset
                acted = acted + DEVIATIONS * self.sizes.push * self.share(len(self.sizes.push))
                moved = self.truth.step(known, self.task.system.planned(x, acted)).clone()
                pushes = self.drawn(self.pushes, known, self.time + step * self.task.plain.dt)
                for name, value in pushes.items():
                    column = self.task.plain.names.index(name)
                    moved[:, column] += scale * value
                    if name in decl.clamps:
                        moved[:, column] = moved[:, column].clamp(*decl.clamps[name])
            else:
                moved = self.task.plain.step(known, plans[:, step])
            x = torch.cat((moved, self.task.system.added_later(x)), 1)
            states.append(x)
        return torch.stack(states, 1)


def plans_of(task: Task, count: int, generator: torch.Generator) -> Tensor:
    """Plans of three constant pieces."""
    low, high = task.system.control_low.double(), task.system.control_high.double()
    pieces = low + (high - low) * torch.rand(count, 3, len(low), generator=generator, dtype=torch.float64)
    return pieces.repeat_interleave(-(-task.horizon // 3), 1)[:, : task.horizon]


def planned(task: Task, count: int) -> tuple[Tensor, Tensor]:
    """States and plans."""
    x = task.sample(count, seed=2, dtype=torch.float64)
    return x, plans_of(task, count, torch.Generator().manual_seed(2))


def check(task: Task, samples: int, *, steps: int | None = None, seed: int = 0, plans: int = 20) -> None:
    """Compare tubes of random plans with simulations under random errors."""
    generator = torch.Generator().manual_seed(seed)
    x = task.sample(plans, seed=seed, dtype=torch.float64)
    u = plans_of(task, plans, generator)
    found = TubeModel(task).tube(x, u, steps=steps)
    assert bool((found.low <= found.high).all())
    each = -(-samples // plans)
    seen, followed = x.repeat_interleave(each, 0), u.repeat_interleave(each, 0)
    sampled = Sampled(task, len(seen), generator)
    states = sampled.follow(seen, followed, task.horizon if steps is None else steps)
    for index, name in enumerate(task.system.names):
        box, values = found.states[name], states[:, :, index].T.numpy()
        low, high = np.repeat(box.low, each, 1), np.repeat(box.high, each, 1)
        assert ((low <= values) & (values <= high)).all(), name
    rho = task.requirement_robustness(states)
    assert bool((found.low.repeat_interleave(each, 0) <= rho + 1e-9).all())
    assert bool((rho <= found.high.repeat_interleave(each, 0) + 1e-9).all())


@pytest.mark.apart
@pytest.mark.parametrize("scenario", ["all", "choices", "gusts", "mismatch-20", "disturb", "noise"])
def test_simulations_stay_within_the_tube(scenario: str) -> None:
    check(cart(scenario), 400)


@pytest.mark.parametrize("steps", [0, 1, 4])
def test_after_the_steps_with_errors_the_model_is_followed(steps: int) -> None:
    check(cart("all"), 400, steps=steps, seed=3)


@pytest.mark.apart
def test_inner_feedback_is_part_of_the_tube() -> None:
    files = (ROOT / "examples" / "tasks" / f"cart_pole.{end}" for end in ("stl", "yaml"))
    spec, system = next(files), System.load(next(files), scenario="mismatch-5")
    task = Task.of(Spec.parse(File(spec).read()), system)
    assert task.plain.decl.feedback is not None
    check(task, 40, steps=3, plans=4)


BENCHMARKS = [
    ("ship_safe", "ship_safe", "mismatch-10"),
    ("traffic", "car", "mismatch-20"),
    ("reach_n_avoid", "maze", "disturb"),
    ("navigation", "rover", "mismatch-10"),
    ("ship_track", "ship_track", "noise"),
    ("manipulation", "panda", "disturb"),
]


@pytest.mark.parametrize(("spec", "system", "scenario"), BENCHMARKS[:4])
def test_tubes_of_the_benchmarks(spec: str, system: str, scenario: str) -> None:
    check(task_of(spec, system, scenario), 100, plans=5)


@pytest.mark.bench
@pytest.mark.parametrize(("spec", "system", "scenario"), BENCHMARKS)
@pytest.mark.parametrize("steps", [None, 2])
def test_ten_thousand_samples_stay_within_the_tube(
    spec: str, system: str, scenario: str, steps: int | None
) -> None:
    check(task_of(spec, system, scenario), 10_000, steps=steps, plans=100)


@pytest.mark.bench
@pytest.mark.parametrize("scenario", ["all", "choices", "gusts"])
@pytest.mark.parametrize("steps", [None, 3])
def test_ten_thousand_samples_of_all_errors(scenario: str, steps: int | None) -> None:
    check(cart(scenario), 10_000, steps=steps, plans=100)


def test_without_errors_the_tube_is_the_prediction() -> None:
    task = cart(None)
    model = TubeModel(task)
    assert model.exact
    assert not TubeModel(cart("gusts")).exact
    x, plans = planned(task, 30)
    found, rho = model.tube(x, plans), task.requirement_robustness(task.system.rollout(x, plans))
    torch.testing.assert_close(found.low, rho, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(found.high, rho, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(model.safe(x, plans), rho[:, :2].amin(1), atol=1e-6, rtol=1e-6)


def test_larger_errors_give_wider_tubes() -> None:
    """The bounds on robustness are nested, and the nominal robustness is within them."""
    widths = []
    for scenario in ("mismatch-5", "mismatch-10", "mismatch-20"):
        task = cart(scenario)
        x, plans = planned(task, 50)
        found = tube(task, x, plans)
        rho = task.requirement_robustness(task.system.rollout(x, plans))
        assert bool(((found.low <= rho + 1e-9) & (rho <= found.high + 1e-9)).all())
        widths.append((found.high - found.low).mean())
    assert 0.0 < widths[0] < widths[1] < widths[2]


def test_many_plans_are_bounded_as_few_are() -> None:
    task = cart("all")
    x, plans = planned(task, 300)
    whole, part = tube(task, x, plans), tube(task, x[290:], plans[290:])
    torch.testing.assert_close(whole.low[290:], part.low, atol=1e-12, rtol=0)
    np.testing.assert_allclose(whole.states["p"].high[:, 290:], part.states["p"].high, atol=1e-12)


def test_a_single_plan_needs_no_batch_and_one_that_is_not_finite_has_no_bounds() -> None:
    task = cart("all")
    x, plan = task.sample(1, seed=5, dtype=torch.float64)[0], torch.zeros(task.horizon, 1)
    assert tube(task, x, plan).low.shape == (1, 3)
    plan[3] = torch.nan
    found = tube(task, x, plan)
    assert bool((found.low == -torch.inf).all() & (found.high == torch.inf).all())


def test_wrong_shapes_are_refused() -> None:
    task = cart("all")
    with pytest.raises(UsageError, match="are not"):
        tube(task, torch.zeros(2, 2), torch.zeros(3, task.horizon, 1))


def test_noise_that_depends_on_the_state_is_refused() -> None:
    with pytest.raises(UsageError, match=r"measurement noise on `p` depends on `p`"):
        TubeModel(cart("dependent"))


def test_errors_are_those_of_a_deployment() -> None:
    """The sizes that a tube uses are those that `Disturbance` applies."""
    task = cart("all")
    generators = [torch.Generator().manual_seed(0)]
    deployed, sizes = Disturbance(task.plain, generators, 5), ErrorSizes.of(task.plain)
    off = (deployed.acted(torch.ones(5, 1, dtype=torch.float64)) - 1.0).abs()
    assert bool((off <= sizes.gain + 5.0 * sizes.push).all())
