"""The table of planning problems, and its drawn tasks."""

from __future__ import annotations

from math import dist
from pathlib import Path

import pytest
import torch

import stlc
from benchmarks.arm import draw_arm
from benchmarks.circles import KINDS, STEPS, draw
from benchmarks.store import ResultStore, load
from benchmarks.table import text_of
from benchmarks.tables.planning import COLUMNS, PROBLEMS, Problem, measured
from stlc.controller.problem.task import Task
from stlc.controller.search.planner import PlanBudget, plan
from stlc.dynamics.system import System

pytestmark = pytest.mark.apart

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_drawn_tasks_are_judged_as_the_monitor_judges_them(kind: str, seed: int) -> None:
    drawn = draw(seed, kind)
    assert drawn == draw(seed, kind)
    system = System.load(ROOT / "examples/planning/circles_linear.yaml")
    task = Task.of(stlc.parse(drawn.text), system, end="truncate")
    monitor = stlc.Monitor(stlc.parse(drawn.text), dt=0.5)
    random = torch.Generator().manual_seed(seed)
    plans = (torch.rand(6, STEPS, 2, generator=random).double() - 0.5).repeat_interleave(4, 1)[:, :STEPS]
    x0 = torch.tensor(drawn.x0[:2], dtype=torch.float64).expand(6, -1)
    judged = task.judge(x0, 2.0 * plans)
    assert torch.allclose(task.robustness(task.system.rollout(x0, 2.0 * plans)), judged.rho)
    for i, rho in enumerate(judged.rho.tolist()):
        signals = {name: column[:, i].numpy() for name, column in judged.columns.items()}
        assert float(monitor.robustness(signals, at=0, end="truncate")) == pytest.approx(rho)


@pytest.mark.parametrize("kind", KINDS)
def test_tasks_of_the_arm_keep_their_objects_apart(kind: str) -> None:
    drawn = draw_arm(4, kind)
    assert drawn == draw_arm(4, kind)
    path = ROOT / "examples/planning/arm.yaml"
    task = Task.of(stlc.parse(drawn.text), System.load(path), end="truncate")
    x0 = torch.tensor([drawn.x0], dtype=torch.float64)
    assert torch.allclose(task.sample(1, seed=0, dtype=torch.float64), x0)
    judged = task.judge(x0, torch.full((1, STEPS, 7), 0.5, dtype=torch.float64))
    signals = {name: column[:, 0].numpy() for name, column in judged.columns.items()}
    monitor = stlc.Monitor(stlc.parse(drawn.text), system=path)
    assert float(monitor.robustness(signals, at=0, end="truncate")) == pytest.approx(float(judged.rho))
    avoided = [i for i, rule in enumerate(task.rules) if rule.name.startswith("avoid")]
    still = task.judge(x0, torch.zeros(1, STEPS, 7, dtype=torch.float64))
    assert bool((still.requirements[:, avoided] > 0.0).all())


def test_a_task_of_one_visit_is_solved_by_going_there() -> None:
    drawn = draw(3, "reach")
    system = System.load(ROOT / "examples/planning/circles_linear.yaml")
    task = Task.of(stlc.parse(drawn.text), system, end="truncate")
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
