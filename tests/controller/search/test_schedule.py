"""Schedules of goals, and the search that meets them by Gauss-Newton steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import stlc
from stlc.compile.ir import nodes as ir
from stlc.controller.problem.task import Task
from stlc.controller.search.planner import PlanBudget, plan
from stlc.controller.search.schedules import GoalScheduler, tempo
from stlc.dynamics.system import System

ROOT = Path(__file__).parents[3]
HEAD = """spec goals
state signal x, y [m]
def at_a = (1 m)^2 - (x - 3 m)^2 - y^2 >= 0 m^2
def at_b = (1 m)^2 - (x + 3 m)^2 - y^2 >= 0 m^2
"""


def task_of(text: str, system: str = "linear") -> Task:
    loaded = System.load(ROOT / f"examples/planning/circles_{system}.yaml")
    return Task.of(stlc.parse(HEAD + text), loaded, end="truncate")


def scheduler_of(task: Task) -> GoalScheduler:
    return GoalScheduler([rule.formula for rule in task.rules], task.system.names, task.horizon)


@pytest.mark.parametrize(
    "formula",
    [
        "((not at_a) until[0, end] at_b) and (eventually[0, 40 steps] at_a)",
        "eventually[3 steps, 9 steps] (at_a and eventually[5 steps, 60 steps] always[0, 4 steps] at_b)",
        "(at_a or eventually[0, end] at_b) and always[0, end] (x < 20 m or y < 20 m)",
        "(x < 20 m) release[0, 20 steps] (y < 20 m)",
        "always[0, 3 steps] eventually[0, 3 steps] x < 9 m",
    ],
)
def test_states_that_meet_a_schedule_satisfy_the_formula(formula: str) -> None:
    task = task_of(f"require goal: {formula}")
    scheduler = scheduler_of(task)
    drawn = scheduler.draw(64, np.random.default_rng(0))
    assert len(drawn)
    for needed in drawn[:8]:  # conditions are independent signals here, false where they are not needed
        signals = {f"c{i}": np.where(row, 1.0, -1.0) for i, row in enumerate(needed)}
        for i, condition in enumerate(scheduler.conditions):  # an opposite has the same signal
            other = scheduler.opposite(condition)
            if other is not None and other < i:
                signals[f"c{i}"] = np.where(needed[i], 1.0, -signals[f"c{other}"])
                signals[f"c{other}"] = np.where(needed[i], -1.0, signals[f"c{other}"])
        assert holds(task.rules[0].formula, scheduler, signals, 0)


def holds(node: ir.Formula, scheduler: GoalScheduler, signals: dict[str, np.ndarray], k: int) -> bool:
    """Truth by the definition of the operators, with windows cut at the last sample."""
    last = scheduler.steps
    if scheduler.decidable(node):
        return all(signals[f"c{scheduler.number(part)}"][k] > 0 for part in node.terms("and"))
    if isinstance(node, ir.BoolOp):
        both = all if node.op == "and" else any
        return both(holds(item, scheduler, signals, k) for item in node.items)
    assert isinstance(node, (ir.Temporal, ir.Until))
    end = last if node.window.hi is None else min(last, k + node.window.hi)
    window = range(k + node.window.lo, end + 1)
    if isinstance(node, ir.Temporal):
        both = all if node.op == "always" else any
        return both(holds(node.body, scheduler, signals, i) for i in window)
    if node.op == "until":
        return any(
            holds(node.right, scheduler, signals, i)
            and all(holds(node.left, scheduler, signals, j) for j in range(k, i + 1))
            for i in window
        )
    return all(
        holds(node.right, scheduler, signals, i)
        or any(holds(node.left, scheduler, signals, j) for j in range(k, i))
        for i in window
    )


def test_schedules_that_contradict_themselves_are_dropped() -> None:
    scheduler = scheduler_of(task_of("require goal: (eventually[5 steps, 5 steps] at_a) and always not at_a"))
    assert not len(scheduler.draw(50, np.random.default_rng(0)))


def test_the_nearest_schedule_keeps_the_choices_that_a_trajectory_makes() -> None:
    task = task_of("require goal: (eventually[0, 20 steps] at_a) and (always[30 steps, 32 steps] at_b)")
    scheduler = scheduler_of(task)
    distance = np.full((1, 2, 65), -2.0)
    distance[0, 0, 17], distance[0, 0, 40] = -0.5, 1.0
    needed = scheduler.nearest(distance)[0]
    assert [row.nonzero()[0].tolist() for row in needed] == [[17], [30, 31, 32]]


@pytest.mark.parametrize(
    "formula",
    [
        "at_a or eventually[0, 9 steps] at_b",
        "at_b until[0, 9 steps] at_a",
        "at_b release[0 steps, 9 steps] at_a",
        "at_a or always[1 steps, 3 steps] (at_a until[0, 4 steps] at_b)",
        "eventually[0, 9 steps] always[0, 2 steps] at_a",
    ],
)
def test_a_trajectory_that_satisfies_a_formula_meets_its_nearest_schedule(formula: str) -> None:
    task = task_of(f"require goal: {formula}")
    scheduler = scheduler_of(task)
    random = np.random.default_rng(0)
    shape = 200, len(scheduler.conditions), 65
    distance = random.choice([-1.0, 1.0], shape, p=[0.4, 0.6]) * random.random(shape)
    needed = scheduler.nearest(distance)
    meets = ~(needed & (distance < 0.0)).any((1, 2))
    for each, met in zip(distance, meets, strict=True):
        signals = {f"c{i}": row for i, row in enumerate(each)}
        assert met == holds(task.rules[0].formula, scheduler, signals, 0)


def test_a_schedule_may_ask_for_one_alternative_of_an_or_of_comparisons() -> None:
    task = task_of("require goal: always[0, 20 steps] (x > 1 m or y > 2 m)")
    scheduler = scheduler_of(task)
    assert len(scheduler.conditions) == 3
    drawn = scheduler.draw(64, np.random.default_rng(0))
    assert drawn[:, 0, :21].all()
    assert drawn[:, 1:].any((0, 2)).all()
    assert not drawn[:, 1:, 21:].any()


def test_the_tempo_is_the_greatest_speed_between_goals() -> None:
    needed = np.zeros((2, 2, 11), np.bool_)
    needed[0, 0, 2:4] = needed[0, 1, 5] = needed[1, 1, 10] = True
    apart = np.array([[0.0, 4.0, 1.0], [4.0, 0.0, 6.0], [1.0, 6.0, 0.0]])
    assert tempo(needed, apart).tolist() == [3.0, 0.1]


def test_goals_in_an_order_are_reached() -> None:
    task = task_of("require goal: ((not at_a) until[0, end] at_b) and eventually[0, end] at_a", "dubins")
    x0 = torch.tensor([[2.0, 2.0, 0.0, 0.5], [2.0, -2.0, 0.0, 0.5]], dtype=torch.float64)
    found = plan(task, x0, "schedule", budget=PlanBudget(10.0))
    assert bool(found.satisfied.all())
    again = plan(task, x0, "schedule", budget=PlanBudget(10.0))
    assert torch.equal(found.plans, again.plans)
