"""The patrol mission: 25 seconds planned 5 at a time, trained, deployed and checked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from stlc.compile.dump import dump
from stlc.controller.deployment.batched import Setting
from stlc.controller.evaluation.deployment import deploy
from stlc.controller.problem.task import Task
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.loop import train
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor

ROOT = Path(__file__).resolve().parents[2]
SPEC = ROOT / "specs" / "patrol.stl"


@pytest.fixture(scope="module")
def task() -> Task:
    return Task.of(Spec.parse(File(SPEC).read()), System.load(ROOT / "examples" / "unicycle.yaml"))


def test_what_became_of_time(task: Task, request: pytest.FixtureRequest) -> None:
    path = ROOT / "tests" / "golden" / "compile" / "patrol.txt"
    if request.config.getoption("--regenerate"):
        path.write_text(dump(task.compiled))
    assert dump(task.compiled) == path.read_text()


def test_the_mission_is_longer_than_the_horizon(task: Task) -> None:
    assert task.compiled.mission == 250
    assert task.horizon == 50
    assert task.system.decl.test.steps >= 250
    assert task.system.names == ("x", "y", "psi", "v", "clock", "stay_at_a", "visit_b", "return_to_dock")


PLACES = {"a": (-4.0, 2.0), "b": (4.0, 3.0), "dock": (0.0, -4.0)}


@pytest.mark.parametrize("there", PLACES)
@pytest.mark.parametrize("here", PLACES)
def test_each_place_can_be_reached_within_the_horizon(task: Task, here: str, there: str) -> None:
    """A turn on the spot, full speed, and back to a halt, at the bounds of the controls."""
    (x, y), goal = PLACES[here], torch.tensor(PLACES[there])
    x0 = torch.tensor([[x, y, 0.0, 0.0, *(timer.initial for timer in task.compiled.timers)]])
    bearing = float(torch.atan2(goal[1] - y, goal[0] - x))
    turning = int(abs(bearing) / 0.2) + 1
    u = torch.zeros(20, 50, 2)
    u[:, :turning, 0] = bearing / (turning * 0.1)
    for drive in range(20):
        u[drive, turning : turning + drive, 1] = 4.0
    x = task.rollout(x0.expand(20, -1), u)
    nearest = (x[..., :2] - goal).norm(dim=2).amin()
    assert float(nearest) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize(("guard", "share"), [("none", 0.95), ("paper", 0.99)])
def test_a_trained_policy_fulfils_the_mission(task: Task, tmp_path: Path, guard: str, share: float) -> None:
    folder = open_folder(task, TrainConfig(), Launch(root=tmp_path / "runs", name="patrol"))
    policy = train(task, TrainConfig(), folder).run.policy
    found = deploy(task, policy, Setting(tuple(range(10)), 10, 260), guard)  # type: ignore[arg-type]
    assert found.metrics["executed"].mean >= share
    states = found.recording.states
    monitor = Monitor(Spec.parse(File(SPEC).read()), dt=0.1, horizon=5)
    verdict = monitor.check({name: states[..., i] for i, name in enumerate(task.system.names)})
    good = np.logical_and.reduce([judgement.holds.all(0) for judgement in verdict.requirements])
    assert good.shape == (100,)
    assert float(good.mean()) >= share
