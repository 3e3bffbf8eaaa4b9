"""Training away from the processor: every tensor follows the device, and the numbers are the same.

There need be no accelerator: `elsewhere.AWAY` keeps its numbers on the processor and mixes as little with it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.elsewhere import AWAY, Elsewhere, Far

from stlc.controller.problem.task import Task
from stlc.controller.run.checkpoint import load_checkpoint, save_checkpoint
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.learner import Trainer
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[3]
CPU = torch.device("cpu")
OTHERS = [
    ("patrol", "unicycle"),
    ("reach_n_avoid", "maze"),
    ("ship_safe", "ship_safe"),
    ("ship_track", "ship_track"),
    ("navigation", "rover"),
    ("manipulation", "panda"),
]
HASHES = {"spec_hash": "a", "system_hash": "b"}


@pytest.fixture(autouse=True)
def _plain_adam(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fused one asks for the name of the device."""
    plain = torch.optim.Adam
    monkeypatch.setattr("torch.optim.Adam", lambda weights, lr, fused: plain(weights, lr=lr))  # noqa: ARG005


def _trainer(task: Task, device: torch.device) -> Trainer:
    engine = replace(resolve_config(task, TrainConfig(batch=8, seed=1)), pool=32, most=8, hidden=(16,))
    return Trainer(task, engine, steps=8, device=device)


def _trained(trainer: Trainer) -> list[float]:
    seen: list[float] = []
    for _ in range(2):
        look = trainer.validate()
        seen += [look.accuracy, *look.requirements, float(look.repaired), trainer.advance()]
    return seen


@pytest.mark.filterwarnings("ignore:.*copying from a non-meta parameter")
@pytest.mark.parametrize(
    ("spec", "system"),
    [
        pytest.param("traffic", "car", marks=pytest.mark.apart),
        *(pytest.param(*pair, marks=pytest.mark.slow) for pair in OTHERS),
    ],
)
def test_training_elsewhere_gives_the_same(spec: str, system: str, tmp_path: Path) -> None:
    text = Spec.parse(File(ROOT / "specs" / f"{spec}.stl").read())
    task = Task.of(text, System.load(ROOT / "examples" / f"{system}.yaml"))
    here = _trained(_trainer(task, CPU))
    folder = RunDir.create(tmp_path, "far")
    with Elsewhere():
        trainer = _trainer(task, AWAY)
        assert _trained(trainer) == pytest.approx(here, rel=1e-3)
        assert all(isinstance(weight, Far) for weight in trainer.network.state_dict().values())
        save_checkpoint(folder, trainer.tensors(), {**trainer.facts(), **HASHES}, step=trainer.step)
        saved = load_checkpoint(folder, **HASHES)
        again = _trainer(task, AWAY)
        again.restore(saved.tensors, saved.facts)
        ahead = [trainer.advance(), trainer.validate().accuracy]
        assert [again.advance(), again.validate().accuracy] == ahead
    moved = _trainer(task, CPU)
    moved.restore(saved.tensors, saved.facts)
    assert [moved.advance(), moved.validate().accuracy] == pytest.approx(ahead, rel=1e-3)


def test_two_devices_do_not_mix() -> None:
    with Elsewhere():
        there = torch.ones(3, device=AWAY)
        assert (there * 2.0 + torch.tensor(1.0)).cpu().tolist() == [3.0, 3.0, 3.0]
        with pytest.raises(AssertionError, match="two devices"):
            there + torch.ones(3)
        with pytest.raises((TypeError, RuntimeError)):
            there.numpy()
