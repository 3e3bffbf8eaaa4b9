"""Training on states of failing drives: rounds, mixing, and resuming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from stlc.controller.problem.task import Task
from stlc.controller.run.checkpoint import load_checkpoint
from stlc.controller.run.run import Run
from stlc.controller.training import loop
from stlc.controller.training.budget import StepSchedule
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.failures import MIXED, MOMENTS, POINTS, SHARE, FailureStates, SearchRound
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.learner import Trainer
from stlc.controller.training.loop import Watch, resume, train
from stlc.diagnostics import UsageError
from stlc.native import Stop
from stlc.registry import METHODS
from stlc.rundir import RunDir

STEPS = 110


class Found:
    """Search that finds 10 initial states a simulation, and notes how it was called."""

    def __init__(self, batch: int = 10**6) -> None:
        self.batch, self.calls = batch, list[tuple[int, int, int]]()

    def __call__(
        self, run: Run, simulations: int, seed: int, starts: np.ndarray, over: Stop, stop: Stop
    ) -> SearchRound | None:
        if stop():
            return None
        self.calls.append((simulations, seed, len(starts)))
        generator = torch.Generator().manual_seed(seed)
        made = min(self.batch, simulations) if over() else simulations
        states = run.task.sample(10 * made, generator=generator, dtype=torch.float64)
        return SearchRound(states, np.random.default_rng(seed).random((made, 3)), 20 * made, 5 * made)


def _folder(task: Task, root: Path, config: TrainConfig) -> RunDir:
    return open_folder(task, config, Launch(root=root))


def _saved(run: RunDir) -> dict[str, torch.Tensor]:
    return load_checkpoint(run, **run.hashes).tensors


def test_kept_states_replace_a_part_of_the_fresh_ones() -> None:
    known, generator = FailureStates(torch.empty(0, 2)), torch.Generator().manual_seed(0)
    fresh = torch.zeros(40, 2)
    assert torch.equal(known.mixed(fresh, generator), fresh)
    known.states = torch.ones(3, 2)
    mixed = known.mixed(fresh, generator)
    assert (len(mixed), int(mixed[:, 0].sum())) == (40, MIXED * 40)
    assert len(known.drawn(2, generator)) == 2
    assert len(known.drawn(9, generator)) == 3


def test_rounds_are_due_at_shares_of_the_planned_steps() -> None:
    known = FailureStates(torch.empty(0, 1))
    assert not known.due(99, 1000)
    assert known.due(int(MOMENTS[0] * 1000), 1000)
    known.moment = len(MOMENTS)
    assert not known.due(1000, 1000)


def test_a_round_that_is_stopped_has_no_effect(car_task: Task) -> None:
    known = FailureStates(torch.empty(0, len(car_task.system.names)))
    generator = torch.Generator().manual_seed(4)
    before = generator.get_state()
    run: Run = Run(None, car_task, None)  # type: ignore[arg-type]
    assert known.search(Found(), run, 100, 3, generator, stop=lambda: True) is None
    assert torch.equal(generator.get_state(), before)
    assert known.search(Found(), run, 90, 0, generator) == 0
    assert torch.equal(generator.get_state(), before)
    assert (known.moment, known.rounds, known.last) == (1, 0, 0)
    assert known.search(Found(), run, 100, 3, generator) == 3
    assert (known.moment, known.rounds, known.last, len(known.states), known.latest) == (2, 1, 100, 30, 0.25)
    again = FailureStates(torch.empty(0, len(car_task.system.names)))
    again.restore(known.tensors())
    assert (again.summary(), again.moment) == (known.summary(), 2)
    assert np.array_equal(again.points, known.points)


def test_a_round_grows_with_the_steps_since_the_one_before(car_task: Task) -> None:
    known = FailureStates(torch.empty(0, 1))
    run: Run = Run(None, car_task, None)  # type: ignore[arg-type]
    test = car_task.system.decl.test
    least = known.simulations(run, 1, 1)
    assert least == max(round(500 * test.replan / (test.agents * test.steps)), 2)
    many = known.simulations(run, 1000, 640)
    assert many == pytest.approx(0.06 * 1000 * 640 * test.replan / (test.agents * test.steps), abs=1.0)
    known.last = 500
    assert known.simulations(run, 1000, 640) == pytest.approx(many / 2, abs=1.0)


@pytest.mark.apart
def test_a_resumed_run_with_rounds_equals_an_uninterrupted_one(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=50, method="guided", steps=STEPS, seed=3, batch=32, drives=0, falsify=True)
    search = Found()
    whole = train(car_task, config, _folder(car_task, tmp_path / "a", config), failures=search)
    assert [starts for _, _, starts in search.calls] == [0, min(POINTS, search.calls[0][0])]
    count: list[bool] = []
    first = _folder(car_task, tmp_path / "b", config)
    watch = Watch(stop=lambda: bool(count.append(True)) or len(count) > 75)
    assert train(car_task, config, first, watch, failures=Found()).interrupted
    resume(first, failures=Found())
    left, right = _saved(whole.run.dir), _saved(first)
    assert left.keys() == right.keys()
    for name, value in left.items():
        assert torch.equal(value, right[name]), name
    made = sum(simulations for simulations, _, _ in search.calls)
    assert len(left["failures.states"]) == 10 * made
    assert first.record()["falsification"] == {
        **{"rounds": 2, "drives": 20 * made, "failing": 5 * made, "last_share": 0.25, "states": 10 * made}
    }
    assert first.record()["schedule"] == whole.run.dir.record()["schedule"]
    rounds = StepSchedule.parse(first.record()["schedule"]).rounds
    assert [each.simulations for each in rounds] == [simulations for simulations, _, _ in search.calls]


class Clock:
    """Clock that advances whenever it is read."""

    def __init__(self) -> None:
        self.time = 0.0

    def __call__(self) -> float:
        self.time += 0.05
        return self.time


@pytest.mark.parametrize(
    "interrupted", [pytest.param(True, marks=pytest.mark.apart), pytest.param(False, marks=pytest.mark.slow)]
)
def test_rounds_take_a_share_of_a_budget_and_the_record_repeats_them(
    car_task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interrupted: bool
) -> None:
    clock = Clock()

    class Slow(Found):
        def __call__(self, *given: object) -> SearchRound | None:
            clock.time += 10.0
            return super().__call__(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(loop, "clock_of", lambda _name: clock)
    config = TrainConfig(
        **{"held_out": 50, "method": "guided", "budget": 40.0, "seed": 3, "batch": 32, "drives": 0},
        falsify=True,
    )
    search, once = Slow(batch=1), iter([interrupted])
    watch = Watch(stop=lambda: bool(search.calls) and next(once, False))
    first = _folder(car_task, tmp_path / "a", config)
    assert train(car_task, config, first, watch, failures=search).interrupted == interrupted
    if interrupted:
        resume(first, failures=search)
    schedule = StepSchedule.parse(first.record()["schedule"])
    rounds = [each.simulations for each in schedule.rounds]
    assert 0 in rounds
    assert 1 <= len([each for each in rounds if each]) == len(search.calls) < len(MOMENTS)
    assert clock.time * SHARE + 10.0 >= 10.0 * len(search.calls)
    told = replace(config, budget=None, steps=schedule)
    again = Found()
    second = train(car_task, told, _folder(car_task, tmp_path / "b", told), failures=again).run.dir
    assert [simulations for simulations, _, _ in again.calls] == [each for each in rounds if each]
    assert second.record()["schedule"] == first.record()["schedule"]
    left, right = _saved(first), _saved(second)
    for name, value in left.items():
        assert torch.equal(value, right[name]), name


@pytest.mark.apart
def test_an_interruption_right_after_a_round_is_repeated_by_the_record(
    car_task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the validation that follows, with more moments between two validations; then more steps."""
    monkeypatch.setattr(Trainer, "explore", lambda _self, stop: not stop())
    config = TrainConfig(held_out=20, method="guided", steps=60, seed=3, batch=16, drives=0, falsify=True)
    first = _folder(car_task, tmp_path / "a", config)
    search, once = Found(), iter([True])
    watch = Watch(stop=lambda: bool(search.calls) and next(once, False))
    assert train(car_task, config, first, watch, failures=search).interrupted
    resume(first, steps=80, failures=search)
    schedule = StepSchedule.parse(first.record()["schedule"])
    assert [each.step for each in schedule.rounds] == [50]
    told = replace(config, steps=schedule)
    second = _folder(car_task, tmp_path / "b", told)
    train(car_task, told, second, failures=Found())
    assert second.record()["schedule"] == first.record()["schedule"]
    left, right = _saved(first), _saved(second)
    for name, value in left.items():
        assert torch.equal(value, right[name]), name


