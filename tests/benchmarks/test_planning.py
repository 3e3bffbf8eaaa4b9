"""The table of planning problems, and its drawn tasks."""

from __future__ import annotations

from math import dist
from pathlib import Path

import pytest
import torch

import stlc
from benchmarks.circles import KINDS, STEPS, draw
from benchmarks.store import ResultStore, load
from benchmarks.table import text_of
from benchmarks.tables.planning import COLUMNS, PROBLEMS, Problem, measured
from stlc.controller.planning.planner import PlanBudget, plan
from stlc.controller.problem.task import Task
from stlc.dynamics.model.system import System

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(5))
def test_drawn_tasks_fit_a_plan_and_imply_the_published_formula(kind: str, seed: int) -> None:
    drawn = draw(seed, kind)
    assert drawn == draw(seed, kind)
    system = System.load(ROOT / "examples/planning/circles_linear.yaml")
    Task.of(stlc.parse(drawn.planned), system)
    monitors = [stlc.Monitor(stlc.parse(text), dt=0.5) for text in (drawn.planned, drawn.published)]
    random = torch.Generator().manual_seed(seed)
    for _ in range(20):
        steps = (torch.rand(STEPS, 2, generator=random) - 0.5).repeat_interleave(4, 0)[:STEPS]
        path = torch.cat((torch.zeros(1, 2), steps.cumsum(0))).add(torch.tensor(drawn.x0[:2])).numpy()
        signals = {"x": path[:, 0], "y": path[:, 1]}
        planned, published = (float(each.robustness(signals, at=0, end="truncate")) for each in monitors)
        assert published >= planned


def test_a_task_of_one_visit_is_solved_by_going_there() -> None:
    drawn = draw(3, "reach")
    system = System.load(ROOT / "examples/planning/circles_linear.yaml")
    task = Task.of(stlc.parse(drawn.planned), system)
    found = plan(task, torch.tensor(drawn.x0[:2]), budget=PlanBudget(1.0))
    assert bool(found.satisfied)
    assert dist(drawn.x0[:2], (0, 0)) < 10


@pytest.mark.parametrize("problem", [each for each in PROBLEMS if not each.tasks], ids=lambda each: each.name)
def test_every_specification_compiles_with_its_system(problem: Problem) -> None:
    task = load(f"planning/{problem.spec}")
    assert len(task.sample(2, seed=0).unique(dim=0)) == 1


def test_a_cell_is_measured_once(tmp_path: Path) -> None:
    store, problem = ResultStore("planning", tmp_path), Problem("reach_avoid", "no figures", target=0.1)
    row = measured(problem, "search", store)
    assert row.solution is not None
    assert (row.solution.found, row.solution.starts) == (1, 1)
    assert measured(problem, "search", store) == row
    assert text_of(row, COLUMNS["found"]) == "1 of 1"


def test_a_refusal_is_a_row_with_the_reason(tmp_path: Path) -> None:
    pytest.importorskip("highspy")
    row = measured(Problem("nonlinear_reach_avoid", ""), "milp", ResultStore("planning", tmp_path))
    assert row.solution is None
    assert "cos(theta)" in text_of(row, COLUMNS["found"])
