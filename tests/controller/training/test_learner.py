"""Training searches for whole plans by the planner where changing them locally leads nowhere."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from stlc.controller.problem.task import Task
from stlc.controller.search.local_search import Searcher
from stlc.controller.search.planner import PlanBudget, plan
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.learner import EFFORTS, Trainer
from stlc.controller.training.method import Validation
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

SYSTEM = """
stlc: 1
name: point
time: {dt: 1 s, horizon: 16 steps, integrator: euler}
state:
  x: {unit: m, range: [0, 10]}
  y: {unit: m, range: [0, 10]}
control:
  vx: {unit: m/s, range: [-1, 1]}
  vy: {unit: m/s, range: [-1, 1]}
flow: {x: vx, y: vy}
init:
  mixture:
    - draw: {x: "uniform(4, 4.4)", y: "uniform(4, 4.4)"}
"""
SPEC = """
spec puzzle
state signal x, y [m]
def p = [x, y]
region wall = box([5, 0], [5.6, 3])
require key:  (p not in box([7, 0], [8, 10])) until[0, T] p in box([1, 0], [2, 1])
require goal: eventually[0, T] p in box([9, 0], [10, 2])
require dry:  always[0, T] p not in wall
"""
"""The key is on the other side than the goal, behind a door: no plan that falls short hints at it."""


@pytest.fixture(scope="module")
def puzzle(tmp_path_factory: pytest.TempPathFactory) -> Task:
    path = tmp_path_factory.mktemp("puzzle") / "point.yaml"
    path.write_text(SYSTEM)
    return Task.of(Spec.parse(Source("puzzle.stl", SPEC)), System.load(path))


def test_the_planner_solves_a_puzzle_that_local_search_does_not_solve(puzzle: Task) -> None:
    x0 = puzzle.sample(4, seed=0, dtype=torch.float64)
    middle = torch.zeros(len(x0), puzzle.horizon, 2)
    improved = Searcher(puzzle, torch.Generator().manual_seed(0), target=1e-4).repair(
        x0.float(), middle, middle[:0], tries=1000
    )
    assert not bool(improved.solved.all())
    one, other = (plan(puzzle, x0, budget=PlanBudget(torch.inf, EFFORTS[0])) for _ in range(2))
    assert bool(one.satisfied.all())
    assert torch.equal(one.plans, other.plans)


def test_a_training_explores_where_local_search_leads_nowhere(
    puzzle: Task, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stlc.controller.training.learner.MARGIN_STATES", 8)
    monkeypatch.setattr("stlc.controller.training.learner.BARREN", 2.0)  # whatever local search solves
    engine = replace(
        resolve_config(puzzle, TrainConfig(seed=0, batch=8, threads=1)), pool=16, most=8, every=1
    )
    trainer = Trainer(puzzle, engine, steps=8, device=torch.device("cpu"))
    rounds: list[Validation] = []
    while sum(look.explored for look in rounds) == 0 and trainer.step < 6:
        trainer.advance()
        assert trainer.explore()
        rounds.append(trainer.validate())
    assert [look.explored for look in rounds[:2]] == [0, 0]  # local search is tried first
    assert rounds[-1].explored > 0
    assert trainer.buffer.count >= rounds[-1].explored
