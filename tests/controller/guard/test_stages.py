"""Stages of guards: their order, their one rule of preference, and a stage in a file of its own."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import stlc.controller.guard.stages as package
from stlc.controller.guard.candidates import BACKUP, REPAIRED, SAFEST, Candidates, Limits, rank
from stlc.controller.guard.search import StagedSearch
from stlc.controller.guard.stages import STAGES, stages_of
from stlc.controller.guard.stages.longest_safe_prefix import LongestSafePrefix
from stlc.controller.guard.stages.prefix_shooting import PrefixShooting
from stlc.controller.problem.task import Task
from tests.controller.guard.test_prefix_shooting import Constant, failing, grid

BRAKING = '''"""Full braking, before anything else is tried."""

import torch
from stlc.controller.guard.candidates import REPAIRED, Candidates
from stlc.controller.guard.stages import GuardStage


class Braking(GuardStage):
    turns = {"paper": 5}

    def __init__(self, setup):
        self.task = setup.task

    def wanted(self, best):
        return torch.ones_like(best.is_safe)

    def propose(self, rejected, rows, deadline):
        low = self.task.system.control_low.to(rejected.x)
        plans = low.expand(len(rows), self.task.horizon, -1)
        return Candidates.judged(self.task, rejected.x[rows], plans, REPAIRED)


STAGE = Braking
'''


def test_stages_take_their_turns() -> None:
    assert [stage.__name__ for stage in stages_of("paper")] == ["PrefixShooting", "LongestSafePrefix"]
    assert [stage.__name__ for stage in stages_of("full")] == [
        *("GradientRefine", "LocalSearch", "Restarts", "SampledShooting"),
        *("PrefixShooting", "LongestSafePrefix"),
    ]
    assert stages_of("none") == ()


def test_one_order_of_preference() -> None:
    """phi, safe plans of the policy, other safe ones, the longest safe prefix, the rest, the unjudged."""
    plan = torch.zeros(6, 3, 1, dtype=torch.float64)
    rho = torch.tensor([0.1, -1.0, -0.5, -3.0, -2.0, -torch.inf], dtype=torch.float64)
    safe = torch.tensor([0.1, 0.2, 0.3, -2.0, -2.0, -torch.inf], dtype=torch.float64)
    source = torch.tensor([REPAIRED, BACKUP, REPAIRED, SAFEST, REPAIRED, -1])
    plans = Candidates(plan, rho, safe, torch.zeros(6), source, torch.zeros(6, dtype=torch.int64))
    assert rank(plans).argsort(descending=True).tolist() == [0, 1, 2, 3, 4, 5]
    better = replace(plans, rho=plans.rho + 0.01)
    assert bool((rank(better) > rank(plans))[:4].all())


def test_what_is_not_handed_on_is_made_again(car_task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    x, plan = failing(car_task, 10.0, n=60)
    known = StagedSearch(car_task, Constant(car_task, 10.0), "paper", grid=grid()).search(x, plan)
    assert bool((known.source == SAFEST).any())
    monkeypatch.setattr(f"{PrefixShooting.__module__}.HANDED_ON", 0)
    again = StagedSearch(car_task, Constant(car_task, 10.0), "paper", grid=grid()).search(x, plan)
    for name in ("plans", "rho", "source", "prefix_length"):
        assert torch.equal(getattr(known, name), getattr(again, name)), name
    assert LongestSafePrefix in stages_of("paper")


@pytest.fixture
def braking(tmp_path: Path) -> Iterator[None]:
    """A stage more, in a file of its own."""
    (tmp_path / "braking.py").write_text(BRAKING, encoding="utf-8")
    package.__path__.append(str(tmp_path))
    yield
    package.__path__.pop()
    STAGES._entries.pop("braking", None)
    sys.modules.pop("stlc.controller.guard.stages.braking", None)


@pytest.mark.usefixtures("braking")
def test_a_stage_is_one_file(car_task: Task) -> None:
    assert stages_of("paper")[0].__name__ == "Braking"
    x, plan = failing(car_task, 10.0, n=60)
    search = StagedSearch(car_task, Constant(car_task, 10.0), "paper", grid=grid(), limits=Limits())
    found = search.search(x, plan)
    braked = found.source == REPAIRED
    assert bool(braked.any())
    assert bool((found.plans[braked] == car_task.system.control_low).all())
