"""The backup policy that can be recorded is the backup policy."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.exported import run_of

from stlc.controller.guard.candidates import grid_of
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.guard.search import StagedSearch
from stlc.export import programs
from stlc.export.programs import Guarding
from stlc.runtime.prefixes import PrefixGrid


@pytest.mark.parametrize(
    "at_once",
    [pytest.param(programs.AT_ONCE, id="whole", marks=pytest.mark.apart), pytest.param(40, id="in pieces")],
)
def test_every_rule_of_the_backup(at_once: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_of("traffic", "car", tmp_path)
    monkeypatch.setattr(programs, "AT_ONCE", at_once)
    x = run.task.sample(60, seed=5, dtype=torch.float64)
    plan = run.policy.plan(x)
    plan[7] = torch.nan
    wanted = StagedSearch(run.task, run.policy, PAPER).search(x, plan)
    assert {1, 2} <= set(wanted.source.tolist())
    assert {1, 2, 3} <= set(wanted.prefix_length.tolist())
    with torch.no_grad():
        mine, rho, safe, each, source, t0 = Guarding(run.task, run.network).eval()(x, plan)
    assert (source.tolist(), t0.tolist()) == (wanted.source.tolist(), wanted.prefix_length.tolist())
    torch.testing.assert_close(mine, wanted.plans, rtol=0.0, atol=1e-6)
    judged = run.task.judge(x, mine)
    torch.testing.assert_close(rho, judged.rho, rtol=0.0, atol=1e-9)
    torch.testing.assert_close(safe, judged.safe, rtol=0.0, atol=1e-9)
    torch.testing.assert_close(each, judged.requirements, rtol=0.0, atol=1e-9)


def test_a_grid_without_lengths_hands_the_plan_back(tmp_path: Path) -> None:
    run = run_of("traffic", "car", tmp_path)
    x = run.task.sample(3, seed=5, dtype=torch.float64)
    plan = run.policy.plan(x)
    grid = PrefixGrid(grid_of(run.task).values, (), 10)
    wanted = StagedSearch(run.task, run.policy, PAPER, grid=grid).search(x, plan)
    with torch.no_grad():
        mine, rho, *_, source, t0 = Guarding(run.task, run.network, grid)(x, plan)
    assert torch.equal(mine, wanted.plans)
    assert torch.equal(rho, wanted.rho)
    assert (source.tolist(), t0.tolist()) == (wanted.source.tolist(), wanted.prefix_length.tolist())
