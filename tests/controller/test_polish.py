"""The guard in full: never worse than what it is given, better than the paper's where there is time."""

from __future__ import annotations

import math

import pytest
import torch

from stlc.controller.backup import Backup
from stlc.controller.deploy import SOURCES, Guard
from stlc.controller.polish import POLISHED, FullBackup, Limits
from stlc.controller.savable import safely, savable
from stlc.controller.task import Task
from stlc.runtime.prefixes import Grid
from tests.controller.test_backup import F64, Constant, failing, grid

QUICK = Limits(seconds=None, tries=256, prefixes=30, places=2)


@pytest.mark.parametrize("action", [10.0, -10.0])
def test_it_finds_more_than_the_papers_backup_does(car_task: Task, action: float) -> None:
    x, plan = failing(car_task, action, 200)
    policy = Constant(car_task, action)
    paper = Backup(car_task, policy, grid=grid()).search(x, plan)
    found = FullBackup(car_task, policy, grid=grid(), limits=QUICK).search(x, plan)
    met, before = ((each.rho >= -1e-6).sum() for each in (found, paper))
    assert met > before
    assert found.safe.sum() >= paper.safe.sum()
    assert (found.source == POLISHED).any()
    assert SOURCES[POLISHED] == "polished"


def test_what_is_found_is_what_it_says(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, 100)
    found = FullBackup(car_task, Constant(car_task, 10.0), grid=grid(), limits=QUICK).search(x, plan)
    judged = car_task.judge(x, found.plan)
    assert torch.equal(judged.rho, found.rho)
    assert torch.equal(judged.safe >= -1e-6, found.safe)
    assert (found.plan >= -10.0).all()
    assert (found.plan <= 10.0).all()


def test_the_rest_of_a_plan_is_a_place_to_start_from(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, 60)
    known = FullBackup(car_task, Constant(car_task, 10.0), grid=grid(), limits=QUICK).search(x, plan)
    good = (known.rho >= 0.05).nonzero()[:, 0]
    assert len(good) > 10
    lazy = FullBackup(
        car_task, Constant(car_task, 10.0), grid=grid(), limits=Limits(seconds=0.0, tries=16, prefixes=1)
    )
    found = lazy.search(x[good], plan[good], known.plan[good])
    assert (found.rho >= -1e-6).all()


def test_no_time_still_gives_an_answer_of_the_papers_rule(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, 100)
    limits = Limits(seconds=0.0, tries=16, prefixes=30)
    found = FullBackup(car_task, Constant(car_task, 10.0), grid=grid(), limits=limits).search(x, plan)
    assert set(found.source[found.safe & (found.rho < -1e-6)].tolist()) <= {1, POLISHED}
    assert set(found.source[~found.safe].tolist()) <= {2}
    assert torch.isfinite(found.plan).all()


def test_whoever_can_be_saved_is_saved(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, 300)
    can = savable(car_task, x)
    poor = {"seconds": None, "tries": 16, "prefixes": 1, "places": 1}
    policy, few = Constant(car_task, 10.0), grid(lengths=(1,))
    alone = FullBackup(car_task, policy, grid=few, limits=Limits(**poor, rescue=False)).search(x, plan)
    missed = (can & ~alone.safe).sum()
    found = FullBackup(car_task, policy, grid=few, limits=Limits(**poor)).search(x, plan)
    assert (can & ~found.safe).sum() <= 1 < missed  # one can be saved by less than rounding


def test_plans_that_are_no_numbers_are_places_too(car_task: Task) -> None:
    x = car_task.sample(40, seed=3, dtype=F64)
    plan = torch.full((40, car_task.horizon, 1), math.nan, dtype=F64)
    found = FullBackup(car_task, Constant(car_task, 0.0), grid=grid(), limits=QUICK).search(x, plan)
    assert torch.isfinite(found.plan).all()
    assert found.safe.double().mean() > 0.9


def test_a_large_grid_is_sampled_and_a_small_one_is_not(car_task: Task) -> None:
    full = FullBackup(car_task, Constant(car_task, 0.0), grid=grid(lengths=(1, 2)), limits=QUICK)
    assert torch.equal(full._prefixes(1), torch.from_numpy(full.grid.prefixes(1)))
    assert len(full.grid.prefixes(2)) == full.grid.count(2) == 25
    full = FullBackup(
        car_task, Constant(car_task, 0.0), grid=Grid(((-2.0, 3.0, 4.0),), (4,), 64), limits=QUICK
    )
    drawn = full._prefixes(4)
    assert drawn.shape == (30, 4, 1)
    assert (drawn >= -2.0).all()
    assert (drawn <= 4.0).all()
    assert len(drawn.unique()) > 100


def test_phi_safe_alone_is_a_task(car_task: Task) -> None:
    alone = safely(car_task)
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
