"""Gauss-Newton steps with feedback and bounds, and descents of plans by them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import stlc
from stlc.controller.problem.native import NativeStep
from stlc.controller.problem.task import Task
from stlc.controller.search.descent import Descent
from stlc.controller.search.newton import GaussNewton, riccati, values_of
from stlc.controller.search.planner import PlanBudget, plan
from stlc.controller.search.schedules import GoalScheduler
from stlc.dynamics.system import System

ROOT = Path(__file__).parents[3]
UNSTABLE = """stlc: 1
name: unstable
time: {dt: 0.1 s, horizon: 6 s, integrator: rk4}
state:
  x: {unit: m, range: [-2, 2]}
control:
  u: {unit: m/s, range: [-3, 3]}
flow:
  x: 2 Hz * x + u
init:
  mixture:
    - draw: {x: "uniform(-0.5, 0.5)"}
"""


def unstable(folder: Path, requirement: str) -> Task:
    (folder / "unstable.yaml").write_text(UNSTABLE)
    text = f'spec s\nsystem "unstable.yaml"\nstate signal x [m]\nrequire goal: {requirement}\n'
    (folder / "s.stl").write_text(text)
    return Task.load(folder / "s.stl")


def circles(text: str) -> Task:
    head = "spec s\nstate signal x, y [m]\ndef at_a = (1 m)^2 - (x - 3 m)^2 - y^2 >= 0 m^2\n"
    loaded = System.load(ROOT / "examples/planning/circles_linear.yaml")
    return Task.of(stlc.parse(f"{head}require goal: {text}"), loaded, end="truncate")


def scheduler_of(task: Task) -> GoalScheduler:
    return GoalScheduler([rule.formula for rule in task.rules], task.system.names, task.horizon)


@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 2), st.integers(1, 6))
def test_the_recursion_solves_the_quadratic_problem(seed: int, n: int, m: int, steps: int) -> None:
    random = np.random.default_rng(seed)
    a, b = random.normal(size=(steps, 1, n, n)), random.normal(size=(steps, 1, n, m))
    root = random.normal(size=(steps + 1, 1, n, n))
    curve, pull = root @ root.swapaxes(2, 3), random.normal(size=(steps + 1, 1, n))
    own, push = 0.5 + random.random((steps, 1, m)), random.normal(size=(steps, 1, m))
    gains = riccati(a, b, curve, pull, own, push)
    effect = np.zeros((steps + 1, n, steps, m))  # of each control on each state
    for k in range(steps):
        effect[k + 1] = np.einsum("ij,jkl->ikl", a[k, 0], effect[k])
        effect[k + 1, :, k] = b[k, 0]
    flat = effect.reshape(steps + 1, n, -1)
    hessian = np.einsum("tia,tij,tjb->ab", flat, curve[:, 0], flat) + np.diag(own.reshape(-1))
    best = -np.linalg.solve(hessian, np.einsum("tia,ti->a", flat, pull[:, 0]) + push.reshape(-1))
    x, found = np.zeros(n), []
    for k in range(steps):
        found.append(gains[k, 0, :, n] + gains[k, 0, :, :n] @ x)
        x = a[k, 0] @ x + b[k, 0] @ found[-1]
    assert np.allclose(np.concatenate(found), best, rtol=1e-6, atol=1e-8)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 5), st.integers(1, 6))
def test_the_recursion_in_c_gives_the_same(seed: int, n: int, batch: int, steps: int) -> None:
    random, m = np.random.default_rng(seed), 2
    root = random.normal(size=(steps + 1, batch, n, n))
    problem = (
        random.normal(size=(steps, batch, n, n)),
        random.normal(size=(steps, batch, n, m)),
        root @ root.swapaxes(2, 3),
        random.normal(size=(steps + 1, batch, n)),
        0.5 + random.random((steps, batch, m)),
        random.normal(size=(steps, batch, m)),
    )
    native = NativeStep.of(System.load(ROOT / "examples/planning/circles_dubins.yaml"), rewarded=False)
    assert native is not None
    assert np.allclose(native.compiled.riccati(*problem), riccati(*problem), rtol=1e-7, atol=1e-9)


def test_steps_in_c_change_plans_as_those_of_arrays() -> None:
    task = circles("eventually[20 steps, 20 steps] at_a")
    scheduler, plans = (
        scheduler_of(task),
        torch.rand(5, task.horizon, 2, generator=torch.manual_seed(0)).double(),
    )
    newton = GaussNewton(task, scheduler.conditions, torch.ones(2, dtype=torch.float64))
    now = newton.begin(torch.zeros(2, dtype=torch.float64), plans)
    more = scheduler.nearest(now.distance), np.full(now.distance.shape[:2], 0.03), np.full(5, 0.01)
    assert newton._native is not None
    compiled = newton.step(now, *more)
    newton._native = None
    by_arrays = newton.step(now, *more)
    for name in ("shares", "states", "distance"):
        assert np.allclose(getattr(compiled, name), getattr(by_arrays, name), rtol=1e-8, atol=1e-10)
    assert np.abs(compiled.shares - np.repeat(now.shares, 3, 0)).max() > 0.01


def test_steps_reach_a_goal_and_places_lie_in_it() -> None:
    task = circles("eventually[20 steps, 20 steps] at_a")
    scheduler = scheduler_of(task)
    x0 = torch.zeros(2, dtype=torch.float64)
    newton = GaussNewton(task, scheduler.conditions, torch.full((2,), 5.0, dtype=torch.float64))
    places = newton.nearest(x0)
    assert places.violated.tolist() == [True]
    assert float(values_of(task, scheduler.conditions, places.states[None, :])[0, 0, 0]) > 0.0
    descent = Descent(scheduler, newton, x0, torch.zeros(1, 64, 2, dtype=torch.float64), places.margins)
    for _ in range(6):
        descent.step()
    assert float(task.judge(x0[None], descent.plans, states=False).rho) > 0.0


def test_margins_are_less_for_thin_conditions(tmp_path: Path) -> None:
    task = unstable(tmp_path, "always[1 s, 2 s] (abs(x) <= 0.001 and x <= 1)")
    newton = GaussNewton(task, scheduler_of(task).conditions, torch.tensor([1.0], dtype=torch.float64))
    thin, wide = newton.nearest(torch.tensor([0.3], dtype=torch.float64)).margins
    assert thin < 0.001 < 0.03 == wide


@pytest.mark.parametrize(
    "requirement",
    [
        "always[2 s, 6 s] abs(x) <= 0.05",
        pytest.param("always[2 s, 6 s] abs(x - 1) <= 0.01", marks=pytest.mark.apart),
    ],
)
def test_feedback_keeps_a_change_from_growing(tmp_path: Path, requirement: str) -> None:
    task = unstable(tmp_path, requirement)
    x0 = task.sample(4, seed=0, dtype=torch.float64)
    found = plan(task, x0, budget=PlanBudget(10.0))
    assert bool(found.satisfied.all())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rotors", "swingup", "ballbeam", "imager", "microgrid"])
def test_unstable_and_precise_tasks_have_plans(name: str) -> None:
    task = Task.load(ROOT / f"benchmarks/tasks/{name}/{name}.stl", whole=True)
    found = plan(task, task.sample(10, seed=0, dtype=torch.float64), budget=PlanBudget(5.0))
    assert int(found.satisfied.sum()) >= 9
