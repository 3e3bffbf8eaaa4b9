"""The planners of the comparison obey the laws of all planners, and plan through the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from helpers import planner_laws as laws

from stlc.cli.framework.app import main
from stlc.controller.problem.task import Task
from stlc.controller.search.planner import PlanBudget, plan, planner_named
from stlc.diagnostics import UsageError
from stlc.rundir import RunDir
from stlc.trace import Trace

pytestmark = pytest.mark.apart

ROOT = Path(__file__).parents[4]
SMALL = ["--seeds", "0", "--agents", "2", "--steps", "3", "--no-pictures"]


@pytest.fixture(params=["cem", "cma", "gradient", "halving"])
def planner(request: pytest.FixtureRequest) -> str:
    return laws.available(request.param)


def test_plans_are_judged_exactly_and_within_bounds(car_task: Task, planner: str) -> None:
    laws.judges_exactly_and_within_bounds(car_task, planner)


def test_the_nonlinear_program_needs_a_smooth_system(car_task: Task) -> None:
    pytest.importorskip("casadi")
    with pytest.raises(UsageError, match="cannot plan through jumps"):
        laws.planned(car_task, "mpc", car_task.sample(1, seed=3))


def test_the_same_seed_gives_the_same_plans(car_task: Task, planner: str) -> None:
    x0 = car_task.sample(3, seed=5, dtype=torch.float64)
    first, second = (laws.planned(car_task, planner, x0) for _ in range(2))
    assert torch.equal(first.plans, second.plans)


def test_evaluations_are_a_limit(car_task: Task) -> None:
    x0, budget = car_task.sample(2, seed=1, dtype=torch.float64), PlanBudget(5.0, 120, torch.inf)
    most = plan(car_task, x0, "cem", budget=budget, population=50, elites=10)
    assert most.evaluations.tolist() == [120, 120]


def test_no_planner_judges_more_plans_than_allowed(car_task: Task, planner: str) -> None:
    laws.judges_no_more_than_allowed(car_task, planner)


@pytest.mark.parametrize("name", ["cem", "cma", "mpc"])
def test_plans_of_a_single_number(tmp_path: Path, name: str) -> None:
    laws.plans_a_single_number(tmp_path, laws.available(name))


def test_options_are_checked(car_task: Task) -> None:
    assert planner_named("cem", physical="true", population="7") == planner_named(
        "cem", physical=True, population=7
    )
    for wrong in ({"population": 2.5}, {"population": True}, {"physical": 1}, {"over": 3}, {"floor": None}):
        with pytest.raises(UsageError, match="of planner `cem` is"):
            planner_named("cem", **wrong)
    with pytest.raises(UsageError, match="neither `exact` nor `paper`"):
        planner_named("gradient", objective="smooth").prepare(car_task)


@pytest.mark.parametrize("name", ["cem", "cma", "mpc"])
def test_numbers_out_of_their_bounds_are_refused(name: str) -> None:
    laws.refuses_numbers_out_of_bounds(laws.available(name))


@pytest.mark.slow
def test_least_numbers_plan_too(car_task: Task, planner: str) -> None:
    laws.plans_with_least_numbers(car_task, planner)


@pytest.mark.parametrize(("name", "spec"), [("cem", "traffic"), ("cma", "traffic"), ("mpc", "ship_safe")])
def test_a_planner_of_a_file_drives_and_its_run_is_judged(
    name: str, spec: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    laws.available(name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STLC_PLANNERS", "")
    file = str(ROOT / f"benchmarks/methods/planners/{name}.py")
    words = ["simulate", str(ROOT / f"specs/{spec}.stl"), "--method", file, *SMALL]
    assert main([*words, "--json", "--fail-under", "0"]) == 0
    assert json.loads(capsys.readouterr().out)["result"]["steps"] == 3
    run = RunDir.newest()
    assert run.record()["plugins"][name]["source"] == f"the file `{file}`"
    monkeypatch.setenv("STLC_PLANNERS", "")
    assert main(["check", str(run.path / "trace.npz"), "--fail-under", "0"]) == 0
    assert len(next(iter(Trace.load(run.path / "trace.npz").data.values()))) == 2
    capsys.readouterr()
    assert main(["simulate", "latest", *SMALL]) == 3
    assert f"STLC_PLANNERS=benchmarks/methods/planners/{name}.py" in capsys.readouterr().err
