"""The guard "certified": plans pass only if they are safe for every error until the next decision."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
import torch
from torch import Tensor

from stlc.assurance.certified_search import Certifier
from stlc.controller.guard.candidates import POLICY, Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.diagnostics import UsageError
from stlc.dynamics.load import parse_system
from stlc.dynamics.scenario import under
from stlc.dynamics.system import System
from stlc.dynamics.uncertainty.disturbance import Disturbance
from stlc.grammar.spec import Spec
from stlc.source import Source

SYSTEM = """\
stlc: 1
name: cart
time: {dt: 0.1 s, horizon: 10 steps}
state:
  p: {unit: m, range: [-5, 5]}
  v: {unit: m/s, range: [-3, 3]}
control: {a: {unit: m/s^2, range: [-4, 4]}}
flow: {p: v, v: a}
init: {mixture: [{name: all, draw: {p: "uniform(-2, 0)", v: "uniform(0, 1)"}}]}
test: {steps: 50, replan: 2}
scenario:
  gusts: {disturb: {v: "uniform(-1, 1) * (1 m/s^2)"}}
  storm: {disturb: {v: "uniform(-40, 40) * (1 m/s^2)"}}
"""
SPEC = """\
signal p [m]
signal v [m/s]
@safety
require wall: always[0, T] p < 1 m
"""


@cache
def task_of(scenario: str | None, spec: str = SPEC) -> Task:
    decl = parse_system(Source("cart.yaml", SYSTEM), Path("cart.yaml"), {})
    return Task.of(Spec.parse(Source("cart.stl", spec)), System(under(decl, scenario) if scenario else decl))


class Constant(Policy):
    """Policy whose only plan is one acceleration for all steps."""

    def __init__(self, task: Task, acceleration: float) -> None:
        super().__init__(task)
        self.acceleration = acceleration

    def candidates(self, x0: Tensor) -> Tensor:
        shape = len(x0), 1, self.task.horizon, 1
        return torch.full(shape, self.acceleration, dtype=x0.dtype)


def standing(position: float, count: int = 1) -> Tensor:
    """States of carts at rest."""
    return torch.tensor([[position, 0.0]], dtype=torch.float64).repeat(count, 1)


@pytest.mark.apart
def test_a_plan_that_only_just_stops_in_time_is_replaced_by_one_with_room() -> None:
    """Standing 1 cm before the wall is safe on the model; a gust would push the cart into it."""
    task = task_of("gusts")
    x, policy = standing(0.99), Constant(task, 0.0)
    full, certified = Guard(task, policy, "full"), Guard(task, policy, "certified")
    assert int(full.decide(x).source[0]) == POLICY
    decision = certified.decide(x)
    assert int(decision.source[0]) != POLICY
    assert bool(decision.safe[0])
    low = Certifier(task).guaranteed(x, torch.cat((policy.plan(x), decision.plan)).view(2, 10, 1)[1:])
    assert float(low[0]) >= -1e-6
    assert float(Certifier(task).guaranteed(x, policy.plan(x))[0]) < 0.0


def test_a_plan_with_room_passes() -> None:
    task = task_of("gusts")
    decision = Guard(task, Constant(task, 0.0), "certified").decide(standing(0.0, 3))
    assert decision.source.tolist() == [POLICY] * 3


def test_without_errors_the_guard_decides_as_the_full_one() -> None:
    task, policy = task_of(None), Constant(task_of(None), 0.5)
    x = torch.cat((standing(0.5), standing(0.99), standing(-1.0)))
    full, certified = (Guard(task, policy, mode).decide(x) for mode in ("full", "certified"))
    assert (certified.source > 0).tolist() == (full.source > 0).tolist()
    assert bool(certified.safe.all())


def test_the_safest_plan_is_taken_where_none_can_be_certified() -> None:
    """In a storm nothing is certain: the guard acts, and leaves as much room as it finds."""
    task = task_of("storm")
    decision = Guard(task, Constant(task, 0.0), "certified").decide(standing(0.9))
    assert bool(decision.safe[0])
    assert int(decision.source[0]) != POLICY
    low = Certifier(task).guaranteed(standing(0.9), torch.cat((decision.plan, torch.zeros(1, 10, 1)))[:1])
    assert -torch.inf < float(low[0]) < 0.0
    assert float(low[0]) > float(Certifier(task).guaranteed(standing(0.9), torch.zeros(1, 10, 1))[0])


def test_after_every_disturbance_the_rest_of_a_certified_plan_is_safe() -> None:
    """At every later step a plan is known that the guards on the model accept."""
    task = task_of("gusts")
    x = task.sample(200, seed=3, dtype=torch.float64)
    policy = Constant(task, 0.2)
    plans = policy.plan(x)
    certifier = Certifier(task)
    sure = certifier.guaranteed(x, plans) >= -1e-6
    assert 0 < int(sure.sum()) < 200
    x, plans = x[sure], plans[sure]
    disturbance = Disturbance(task.plain, [torch.Generator().manual_seed(1)], len(x))
    for step in range(task.horizon):
        x = disturbance.pushed(task.plain.truth.step(x, plans[:, step]), x, step + 1)
        assert bool((x[:, 0] < 1.0).all())
        rest = plans[:, step + 1 :]
        assert bool((task.plain.rollout(x, rest)[:, :, 0] < 1.0).all())


def test_margins_of_the_command_line_are_kept() -> None:
    task = task_of("gusts")
    guard = Guard(task, Constant(task, 0.0), "certified", limits=Limits(margin={"wall": 0.8}))
    decision = guard.decide(standing(0.5))
    assert int(decision.source[0]) != POLICY
    assert float(decision.rho[0]) >= 0.0


def test_a_specification_without_safety_requirements_is_refused() -> None:
    task = task_of("gusts", SPEC.replace("@safety\n", ""))
    with pytest.raises(UsageError, match="needs a requirement tagged `@safety`"):
        Guard(task, Constant(task, 0.0), "certified")
