"""Stages of guards: their order, their one rule of preference, and a stage in a file of its own."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from stlc.controller.guard.candidates import BACKUP, REPAIRED, SAFEST, Candidates
from stlc.controller.guard.kinds.full import GUARD as FULL
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.guard.search import StagedSearch
from stlc.controller.guard.stages import STAGES
from stlc.controller.guard.stages.prefix_shooting import PrefixShooting
from stlc.controller.problem.task import Task
from tests.controller.guard.test_prefix_shooting import Constant, failing, grid


def test_stages_take_their_turns() -> None:
    assert [STAGES.get(name).__name__ for name in PAPER.stages] == ["PrefixShooting", "LongestSafePrefix"]
    assert [STAGES.get(name).__name__ for name in FULL.stages] == [
        *("GradientRefine", "LocalSearch", "Restarts", "SampledShooting"),
        *("PrefixShooting", "LongestSafePrefix"),
    ]
    assert {*STAGES} == {*FULL.stages}


def test_one_order_of_preference() -> None:
    """phi, safe plans of the policy, other safe ones, the longest safe prefix, the rest, the unjudged."""
    plan = torch.zeros(6, 3, 1, dtype=torch.float64)
    rho = torch.tensor([0.1, -1.0, -0.5, -3.0, -2.0, -torch.inf], dtype=torch.float64)
    safe = torch.tensor([0.1, 0.2, 0.3, -2.0, -2.0, -torch.inf], dtype=torch.float64)
    source = torch.tensor([REPAIRED, BACKUP, REPAIRED, SAFEST, REPAIRED, -1])
    plans = Candidates(plan, rho, safe, torch.zeros(6), source, torch.zeros(6, dtype=torch.int64))
    assert plans.standing.argsort(descending=True).tolist() == [0, 1, 2, 3, 4, 5]
    better = replace(plans, rho=plans.rho + 0.01)
    assert bool((better.standing > plans.standing)[:4].all())


def test_what_is_not_handed_on_is_made_again(car_task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    x, plan = failing(car_task, 10.0, n=60)
    known = StagedSearch(car_task, Constant(car_task, 10.0), PAPER, grid=grid()).search(x, plan)
    assert bool((known.source == SAFEST).any())
    monkeypatch.setattr(f"{PrefixShooting.__module__}.HANDED_ON", 0)
    again = StagedSearch(car_task, Constant(car_task, 10.0), PAPER, grid=grid()).search(x, plan)
    for name in ("plans", "rho", "source", "prefix_length"):
        assert torch.equal(getattr(known, name), getattr(again, name)), name
