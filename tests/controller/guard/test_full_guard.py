"""The guard in full: never worse than what it is given, better than the paper's where there is time."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from stlc.controller.guard.candidates import REPAIRED, SOURCES, Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.kinds.full import GUARD as FULL
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.guard.search import StagedSearch
from stlc.controller.problem.task import Task
from stlc.controller.search.ascent import GradientAscent
from stlc.controller.search.feasibility import viable
from tests.controller.guard.test_prefix_shooting import F64, Constant, failing, grid

QUICK = Limits(seconds=None, tries=256, drawn=30, guesses=2)


@pytest.mark.parametrize("action", [10.0, -10.0])
def test_it_finds_more_than_the_papers_backup_does(car_task: Task, action: float) -> None:
    x, plan = failing(car_task, action, 80)
    policy = Constant(car_task, action)
    paper = StagedSearch(car_task, policy, PAPER, grid=grid()).search(x, plan)
    found = StagedSearch(car_task, policy, FULL, grid=grid(), limits=QUICK).search(x, plan)
    met, before = ((each.rho >= -1e-6).sum() for each in (found, paper))
    assert met > before
    assert found.is_safe.sum() >= paper.is_safe.sum()
    assert (found.source == REPAIRED).any()
    assert SOURCES[REPAIRED] == "polished"


def test_what_is_found_is_what_it_says(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, 100)
    found = StagedSearch(car_task, Constant(car_task, 10.0), FULL, grid=grid(), limits=QUICK).search(x, plan)
    judged = car_task.judge(x, found.plans)
    assert torch.equal(judged.rho, found.rho)
    assert torch.equal(judged.safe >= -1e-6, found.is_safe)
    assert (found.plans >= -10.0).all()
    assert (found.plans <= 10.0).all()


def test_the_rest_of_a_plan_is_a_place_to_start_from(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, 60)
    known = StagedSearch(car_task, Constant(car_task, 10.0), FULL, grid=grid(), limits=QUICK).search(x, plan)
    good = (known.rho >= 0.05).nonzero()[:, 0]
    assert len(good) > 10
    lazy = StagedSearch(
        car_task, Constant(car_task, 10.0), FULL, grid=grid(), limits=Limits(seconds=0.0, tries=16, drawn=1)
    )
    found = lazy.search(x[good], plan[good], known.plans[good])
    assert (found.rho >= -1e-6).all()


def test_no_time_still_gives_an_answer_of_the_papers_rule(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, 100)
    limits = Limits(seconds=0.0, tries=16, drawn=30)
    found = StagedSearch(car_task, Constant(car_task, 10.0), FULL, grid=grid(), limits=limits).search(x, plan)
    assert set(found.source[found.is_safe & (found.rho < -1e-6)].tolist()) <= {1, REPAIRED}
    assert set(found.source[~found.is_safe].tolist()) <= {2}
    assert torch.isfinite(found.plans).all()


def test_gradient_steps_mend_what_a_short_search_does_not(
    car_task: Task, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, plan = failing(car_task, 10.0, 100)
    limits = Limits(seconds=None, tries=16, drawn=1, guesses=1, again=16)
    policy, few = Constant(car_task, 10.0), grid(lengths=(1,))
    found = StagedSearch(car_task, policy, FULL, grid=few, limits=limits).search(x, plan)
    monkeypatch.setattr(GradientAscent, "refine", _as_they_are)
    improved = StagedSearch(car_task, policy, FULL, grid=few, limits=limits).search(x, plan)
    assert (found.rho >= -1e-6).sum() > (improved.rho >= -1e-6).sum() + 5
    assert (found.source[found.rho >= -1e-6] == REPAIRED).all()


def _as_they_are(_ascent: GradientAscent, _x: Tensor, guesses: Tensor, _until: float) -> Tensor:
    return guesses


@pytest.mark.apart
def test_without_a_kernel_it_finds_as_much(car_task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    x, plan = failing(car_task, 10.0, 40)
    x, plan = x[:12], plan[:12]
    policy, limits = Constant(car_task, 10.0), Limits(seconds=None, tries=64, drawn=5, guesses=1, again=64)
    found = StagedSearch(car_task, policy, FULL, grid=grid(), limits=limits).search(x, plan)
    bare = Task(car_task.compiled, car_task.plain)
    monkeypatch.setitem(bare.__dict__, "native", None)
    slow = StagedSearch(bare, policy, FULL, grid=grid(), limits=limits).search(x, plan)
    assert torch.isfinite(slow.plans).all()
    assert (slow.rho >= -1e-6).sum() >= (found.rho >= -1e-6).sum() - 1
    assert (found.rho >= -1e-6).any()


def test_whoever_can_be_saved_is_saved(car_task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GradientAscent, "refine", _as_they_are)
    x, plan = failing(car_task, 10.0, 300)
    can = viable(car_task, x)
    poor = {"seconds": None, "tries": 16, "drawn": 1, "guesses": 1, "again": 16}
    policy, few = Constant(car_task, 10.0), grid(lengths=(1,))
    alone = StagedSearch(car_task, policy, FULL, grid=few, limits=Limits(**poor, rescue=False)).search(
        x, plan
    )
    missed = (can & ~alone.is_safe).sum()
    found = StagedSearch(car_task, policy, FULL, grid=few, limits=Limits(**poor)).search(x, plan)
    assert (can & ~found.is_safe).sum() <= 1 < missed  # one can be saved by less than rounding


def test_plans_that_are_no_numbers_are_places_too(car_task: Task) -> None:
    x = car_task.sample(40, seed=3, dtype=F64)
    plan = torch.full((40, car_task.horizon, 1), math.nan, dtype=F64)
    found = StagedSearch(car_task, Constant(car_task, 0.0), FULL, grid=grid(), limits=QUICK).search(x, plan)
    assert torch.isfinite(found.plans).all()
    assert found.is_safe.double().mean() > 0.9


def test_phi_safe_alone_is_a_task(car_task: Task) -> None:
    alone = car_task.safety_task
    x = car_task.sample(50, seed=1, dtype=F64)
    u = torch.zeros(50, car_task.horizon, 1, dtype=F64)
    assert torch.equal(alone.judge(x, u).rho, car_task.judge(x, u).safe)
    assert len(alone.rules) < len(car_task.rules)


def test_a_guard_in_full_decides(car_task: Task) -> None:
    x = car_task.sample(60, seed=2, dtype=F64)
    policy = Constant(car_task, 10.0)
    none, paper, full = (
        Guard(car_task, policy, mode, grid=grid(), limits=QUICK).decide(x)
        for mode in ("none", "paper", "full")
    )
    shares = [float((decision.rho >= -1e-6).double().mean()) for decision in (none, paper, full)]
    assert shares[0] < shares[1] <= shares[2]
    later = Guard(car_task, policy, "full", grid=grid(), limits=QUICK).decide(x, full.later())
    assert torch.isfinite(later.action).all()
