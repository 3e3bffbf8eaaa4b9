"""Training for whole missions: it begins at plans that a search found, and events happen in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from stlc.cli.framework.app import main
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.controller.run.run import Run
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.learner import STEEPEST, Trainer, _bounded_slopes, _finite_mean
from stlc.controller.training.mission_plans import mission_plans
from stlc.controller.training.samplers import POOL, Missions
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.rundir import RunDir
from stlc.source import Source

LINE = """
stlc: 1
name: line
time: {dt: 0.5 s, horizon: 2 s}
state:
  x: {unit: m, range: [-10, 10]}
  lamp: {bool: true}
control: {v: {unit: m/s, range: [-1, 1]}}
flow: {x: v}
init: {mixture: [{draw: {x: "uniform(-1, 1)", lamp: false}}]}
test:
  steps: 10 s
  agents: 2
  events: [{name: night, every: 3 s, set: {lamp: true}}]
"""
WAY = """
system "line.yaml"
state signal x [m]
state signal lamp : bool
require far: eventually@[0 s, 8 s] x > 5 m
require inside: always[0, T] x < 7 m
"""


@pytest.fixture
def task(tmp_path: Path) -> Task:
    (tmp_path / "line.yaml").write_text(LINE)
    return Task.of(Spec.parse(Source("way.stl", WAY)), System.load(tmp_path / "line.yaml"), whole=True)


def trainer(task: Task) -> Trainer:
    config = resolve_config(task, TrainConfig(seed=0, batch=8, threads=1))
    return Trainer(task, replace(config, pool=64), steps=40, device=torch.device("cpu"))


def test_a_few_plans_satisfy_from_most_starts(task: Task) -> None:
    begun = mission_plans(task, 2, torch.Generator().manual_seed(0))
    assert begun.best.shape == (2, 20, 1)
    x0 = task.sample(50, seed=1)
    each = [TOLERANCE.satisfied(task.judge(x0, one.expand(50, -1, -1)).rho) for one in begun.best]
    assert float((each[0] | each[1]).double().mean()) > 0.8


def test_a_training_begins_with_plans_that_satisfy(task: Task) -> None:
    learner = trainer(task)
    x0 = task.sample(50, seed=1)
    _, judged = learner.policy.plan_judged(x0)
    assert float(TOLERANCE.satisfied(judged.rho).double().mean()) > 0.5, "before the first step"
    assert len(learner.buffer) > 16, "and imitates what is left of all that were found"
    for _ in range(3):
        assert learner.advance() == learner.loss


def test_events_happen_to_the_missions_of_a_training(task: Task) -> None:
    def plans(x: torch.Tensor) -> PlanVerdicts:
        return task.judge(x, torch.zeros(len(x), task.horizon, 1))

    supply = Missions(task, torch.Generator().manual_seed(0), torch.device("cpu"), plans)
    assert len(supply.take(POOL)) == POOL
    clock, lamp = (supply.pool[:, task.system.names.index(name)] for name in ("clock", "lamp"))
    assert bool((clock <= 6).all()), "each mission goes as far as the first event"
    assert torch.equal(lamp > 0.5, clock == 6)
    supply.take(5 * POOL)
    clock, lamp = (supply.pool[:, task.system.names.index(name)] for name in ("clock", "lamp"))
    assert torch.equal(lamp > 0.5, clock >= 6)


def test_no_plan_outweighs_the_others() -> None:
    slopes = torch.ones(5, 1, 3, 1)
    slopes[0], slopes[1, 0, 0] = torch.nan, torch.inf
    slopes[2] *= 1e6
    found = _bounded_slopes(slopes)
    assert bool(torch.isfinite(found).all())
    assert torch.equal(found[3:], slopes[3:])
    assert float(found[2].norm()) == pytest.approx(STEEPEST * 3.0**0.5)
    assert float(_finite_mean(torch.tensor([1.0, torch.inf, 3.0, torch.nan]))) == 2.0
    assert torch.isnan(_finite_mean(torch.tensor([torch.inf])))


@pytest.mark.parametrize(("method", "steps"), [("guided", 20), ("gradient", 4)])
def test_runs_plan_as_far_as_their_method_does(
    method: str, steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "line.yaml").write_text(LINE)
    (tmp_path / "way.stl").write_text(WAY)
    small = ["--steps", "2", "--held-out", "8", "--drives", "0", "--batch", "8", "--no-pictures"]
    assert main(["train", "way.stl", "--method", method, "--name", "r", *small]) == 0
    assert Run.task_in(RunDir.open("latest")).horizon == steps


@pytest.mark.apart
@pytest.mark.parametrize("target", ["c", "onnx"])
def test_exports_propose_what_is_left_at_the_clock(
    target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exports are compared with their runs in states at several times of a mission."""
    pytest.importorskip("onnxruntime" if target == "onnx" else "torch")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "line.yaml").write_text(LINE)
    (tmp_path / "way.stl").write_text(WAY)
    small = ["--steps", "2", "--held-out", "8", "--drives", "0", "--batch", "8", "--no-pictures"]
    assert main(["train", "way.stl", "--name", "r", *small]) == 0
    assert main(["export", "latest", "--to", target]) == 0
    assert "checked in 64 random states" in capsys.readouterr().err
    name = "stlc_controller.h" if target == "c" else "controller.json"
    assert list(tmp_path.glob(f"runs/way/*/export/{target}/{name}"))
