"""Training on states of failing drives: rounds, mixing, and resuming."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from stlc.controller.problem.task import Task
from stlc.controller.training.checkpoint import load_checkpoint
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.failures import MIXED, MOMENTS, POINTS, FailureBank, SearchRound
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.learner import Trainer
from stlc.controller.training.loop import Watch, resume, train
from stlc.controller.training.run import Run, spec_hash, system_hash
from stlc.diagnostics import UsageError
from stlc.native import Stop, never
from stlc.registry import METHODS
from stlc.rundir import RunDir

STEPS = 110


class Found:
    """Search that finds 30 initial states a round, and notes how it was called."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, int, int]] = []

    def __call__(
        self, run: Run, decisions: int, seed: int, starts: np.ndarray, stop: Stop
    ) -> SearchRound | None:
        if stop():
            return None
        self.calls.append((decisions, seed, len(starts)))
        generator = torch.Generator().manual_seed(seed)
        states = run.task.sample(30, generator=generator, dtype=torch.float64)
        return SearchRound(states, np.random.default_rng(seed).random((20, 3)), 40, 10)


def _folder(task: Task, root: Path, config: TrainConfig) -> RunDir:
    return open_folder(task, config, Launch(root=root))


def _saved(run: RunDir) -> dict[str, torch.Tensor]:
    return load_checkpoint(run, spec_hash=spec_hash(run), system_hash=system_hash(run)).tensors


def test_kept_states_replace_a_part_of_the_fresh_ones() -> None:
    bank, generator = FailureBank(torch.empty(0, 2)), torch.Generator().manual_seed(0)
    fresh = torch.zeros(40, 2)
    assert torch.equal(bank.mixed(fresh, generator), fresh)
    bank.states = torch.ones(3, 2)
    mixed = bank.mixed(fresh, generator)
    assert (len(mixed), int(mixed[:, 0].sum())) == (40, MIXED * 40)
    assert len(bank.drawn(2, generator)) == 2
    assert len(bank.drawn(9, generator)) == 3


def test_rounds_are_due_at_shares_of_the_planned_steps() -> None:
    bank = FailureBank(torch.empty(0, 1))
    assert not bank.due(99, 1000)
    assert bank.due(int(MOMENTS[0] * 1000), 1000)
    bank.rounds = len(MOMENTS)
    assert not bank.due(1000, 1000)


def test_a_round_that_is_stopped_has_no_effect(car_task: Task) -> None:
    bank = FailureBank(torch.empty(0, len(car_task.system.names)))
    generator = torch.Generator().manual_seed(4)
    before = generator.get_state()
    run: Run = Run(None, car_task, None)  # type: ignore[arg-type]
    assert not bank.search(Found(), run, 100, 512, generator, lambda: True)
    assert torch.equal(generator.get_state(), before)
    assert bank.search(Found(), run, 100, 512, generator, never)
    assert (bank.rounds, bank.last, len(bank.states), bank.latest) == (1, 100, 30, 0.25)
    again = FailureBank(torch.empty(0, len(car_task.system.names)))
    again.restore(bank.tensors())
    assert again.summary() == bank.summary()
    assert np.array_equal(again.points, bank.points)


def test_a_resumed_run_with_rounds_equals_an_uninterrupted_one(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=50, method="guided", steps=STEPS, seed=3, batch=32, drives=0, falsify=True)
    search = Found()
    whole = train(car_task, config, _folder(car_task, tmp_path / "a", config), failures=search)
    assert [starts for _, _, starts in search.calls] == [0, POINTS]
    count: list[bool] = []
    first = _folder(car_task, tmp_path / "b", config)
    watch = Watch(stop=lambda: bool(count.append(True)) or len(count) > 75)
    assert train(car_task, config, first, watch, failures=Found()).interrupted
    resume(first, failures=Found())
    left, right = _saved(whole.run.dir), _saved(first)
    assert left.keys() == right.keys()
    for name, value in left.items():
        assert torch.equal(value, right[name]), name
    assert len(left["failures.states"]) == 60
    assert first.record()["falsification"] == {
        **{"rounds": 2, "drives": 80, "failing": 20, "last_share": 0.25, "states": 60}
    }


def test_every_plan_from_kept_states_is_trained_to_be_safe(car_task: Task) -> None:
    config = resolve_config(car_task, TrainConfig(method="gradient", batch=16, steps=9, falsify=True))
    trainer = Trainer(car_task, config, steps=9, device=torch.device("cpu"))
    assert trainer.safety is not None
    assert [rule.name for rule in trainer.safety.rules] == ["no_collision", "give_way", "red_light"]
    assert trainer.failures is not None
    x0 = car_task.sample(200, generator=torch.Generator().manual_seed(0))
    unsafe = trainer.safety.judge(x0, trainer.network(x0).detach()[:, 0]).rho.argsort(descending=True)
    x0 = x0[unsafe[-16:]]
    plans = trainer.network(x0).detach().requires_grad_()
    assert float(trainer._unsafe(trainer.safety, x0, plans)) == 0.0
    trainer.failures.states = x0[:3]
    trainer._unsafe(trainer.safety, x0, plans).backward()
    moved = plans.grad.abs().sum((1, 2, 3)) > 0.0
    assert not moved[:14].any()
    assert moved[14:].all()  # the last ones are kept states


def test_without_the_option_a_checkpoint_holds_no_such_states(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=20, method="gradient", steps=2, batch=16, drives=0)
    run = train(car_task, config, _folder(car_task, tmp_path, config)).run.dir
    assert not [name for name in _saved(run) if name.startswith("failures")]
    assert "falsification" not in run.record()


def test_methods_without_a_plan_network_refuse(car_task: Task, tmp_path: Path) -> None:
    able = {name for name in METHODS if METHODS.get(name).falsifies}
    assert able == {"guided", "gradient"}
    for method in sorted(set(METHODS) - able - {"plan"}):
        with pytest.raises(UsageError, match="cannot train with `--falsify`"):
            resolve_config(car_task, TrainConfig(method=method, steps=1, falsify=True))
    config = TrainConfig(method="guided", steps=1, falsify=True)
    with pytest.raises(UsageError, match="needs a search"):
        train(car_task, config, _folder(car_task, tmp_path, config))
