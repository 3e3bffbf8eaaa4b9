"""Losses against Eq. 8 to 10 written out, and the engine's own."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from stlc import native
from stlc.compile.semantics.switch import Hard, Tanh
from stlc.controller.problem.task import Task, satisfied
from stlc.controller.training.objective import VIOLATION, Objective, guided_objective, loss, paper_objective
from stlc.dynamics.declaration.load import parse_system
from stlc.dynamics.model.system import System
from stlc.grammar.parse.parser import parse
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


@pytest.mark.parametrize("formula", PAST)
def test_plans_that_fail_a_formula_of_the_past_are_told_how_to_satisfy_it(
    formula: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native, "FLAGS", (*native.FLAGS, "-O0"))
    path = Path("cart.yaml")
    system = System(parse_system(Source(str(path), CART), path, {}))
    text = f"import std\nstate signal x [m]\nstate signal v [m/s]\nrequire r: {formula}"
    task = Task.of(parse(Source("cart.stl", text)), system)
    x0 = task.sample(64, seed=1)
    u = torch.full((64, 20, 1), 0.3, requires_grad=True)
    for objective in (paper_objective(task), guided_objective(0.1, slope=5.0, performance_weight=0.0)):
        outcome = loss(task, objective, x0, u)
        assert torch.isfinite(outcome).all()
        (slope,) = torch.autograd.grad(outcome.sum(), u)
        failing = ~satisfied(task.judge(x0, u.detach()).rho)
        assert failing.any()
        if "historically (" not in formula:  # what failed before the first step is beyond all plans
            assert (slope[failing].sum((1, 2)) < 0).all(), "to push harder helps"
