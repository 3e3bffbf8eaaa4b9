"""Systems without controls: judged from their initial states, and refused where something is to be chosen."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import stlc
from stlc.cli.framework.app import main
from stlc.controller.problem.task import Task
from stlc.controller.search.feasibility import solve
from stlc.controller.search.planner import PlanBudget, plan, planner_named
from stlc.controller.search.planner_policy import PlannerPolicy
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.loop import train
from stlc.diagnostics import UsageError
from stlc.dynamics.load import load_system_decl
from stlc.dynamics.system import System
from stlc.rundir import RunDir

SYSTEM = """
stlc: 1
name: fall
time: {dt: 0.1 s, horizon: 10 steps}
state: {x: {unit: m}, v: {unit: m/s}}
flow: {x: v, v: -9.8 m/s^2}
init: {mixture: [{draw: {x: "uniform(3, 6)", v: 0}}]}
"""
SPEC = 'system "fall.yaml"\nstate signal x [m]\nrequire r: always x > 0 m\n'


@pytest.fixture
def task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Task:
    (tmp_path / "fall.yaml").write_text(SYSTEM)
    (tmp_path / "fall.stl").write_text(SPEC)
    monkeypatch.chdir(tmp_path)
    return Task.of(stlc.parse(SPEC), System(load_system_decl("fall.yaml")))


def test_verdicts_in_c_and_torch(task: Task) -> None:
    x0 = task.sample(40, seed=0, dtype=torch.float64)
    nothing = torch.zeros(40, 10, 0, dtype=torch.float64)
    wanted = x0[:, 0] - 9.8 * 0.01 * 45  # Euler: 0 + 1 + … + 9 times dt^2
    assert task.native is not None
    torch.testing.assert_close(task.judge(x0, nothing).rho, wanted)
    torch.testing.assert_close(task._judged_by_torch(x0, nothing)[0][:, 0], wanted)
    torch.testing.assert_close(task.rollout(x0, nothing), task.system.rollout(x0, nothing))


@pytest.mark.parametrize("method", ["search", "schedule"])
def test_planners_judge_the_only_plan(task: Task, method: str) -> None:
    x0 = task.sample(20, seed=1, dtype=torch.float64)
    rho = task.judge(x0, torch.zeros(20, 10, 0, dtype=torch.float64)).rho
    found = plan(task, x0, method)
    torch.testing.assert_close(found.rho, rho)
    assert found.plans.shape == (20, 10, 0)
    assert found.evaluations.tolist() == [1] * 20
    torch.testing.assert_close(solve(task, x0).rho, rho)
    policy = PlannerPolicy(task, planner_named(method), PlanBudget(0.001))
    assert policy.plan(x0).shape == policy.continuation(x0).shape == (20, 10, 0)


def test_training_is_refused(task: Task, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="the system `fall` has no control"):
        train(task, TrainConfig(), RunDir(tmp_path))
    assert main(["train", "fall.stl", "--steps", "2"]) == 2
    assert "a policy has nothing to choose" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_commands(task: Task, capsys: pytest.CaptureFixture[str]) -> None:
    assert task.system.decl.controls == ()
    assert main(["system", "check", "fall.yaml"]) == 0
    assert "2 states, 0 controls" in capsys.readouterr().out
    assert main(["plan", "fall.stl", "--starts", "20", "--fail-under", "0"]) == 0
    assert main(["check", "fall.stl", "plan.npz"]) == 1
    capsys.readouterr()
    options = "--method search --seeds 0 --agents 3 --steps 5 --no-pictures --fail-under 0"
    drive = ["simulate", "fall.stl", *options.split()]
    assert main(drive) == 0
    assert main([*drive, "--guard", "full"]) == 2
    assert "a guard has nothing to choose" in capsys.readouterr().err
