"""Promises of a mission: how far plans get in, and which plans are gone on with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from stlc.compile.backends.torch.ops import TORCH
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.pending_goals import PendingGoals
from stlc.controller.problem.task import GOALS, Task
from stlc.dynamics.model.cost import PlanCost
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

LINE = """
stlc: 1
name: line
time: {dt: 0.1 s, horizon: 8 steps}
state: {x: {unit: m, range: [-4, 4]}}
control: {u: {unit: m/s, range: [-5, 5]}}
flow: {x: u}
init: {mixture: [{draw: {x: "uniform(-1, 1)"}}]}
objective: {gamma: 0.3, terms: [{name: home, weight: 0.1, expr: relu(x)}]}
policy: {hidden: [16]}
"""
SPEC = """
spec line
state signal x [m]
require there: eventually@[0.2 s, 2 s] x > 2 m
require stays: always@[1 s, 2 s] x < 4 m
require either: eventually@[0 s, 1 s] x > 3 m or eventually@[0 s, 1 s] x < -3 m
"""


@pytest.fixture
def task(tmp_path: Path) -> Task:
    path = tmp_path / "line.yaml"
    path.write_text(LINE)
    return Task.of(Spec.parse(Source("line.stl", SPEC)), System.load(path))


def columns(task: Task, x: list[float], clock: int = 0, there: float = 0.0) -> dict[str, Tensor]:
    """Columns of one path, one step of the mission a sample."""
    found = {name: torch.zeros(len(x), 1) for name in task.system.names}
    found["x"] = torch.tensor(x)[:, None].requires_grad_()
    found["clock"] = clock + torch.arange(len(x), dtype=torch.float32)[:, None]
    found["there"] = torch.full((len(x), 1), there)
    return found


def lack_of(task: Task, found: dict[str, Tensor]) -> Tensor:
    """Margin that a path lacks at the goals, (1,)."""
    cost = task.pending_goals.added_to(PlanCost((), task.system.dt), 1.0)
    nothing = torch.zeros(1, 1)
    return cost(found, {}, nothing, nothing, TORCH)[0]


def test_only_requirements_that_are_one_promise_are_told(task: Task) -> None:
    (promise,) = task.pending_goals.items
    assert (promise.status, promise.first, promise.last) == ("there", 2.0, 20.0)


@pytest.mark.parametrize(
    ("path", "lack"),
    [
        ([0.0, 1.0, 2.1], 0.2),
        ([0.0, 1.0, 2.5], 0.0),
        ([0.0, 1.0, 1.5], 0.3),
        ([9.0, 9.0, 2.1], 0.2),  # nothing counts before 0.2 s
    ],
)
def test_an_open_promise_lacks_what_the_deepest_sample_lacks(
    task: Task, path: list[float], lack: float
) -> None:
    short = lack_of(task, columns(task, path))
    assert short.item() == pytest.approx(lack, abs=1e-6)


def test_what_is_kept_or_over_lacks_nothing_or_all(task: Task) -> None:
    assert lack_of(task, columns(task, [0.0, 1.0, 2.1], there=1.0)).item() == 0.0
    assert lack_of(task, columns(task, [2.1] * 3, clock=19)).item() == pytest.approx(0.2, abs=1e-6)
    assert lack_of(task, columns(task, [2.1] * 3, clock=21)).item() == pytest.approx(0.3)


def test_the_gradient_goes_into_the_deepest_sample(task: Task) -> None:
    found = columns(task, [0.0, 1.0, 1.0, 2.1, 2.05])
    lack_of(task, found).sum().backward()  # type: ignore[no-untyped-call]
    gradient = found["x"].grad
    assert gradient is not None
    assert gradient[:, 0].tolist() == [0.0, 0.0, 0.0, -1.0, 0.0]


def test_it_is_a_performance_term_of_missions(task: Task) -> None:
    found = {name: column.detach() for name, column in columns(task, [0.0] * 7 + [1.0, 2.1]).items()}
    deep = {**found, "x": found["x"] + torch.tensor([0.0] * 8 + [0.1])[:, None]}
    rho, u = torch.zeros(1), torch.zeros(1, 8, 1)
    difference = task.performance(found, rho, u) - task.performance(deep, rho, u)
    assert difference.item() == pytest.approx(GOALS * 0.1, abs=5e-3)


@pytest.mark.parametrize(
    ("path", "goes_on"),
    [([2.1, 2.2], True), ([2.2, 2.1], False), ([2.4, 2.5], False), ([1.9, 2.1], False)],
)
def test_a_plan_goes_on_while_it_gets_further_in(task: Task, path: list[float], goes_on: bool) -> None:
    assert task.pending_goals.deepened(columns(task, path), TORCH).tolist() == [[goes_on]]


class Leaver(Policy):
    """Plans to go left, always."""

    def candidates(self, x0: Tensor) -> Tensor:
        return torch.full((len(x0), 1, 8, 1), -1.0, dtype=x0.dtype)


def test_a_guard_carries_on_with_a_plan_that_keeps_a_promise(task: Task) -> None:
    guard = Guard(task, Leaver(task), "none")
    x = torch.zeros(1, len(task.system.names), dtype=torch.float64)
    x[0, task.system.names.index("x")], x[0, task.system.names.index("there")] = 2.05, 1.0
    for name in task.system.names:
        if name.startswith("either"):
            x[0, task.system.names.index(name)] = 1.0
    begun = guard.decide(x)
    inward = torch.full_like(begun.plan, 1.0)
    carried = guard.decide(x, replace(begun, plan=inward))
    assert carried.action.item() == 1.0
    deep = x.clone()
    deep[0, 0] = 2.4
    assert guard.decide(deep, replace(begun, plan=inward)).action.item() == -1.0


def test_without_a_mission_there_are_no_promises(tmp_path: Path) -> None:
    path = tmp_path / "line.yaml"
    path.write_text(LINE)
    spec = Spec.parse(
        Source("line.stl", "spec line\nstate signal x [m]\nrequire low: always[0, T] x < 3 m\n")
    )
    task = Task.of(spec, System.load(path))
    assert isinstance(task.pending_goals, PendingGoals)
    assert task.pending_goals.items == ()