def test_the_rounds_of_a_schedule_are_made_at_its_steps(
    car_task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decided = loop.resolve_config
    monkeypatch.setattr(loop, "resolve_config", lambda task, config: replace(decided(task, config), every=10))
    schedule = StepSchedule.parse("60,simulations=7@50")
    config = TrainConfig(
        **{"held_out": 20, "method": "guided", "steps": schedule, "seed": 3, "batch": 16, "drives": 0},
        falsify=True,
    )
    search = Found()
    run = train(car_task, config, _folder(car_task, tmp_path / "a", config), failures=search).run.dir
    assert [simulations for simulations, _, _ in search.calls] == [7]
    moment, rounds, last, *_ = _saved(run)["failures.counts"].tolist()
    assert (moment, rounds, last) == (1, 1, 50)
    plain = replace(config, falsify=False)
    with pytest.raises(UsageError, match="rounds of falsification"):
        _folder(car_task, tmp_path / "b", plain)
    assert not (tmp_path / "b").exists()  # no run is left behind


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


def test_methods_without_a_plan_network_refuse(
    car_task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert {name for name in METHODS if METHODS.get(name).falsifies} == {"guided", "gradient"}
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "data/toy"))
    for method in ("plan", "coasting"):
        with pytest.raises(UsageError, match="cannot train with `--falsify`"):
            resolve_config(car_task, TrainConfig(method=method, steps=1, falsify=True))
    config = TrainConfig(method="guided", steps=1, falsify=True)
    with pytest.raises(UsageError, match="needs a search"):
        train(car_task, config, _folder(car_task, tmp_path, config))
