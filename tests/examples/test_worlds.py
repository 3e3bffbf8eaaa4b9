"""Laws of every world of the examples, whatever happens in it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from stlc.cli.framework.app import main
from stlc.controller.deployment.batched import Setting
from stlc.controller.evaluation.archive import save_trace_of
from stlc.controller.evaluation.deployment import deploy
from stlc.controller.evaluation.metrics import METRICS
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.world import Choosing, world_type
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec

ROOT = Path(__file__).parents[2]
WORLDS = {
    "traffic": "car",
    "ship_safe": "ship_safe",
    "ship_track": "ship_track",
    "ship_track shifted": "ship_track",
    "reach_n_avoid": "maze",
    "navigation": "rover",
    "manipulation": "panda",
}
FREE = [name for name in WORLDS if name != "traffic"]  # agents that do not meet each other
FIRST = "traffic", "reach_n_avoid"


def tried(names: Iterable[str]) -> list[Any]:
    """Names of worlds as parameters; all but the first ones are tried apart."""
    return [pytest.param(name, marks=() if name in FIRST else pytest.mark.apart) for name in names]


class Wild(Policy):
    """Plans of random controls that depend on the state alone."""

    def candidates(self, x0: Tensor) -> Tensor:
        low, high = self.task.system.control_low, self.task.system.control_high
        phase = 7.0 * x0.to(torch.float64).sum(1)[:, None, None] + torch.arange(self.task.horizon)[:, None]
        share = 0.5 + 0.5 * torch.sin(phase + torch.arange(len(low)))
        return (low + share * (high - low)).to(x0.dtype)[:, None]


@pytest.fixture(scope="module", params=tried(WORLDS))
def task(request: pytest.FixtureRequest) -> Task:
    return task_of(request.param)


def task_of(name: str) -> Task:
    spec, _, scenario = name.partition(" ")
    system = System.load(ROOT / "examples" / f"{WORLDS[name]}.yaml", scenario=scenario or None)
    return Task.of(Spec.parse(File(ROOT / "specs" / f"{spec}.stl").read()), system)


def film(task: Task, agents: int, seed: int, steps: int = 40) -> tuple[np.ndarray, Any]:
    """States (steps + 1, agents, n) under wild controls, and the world."""
    world = world_type(task.system.decl)(task.system, agents, torch.Generator().manual_seed(seed))
    x, policy = world.reset(), Wild(task)
    frames = [x]
    for step in range(steps):
        if isinstance(world, Choosing):
            options = world.options()
            assert torch.equal(options[:, 0], x)
            x = world.choose(torch.full((agents,), step % options.shape[1]))
        x = world.advance(x, policy.plan(x)[:, 0])
        frames.append(x)
    return torch.stack(frames).numpy(), world


def test_a_world_is_its_seed(task: Task) -> None:
    (first, one), (second, other), (third, _) = (film(task, 3, seed) for seed in (5, 5, 6))
    assert np.array_equal(first, second)
    assert one.progress() == other.progress()
    assert not np.array_equal(first, third)
    assert np.isfinite(first).all()


@pytest.mark.parametrize("name", tried(FREE))
def test_an_agent_in_a_batch_does_as_it_does_alone(name: str) -> None:
    task = task_of(name)
    (many, _), (few, _) = film(task, 4, 1), film(task, 1, 1)
    assert np.array_equal(many[:, :1], few)
    assert not np.array_equal(many[:, 1], many[:, 0])


def test_a_world_begins_anew(task: Task) -> None:
    world = world_type(task.system.decl)(task.system, 2, torch.Generator().manual_seed(0))
    shapes = {}
    for _ in range(2):
        x = world.reset()
        shapes |= {name: value.shape for name, value in world.snapshot().items()}
        for _ in range(3):
            x = world.advance(x, Wild(task).plan(x)[:, 0])
        later = {name: value.shape for name, value in world.snapshot().items()}
        assert later == shapes
        assert set(world.units()) <= set(world.progress())


def test_an_episode_ends_with_a_trace_that_check_reads(
    task: Task, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    everybody = "stlc.controller.evaluation.executed.search_safe"
    monkeypatch.setattr(everybody, lambda _, x0: torch.ones(len(x0), dtype=torch.bool))
    setting = Setting((0, 1), 2, task.horizon + 4, task.system.decl.test.replan)
    found = deploy(task, Wild(task), setting, "none")
    assert {"plan_accuracy", "executed", "executed_safe", "savable"} <= set(found.metrics)
    assert set(found.metrics) - set(METRICS) >= set(found.recording.progress[0])
    folder = open_folder(task, TrainConfig(steps=1), Launch(root=tmp_path / "runs", name="wild"))
    save_trace_of(Run(folder, task, Wild(task)), found.recording, setting)  # type: ignore[arg-type]
    system = ["--system", str(folder.path / "system.yaml")] if task.system.decl.functions else []
    assert main(["check", str(folder.path / "trace.npz"), *system]) in (0, 1)
    assert "4 traces" in capsys.readouterr().out


def test_a_frame_can_be_drawn(task: Task) -> None:
    figures = pytest.importorskip("matplotlib.figure")
    _, world = film(task, 3, 2, steps=5)
    frame = world.snapshot()
    scene = {name: np.stack([value, value]) for name, value in frame.items()}
    scene["decision"] = np.tile(np.arange(3), (2, 1))
    axes = figures.Figure().add_subplot()
    world.draw(axes, scene, 1)
    assert axes.patches or axes.collections or axes.lines
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    assert right > left
    assert high > low
