"""Obligations of plans: the requirements as written, with windows that count from the state at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import stlc
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir.text import show_formula
from stlc.controller.problem.task import Task
from stlc.controller.search.planner import PlanBudget, plan
from stlc.controller.search.sequences.obligations import Obligations
from stlc.dynamics.system import System

ROOT = Path(__file__).parents[4]
HEAD = "spec goals\nstate signal x, y [m]\n"


def task_of(text: str) -> Task:
    system = System.load(ROOT / "examples/planning/circles_linear.yaml", {"time.horizon": "20 steps"})
    return Task.of(stlc.parse(HEAD + text), system)


def at(task: Task, clock: int) -> list[str]:
    state = task.sample(1, seed=0)[0].double()
    state[task.system.names.index("clock")] = clock
    return [show_formula(each) for each in Obligations(task).at(state)]


@pytest.mark.apart
@pytest.mark.parametrize(
    "formula",
    [
        "y < 1 m until@[2 steps, 15 steps] x > 1 m",
        "(eventually@[0 steps, 18 steps] x > 1 m) or always@[3 steps, 9 steps] y < 1 m",
        "eventually@[1 steps, 12 steps] always[0, 3 steps] x > 0 m",
        "always@[0 steps, 9 steps] (y > 0 m -> eventually[0, 6 steps] x > 0 m)",
        "(always[0, T] x < 3 m) and (x > 0 m) and y > 0 m release@[0 steps, 9 steps] x < 2 m",
    ],
)
def test_from_the_start_they_hold_where_the_requirement_holds(formula: str) -> None:
    task = task_of(f"require goal: {formula}")
    x0 = task.sample(300, seed=1).double()
    low, high = task.system.control_low.double(), task.system.control_high.double()
    random = torch.Generator().manual_seed(2)
    level = torch.rand(300, 4, len(low), generator=random).double().repeat_interleave(5, 1)
    judged = task.judge(x0, low + (high - low) * level)
    env = {name: column.numpy() for name, column in judged.columns.items()}
    each = evaluate(Obligations(task).at(x0[0]), env, ops=NUMPY)
    found = np.min([np.broadcast_to(values[0], 300) for values in each], axis=0)
    satisfied = judged.rho.numpy() >= 0.0
    assert 0 < satisfied.sum() < 300
    assert np.array_equal(found >= 0.0, satisfied)


def test_windows_count_from_the_state_at_hand() -> None:
    task = task_of(
        "require a: y < 1 m until@[2 steps, 15 steps] x > 1 m\nrequire b: always@[0 steps, 4 steps] x < 9 m"
    )
    assert at(task, 0) == ["y < 1 until[2..15] x > 1", "always[0..4] x < 9"]
    assert at(task, 3) == ["y < 1 until[0..12] x > 1", "always[0..1] x < 9"]
    assert at(task, 5) == ["y < 1 until[0..10] x > 1"]


def test_what_is_due_after_the_plan_is_left_to_later_plans() -> None:
    task = task_of(
        "require a: y < 1 m until@[0 steps, 50 steps] x > 1 m\n"
        "require b: eventually@[0 steps, 50 steps] x > 9 m"
    )
    assert at(task, 10) == ["always[0..end] y < 1"]
    assert at(task, 30) == ["y < 1 until[0..20] x > 1", "eventually[0..20] x > 9"]


def test_what_every_plan_meets_is_no_obligation() -> None:
    task = task_of(
        "require a: (eventually@[0 steps, 15 steps] x > 1 m) and eventually@[0 steps, 18 steps] y > 1 m"
    )
    state = task.sample(1, seed=0)[0].double()
    state[[task.system.names.index(name) for name in ("y", "clock", "a")]] = torch.tensor(
        [-2.0, 4.0, 1.0]
    ).double()
    assert [show_formula(each) for each in Obligations(task).at(state)] == ["eventually[0..14] y > 1"]


def test_goals_in_an_order_are_reached_in_either_form() -> None:
    text = "require a: {} until{} {}\nrequire b: eventually{} {}"
    near = "(x - 3 m)^2 + y^2 <= (1 m)^2", "(x + 3 m)^2 + y^2 <= (1 m)^2"
    for window in ("[0, T]", "@[0 steps, 20 steps]"):
        task = task_of(text.format(f"(not {near[0]})", window, near[1], window, near[0]))
        found = plan(task, task.sample(2, seed=3), "schedule", budget=PlanBudget(10.0, 20_000))
        assert bool(found.satisfied.all()), window


@pytest.mark.parametrize(("first", "last", "late"), [(0, 9, 6), (2, 8, 4)])
def test_answers_that_are_due_for_earlier_questions_are_obligations(first: int, last: int, late: int) -> None:
    task = task_of(
        f"require goal: always@[{first} steps, {last} steps] (y > 0 m -> eventually[0, {late} steps] x > 0 m)"
    )
    x0 = task.sample(60, seed=1).double()
    low, high = task.system.control_low.double(), task.system.control_high.double()
    random = torch.Generator().manual_seed(2)
    level = torch.rand(60, 4, len(low), generator=random).double().repeat_interleave(5, 1)
    states = task.rollout(x0, low + (high - low) * level)
    x, y = (states[..., task.system.names.index(name)].numpy() for name in "xy")
    dues = set[bool]()
    for row, now in ((row, now) for row in range(60) for now in (3, 7, 11)):
        asked = [k for k in range(first, last + 1) if y[row, k] > 0.0]
        answered = [(x[row, k : k + late + 1] > 0.0).any() for k in asked]
        if any(k + late <= now and not good for k, good in zip(asked, answered, strict=True)):
            continue  # lost already
        obligations = Obligations(task).at(states[row, now])
        env = {name: states[row, now:, i : i + 1].numpy() for i, name in enumerate(task.system.names)}
        values = evaluate(obligations, env, ops=NUMPY, end="truncate") if obligations else []
        assert all(float(np.ravel(each)[0]) >= 0.0 for each in values) == all(answered)
        dues.add(any(show_formula(each).startswith("eventually") for each in obligations))
    assert dues == {True, False}
