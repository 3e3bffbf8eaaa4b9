"""Losses against Eq. 8 to 10 written out, and the engine's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers.mission_strategies import missions, nested, requirement
from hypothesis import given, reject, settings
from hypothesis import strategies as st

from stlc import native
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_resolved, resolve_for
from stlc.compile.semantics.switch import Hard, Tanh
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.training.objective import VIOLATION, Objective, guided_objective, loss, paper_objective
from stlc.diagnostics import SpecError
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source


def test_paper_loss_is_the_hinge_on_smooth_robustness_plus_gated_performance(car_task: Task) -> None:
    objective = paper_objective(car_task)
    assert (objective.margin, objective.smoothing) == (0.5, 500.0)
    x0 = car_task.sample(200, seed=4, dtype=torch.float64)
    u = torch.linspace(-10, 10, 200, dtype=torch.float64)[:, None, None].expand(-1, car_task.horizon, 1)
    outcome = loss(car_task, objective, x0, u)
    x = car_task.rollout(x0, u, Tanh())
    hinge = (0.5 - car_task.robustness(x, smoothing=500.0)).clamp(min=0)
    good = car_task.robustness(x) >= -1e-6
    v, tau, sign, position = (
        x[:, :, car_task.system.names.index(name)] for name in ("v", "tau", "sign", "x")
    )
    moving = 0.1 * (5 - v).clamp(min=0) * ((sign == 0) | (tau > 4))
    there = 0.1 * (-1 - position).clamp(min=0)
    stopping = (sign == 0) & (position >= -1) & (position <= 0) & (tau < 1)
    still = 0.2 * v.clamp(min=0) * stopping
    expected = hinge + good * (moving + there + still).mean(1)
    near_switch = (tau - 4).abs().min(1).values < 1e-2  # the soft indicator differs there by design
    assert torch.allclose(outcome[~near_switch], expected[~near_switch], atol=1e-6)


def test_the_engine_uses_exact_operators_and_saturates(car_task: Task) -> None:
    objective = guided_objective(0.1, slope=5.0, performance_weight=0.0)
    x0 = car_task.sample(300, seed=5, dtype=torch.float64)
    u = torch.zeros(300, car_task.horizon, 1, dtype=torch.float64)
    outcome = loss(car_task, objective, x0, u)
    rho = car_task.robustness(car_task.rollout(x0, u, Hard()))
    hinge = (0.1 - rho).clamp(min=0)
    violation = (-rho).clamp(min=0)
    assert 0 < (violation > 0).double().mean() < 1
    expected = 0.2 * torch.log1p(hinge / 0.2) + VIOLATION * 0.2 * torch.log1p(violation / 0.2)
    assert torch.allclose(outcome, expected, atol=1e-9)


def test_gradients_reach_every_control_that_matters(car_task: Task) -> None:
    for objective in (paper_objective(car_task), guided_objective(0.1, slope=5.0, performance_weight=0.3)):
        assert isinstance(objective, Objective)
        x0 = car_task.sample(400, seed=6)
        u = torch.zeros(400, car_task.horizon, 1, requires_grad=True)
        loss(car_task, objective, x0, u).mean().backward()
        assert u.grad is not None
        assert torch.isfinite(u.grad).all()
        assert (u.grad.abs().sum((1, 2)) > 0).double().mean() > 0.3


CART = """
stlc: 1
name: cart
time: {dt: 0.1 s, horizon: 20 steps}
state: {x: {unit: m, range: [-2, 2]}, v: {unit: m/s, range: [-2, 2]}}
control: {u: {unit: m/s^2, range: [-3, 3]}}
flow: {x: v, v: u}
init: {mixture: [{draw: {x: "uniform(-1.5, -0.5)", v: 0}}]}
"""
PAST = (
    "eventually[0, T] historically[0 s, 0.5 s] x > 0.1 m",
    "eventually[0, T] std.debounced(x > 0.1 m, 0.5 s)",
    "eventually[0, T] historically (x > 0.1 m)",
    "eventually[0, T] not (x < 0.1 m since[0, 0.5 s] v < 1 m/s)",
    "eventually[0, T] rise(x > 0.1 m)",
    "eventually[0, T] (x > 0.1 m and once[0, 1 s] v > 0.5 m/s)",
)


@pytest.mark.apart
@pytest.mark.parametrize("formula", PAST)
def test_plans_that_fail_a_formula_of_the_past_are_told_how_to_satisfy_it(
    formula: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native, "FLAGS", (*native.FLAGS, "-O0"))
    path = Path("cart.yaml")
    system = System(parse_system(Source(str(path), CART), path, {}))
    text = f"import std\nstate signal x [m]\nstate signal v [m/s]\nrequire r: {formula}"
    task = Task.of(Spec.parse(Source("cart.stl", text)), system)
    x0 = task.sample(64, seed=1)
    u = torch.full((64, 20, 1), 0.3, requires_grad=True)
    for objective in (paper_objective(task), guided_objective(0.1, slope=5.0, performance_weight=0.0)):
        outcome = loss(task, objective, x0, u)
        assert torch.isfinite(outcome).all()
        (slope,) = torch.autograd.grad(outcome.sum(), u)
        failing = ~TOLERANCE.satisfied(task.judge(x0, u.detach()).rho)
        assert failing.any()
        if "historically (" not in formula:  # what failed before the first step is beyond all plans
            assert (slope[failing].sum((1, 2)) < 0).all(), "to push harder helps"


PLANE = """
stlc: 1
name: plane
time: {dt: 0.1 s, horizon: 5 steps}
state: {x: {range: [-2, 3]}, y: {range: [-2, 3]}, z: {range: [-2, 3]}}
control: {u: {unit: s^-1, range: [-9, 9]}, w: {unit: s^-1, range: [-9, 9]}}
flow: {x: u, y: w, z: u - w}
init: {mixture: [{draw: {x: "uniform(-2, 3)", y: "uniform(-2, 3)", z: "uniform(-2, 3)"}}]}
"""


def compiled_for_plane(formulas: Sequence[typed.Formula]) -> Task:
    """The task of several requirements, for a plane whose signals move as its controls say."""
    path = Path("plane.yaml")
    system = System(parse_system(Source(str(path), PLANE), path, {}))
    text = "state signal x, y, z\nrequire r: always[0, T] x > -99"
    spec = resolve_for(Spec.parse(Source("plane.stl", text)), system.interface(), None, "train")
    rules = tuple(replace(requirement(formula), name=f"r{i}") for i, formula in enumerate(formulas))
    try:
        return Task(compile_resolved(replace(spec, requirements=rules), Grid(Fraction(1, 10), 5)), system)
    except SpecError as error:
        refused = {finding.code for finding in error.diagnostics}
        assert refused <= {"E306", "E307", "E309", "E310", "E312"}, refused
        reject()


@settings(max_examples=12)
@given(st.lists(missions | nested, min_size=1, max_size=2), st.integers(0, 2**32 - 1))
def test_losses_are_finite_whatever_clock_statuses_and_timers_say(
    formulas: list[typed.Formula], seed: int
) -> None:
    check_losses(formulas, seed, native=False)


@pytest.mark.slow
@settings(max_examples=500)
@given(st.lists(missions | nested, min_size=1, max_size=2), st.integers(0, 2**32 - 1))
def test_the_same_of_five_hundred_specifications_in_c_too(formulas: list[typed.Formula], seed: int) -> None:
    check_losses(formulas, seed, native=True)


def check_losses(formulas: list[typed.Formula], seed: int, *, native: bool) -> None:
    """Losses and their gradients are finite in states that missions reach, and in any others."""
    task = compiled_for_plane(formulas)
    if not native:
        vars(task).update(native=None, gradient=None)
    generator = torch.Generator().manual_seed(seed)
    rand = partial(torch.rand, generator=generator, dtype=torch.float64)
    x = task.sample(8, generator=generator, dtype=torch.float64)
    reached = [x]
    for _ in range(9):
        moved = task.rollout(x, 18 * rand(8, 5, 2) - 9)
        x = moved[:, int(rand(()) * 5) + 1]
        reached.append(x)
    x0 = torch.cat(reached)
    drawn = x0.clone()
    for timer in task.compiled.timers:
        low, high = timer.low, timer.high
        drawn[:, task.system.names.index(timer.name)] = (low + (high - low) * rand(len(drawn))).round()
    x0 = torch.cat((x0, drawn))
    u = 18 * rand(len(x0), 5, 2) - 9
    for objective in (paper_objective(task), guided_objective(0.1, slope=5.0, performance_weight=0.3)):
        u = u.detach().requires_grad_()
        value = loss(task, objective, x0, u)
        assert torch.isfinite(value).all()
        if value.requires_grad:
            (slope,) = torch.autograd.grad(value.sum(), u)
            assert torch.isfinite(slope).all()


@pytest.mark.apart
@pytest.mark.parametrize("native", [True, False])
def test_a_missed_deadline_drops_out_of_the_loss_and_leaves_the_other_requirements(native: bool) -> None:
    path = Path("plane.yaml")
    system = System(parse_system(Source(str(path), PLANE), path, {}))
    late = "require a: eventually@[0 s, 4 s] ((always[0 s, 0.2 s] x > 0.8) and x < 2)"
    near = "require b: always[0, T] y > 1"
    both, alone, lost = (
        Task.of(Spec.parse(Source("s.stl", f"state signal x, y, z\n{rules}")), system)
        for rules in (f"{late}\n{near}", near, late)
    )
    if not native:
        vars(both).update(native=None, gradient=None)
    x0 = both.sample(20, seed=0, dtype=torch.float64)
    x0[:, both.system.names.index("clock")] = 41.0  # open still, and no plan reaches back
    u = torch.full((20, 5, 2), -1.0, dtype=torch.float64, requires_grad=True)
    assert (both.judge(x0, u).requirements[:, 0] == -torch.inf).all()
    paper = replace(paper_objective(both), performance_weight=0.0)
    for objective in (paper, guided_objective(0.1, slope=5.0, performance_weight=0.0)):
        value = loss(both, objective, x0, u)
        assert torch.allclose(value, loss(alone, objective, x0[:, :3], u))
        assert value.mean() > 0.5
        assert torch.isfinite(torch.autograd.grad(value.sum(), u)[0]).all()
        assert (loss(lost, objective, x0, u) == 0.0).all(), "no plan is better than another"
