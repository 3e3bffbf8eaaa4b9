"""A budget is planned as steps again and again; what is recorded repeats the run bit for bit."""

from __future__ import annotations

import itertools
import math
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stlc.controller.problem.task import Task
from stlc.controller.run.checkpoint import load_checkpoint
from stlc.controller.training.budget import (
    PROVISIONAL,
    Pace,
    Planned,
    StepSchedule,
    clock_of,
    verdict_reserve,
)
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.loop import Watch, resume, train
from stlc.diagnostics import UsageError
from stlc.rundir import RunDir

EVERY = 50


@dataclass
class Machine:
    """A training on a clock of its own: steps, search rounds, a search beside them, a checkpoint at the end.

    Attributes:
        step_cost: seconds of a gradient step where the machine is idle.
        search: seconds that the search of a round takes beside the steps, by the step of its round.
        slow: how much slower the machine is at a time.
    """

    step_cost: float
    search: Callable[[int], float]
    slow: Callable[[float], float]
    now: float = 0.0
    plannings: list[Planned] = field(default_factory=list)

    def spend(self, seconds: float) -> float:
        before = self.now
        for _ in range(4):
            self.now += 0.25 * seconds * self.slow(self.now)
        return self.now - before

    def wait(self, until: float) -> float:
        before = self.now
        self.now = max(self.now, until)
        return self.now - before

    def train(self, seconds: float) -> float:
        self.spend(1.0)
        pace = Pace(every=EVERY, searching=True, now=self.now, seconds=seconds)
        step, steps, next_validation, found_at, end = 0, PROVISIONAL, EVERY, 0.0, seconds
        while True:
            planned = pace.plan(step, steps, next_validation, end - self.now)
            if planned != steps:
                steps = planned
                self.plannings.append(Planned(step, steps))
            if step >= steps and self.now >= found_at:
                break
            if step >= steps:
                pace.searched(step, self.wait(found_at))
                continue
            if step >= next_validation:
                pace.searched(step, self.wait(found_at))
                pace.validated(step, self.spend(2 * self.step_cost))
                found_at = self.now + self.search(step) * self.slow(self.now)
                next_validation = step + EVERY
            self.spend(self.step_cost)
            step += 1
            pace.stepped(step, self.now, search_runs=self.now < found_at)
        return self.now


STEADY: dict[str, Callable[[float], float]] = {
    "idle": lambda _now: 1.0,
    "busy": lambda _now: 4.0,
    "becomes busy": lambda now: 1.0 if now < 14.0 else 3.0,
    "becomes idle": lambda now: 3.0 if now < 14.0 else 1.0,
    "comes and goes": lambda now: 1.0 + 2.0 * (int(now / 4.0) % 2),
}
SEARCHES: dict[str, Callable[[int], float]] = {
    "none": lambda _step: 0.0,
    "quick": lambda _step: 0.3,
    "slow": lambda _step: 2.0,
    "ever quicker": lambda step: 3.0 * math.exp(-step / 300),
}


@pytest.mark.parametrize("slow", STEADY)
@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("step_cost", [0.004, 0.03])
@pytest.mark.parametrize("seconds", [30.0, 120.0])
def test_a_budget_is_met_whatever_the_machine_does(
    slow: str, search: str, step_cost: float, seconds: float
) -> None:
    machine = Machine(step_cost, SEARCHES[search], STEADY[slow])
    took = machine.train(seconds)
    longest = SEARCHES[search](0) * max(STEADY[slow](0.5 * now) for now in range(60))
    assert took == pytest.approx(seconds, abs=max(0.1 * seconds, 0.75 * longest))


def test_a_steady_machine_is_planned_for_once_or_twice() -> None:
    machine = Machine(0.01, SEARCHES["none"], STEADY["idle"])
    machine.train(30.0)
    assert machine.plannings[0].step <= 11
    assert len(machine.plannings) <= 4


def test_where_no_step_fits_one_is_made() -> None:
    pace = Pace(every=EVERY, searching=True, now=0.0, seconds=1.0)
    assert pace.plan(0, PROVISIONAL, EVERY, -3.0) == 1


def test_a_run_is_left_alone_while_it_is_in_time() -> None:
    pace = Pace(every=EVERY, searching=False, now=0.0, seconds=100.0)
    for step in range(1, 102):
        pace.stepped(step, 0.125 * step, search_runs=False)
    assert pace.per_step == 0.125
    well = 101 + 640
    for left in (80.0, 80.0 * 1.08, 80.0 / 1.08):
        assert pace.plan(101, well, 150, left) == well
    assert pace.plan(101, well, 150, 60.0) == 101 + 480
    assert pace.plan(101, 101 + 480, 150, 59.0) == 101 + 480, "too soon after the last planning"
    assert pace.plan(101, 101 + 480, 150, 50.0) == 101 + 400


def test_irregular_work_is_no_part_of_the_pace() -> None:
    pace = Pace(every=50, searching=False, now=0.0, seconds=100.0)
    for step in range(1, 21):
        pace.stepped(step, 0.5 * step + (30.0 if step > 15 else 0.0), search_runs=False)
        if step == 15:
            pace.irregular(30.0)
    assert pace.per_step == 0.5
    assert pace.plan(20, PROVISIONAL, 10**6, 60.0) == 20 + 120


def test_the_verdict_has_a_share_of_the_budget() -> None:
    for seconds in (5.0, 30.0, 300.0, 3600.0):
        assert 0.02 * seconds <= verdict_reserve(seconds) <= 0.08 * seconds


@given(st.lists(st.tuples(st.integers(0, 400), st.integers(0, 400)), max_size=5), st.integers(1, 10**6))
def test_a_schedule_is_read_as_it_is_written(steps: list[tuple[int, int]], first: int) -> None:
    schedule = StepSchedule.of(first)
    for more, rest in steps:
        last = schedule.plannings[-1]
        step = min(last.step + more, last.steps)
        schedule = schedule.with_steps(step, max(step + rest, 1))
        if not schedule.rounds or step > schedule.rounds[-1].step:
            schedule = schedule.with_round(step, rest)
    assert StepSchedule.parse(str(schedule)) == schedule
    assert schedule.at(0) == [each.steps for each in schedule.plannings if each.step == 0][-1]
    assert schedule.at(10**9) == schedule.steps


@pytest.mark.parametrize(
    "text",
    [
        "",
        "0",
        "-3",
        "12.5",
        "10@3",
        "10,5",
        "10,5@11",
        "10,20@5,30@4",
        "9,3@5",
        "simulations=3@2",
        "10,simulations=3",
        "9,simulations=1@5,simulations=2@4",
        "9,simulations=1@5,simulations=2@5",
        "9,simulations=1@10",
        "9,simulations=100000000@5",
    ],
)
def test_what_is_no_schedule_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"step|schedule"):
        StepSchedule.parse(text)


def test_processor_time_stands_still_while_nothing_is_done() -> None:
    wall, busy = clock_of("wall"), clock_of("processor")
    first = wall(), busy()
    time.sleep(0.1)
    slept = wall() - first[0], busy() - first[1]
    assert slept[0] >= 0.1
    assert slept[1] < 0.05
    while busy() - first[1] < 0.06:
        math.sqrt(2.0)


# ------------------------------------------------------------------ on record

BUDGET = TrainConfig(held_out=50, budget=40.0, seed=3, batch=16, threads=1)


class Ticks:
    """A clock that every look at it moves on: by more, once it has been looked at often enough."""

    def __init__(self) -> None:
        self.count = 0
        self.now = 0.0

    def __call__(self) -> float:
        self.count += 1
        self.now += 0.1 if self.count < 150 else 0.3
        return self.now


TINY = {"pool": 32, "every": 10, "most": 8, "hidden": (8,)}


@pytest.fixture
def ticking(monkeypatch: pytest.MonkeyPatch) -> None:
    from stlc.controller.training import loop as module

    decided = module.resolve_config
    monkeypatch.setattr(module, "resolve_config", lambda task, config: replace(decided(task, config), **TINY))
    monkeypatch.setattr("stlc.controller.training.learner.MARGIN_STATES", 8)
    monkeypatch.setattr(module, "clock_of", lambda _name: Ticks())


def _folder(task: Task, root: Path, config: TrainConfig) -> RunDir:
    return open_folder(task, config, Launch(root=root))


def _saved(folder: RunDir) -> dict[str, torch.Tensor]:
    return load_checkpoint(folder, **folder.hashes).tensors


def _same(left: RunDir, right: RunDir) -> bool:
    one, other = _saved(left), _saved(right)
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.usefixtures("ticking")
def test_the_schedule_on_record_repeats_a_budget(car_task: Task, tmp_path: Path) -> None:
    first = _folder(car_task, tmp_path / "a", BUDGET)
    train(car_task, BUDGET, first)
    record = first.record()
    schedule = StepSchedule.parse(record["schedule"])
    assert len(schedule.plannings) >= 3
    assert record["steps"] == schedule.steps > TINY["every"]
    told = replace(BUDGET, budget=None, steps=schedule)
    again = _folder(car_task, tmp_path / "b", told)
    train(car_task, told, again)
    assert again.record()["schedule"] == record["schedule"]
    assert _same(first, again)
    assert [row["lr"] for row in first.rows()] == [row["lr"] for row in again.rows()]


@pytest.mark.apart
@pytest.mark.usefixtures("ticking")
@pytest.mark.parametrize("stopped_at", [4, pytest.param(30, marks=pytest.mark.slow)])
def test_a_budget_that_was_interrupted_is_repeated_too(
    car_task: Task, tmp_path: Path, stopped_at: int
) -> None:
    """Before the first planning, and between later ones; twice resumed."""
    folder = _folder(car_task, tmp_path / "a", BUDGET)
    for action in (
        lambda watch: train(car_task, BUDGET, folder, watch),
        lambda watch: resume(folder, watch=watch),
    ):
        steps = itertools.count(1)
        assert action(Watch(stop=lambda steps=steps: next(steps) == stopped_at)).interrupted  # type: ignore[misc]
    resume(folder)
    told = replace(BUDGET, budget=None, steps=StepSchedule.parse(folder.record()["schedule"]))
    again = _folder(car_task, tmp_path / "b", told)
    train(car_task, told, again)
    assert _same(folder, again)


@pytest.mark.apart
@pytest.mark.usefixtures("ticking")
def test_a_budget_that_was_interrupted_near_its_end_tells_its_steps(car_task: Task, tmp_path: Path) -> None:
    calls = itertools.count(1)
    whole = _folder(car_task, tmp_path / "a", BUDGET)
    train(car_task, BUDGET, whole, Watch(stop=lambda: next(calls) < 0))
    last = next(calls) - 2
    left = itertools.count(1)
    folder = _folder(car_task, tmp_path / "b", BUDGET)
    assert train(car_task, BUDGET, folder, Watch(stop=lambda: next(left) >= last)).interrupted
    resume(folder)
    assert folder.record()["steps"] == load_checkpoint(folder, **folder.hashes).facts["step"]


@pytest.mark.apart
@pytest.mark.usefixtures("ticking")
def test_a_budget_that_was_killed_before_its_first_checkpoint_is_planned_anew(
    car_task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = _folder(car_task, tmp_path / "a", BUDGET)
    steps = itertools.count(1)
    assert train(car_task, BUDGET, folder, Watch(stop=lambda: next(steps) == 60)).interrupted
    shutil.rmtree(folder.path / "ckpt")
    assert "," in folder.record()["schedule"]
    slower = Ticks()
    slower.count = 150
    monkeypatch.setattr("stlc.controller.training.loop.clock_of", lambda _name: slower)
    resume(folder)
    told = replace(BUDGET, budget=None, steps=StepSchedule.parse(folder.record()["schedule"]))
    again = _folder(car_task, tmp_path / "b", told)
    train(car_task, told, again)
    assert _same(folder, again)


@pytest.mark.apart
@pytest.mark.usefixtures("ticking")
def test_a_run_that_goes_on_past_its_end_is_repeated_too(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=50, drives=0, steps=60, seed=3, batch=16, threads=1)
    folder = _folder(car_task, tmp_path / "a", config)
    train(car_task, config, folder)
    resume(folder, steps=80)
    assert folder.record()["schedule"] == "60,80@60"
    told = replace(config, steps=StepSchedule.parse("60,80@60"))
    again = _folder(car_task, tmp_path / "b", told)
    train(car_task, told, again)
    assert _same(folder, again)


@pytest.mark.usefixtures("ticking")
@pytest.mark.parametrize("more", [{"steps": 80}, pytest.param({"budget": 20.0}, marks=pytest.mark.apart)])
def test_a_continuation_that_is_killed_at_once_still_has_its_steps_to_make(
    more: dict[str, Any], car_task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainConfig(held_out=50, drives=0, steps=60, seed=3, batch=16, threads=1)
    folder = _folder(car_task, tmp_path / "a", config)
    train(car_task, config, folder)
    with monkeypatch.context() as patch:
        patch.setattr("stlc.controller.training.loop._Session.finish", lambda _self: sys.exit(137))
        with pytest.raises(SystemExit):
            resume(folder, **more)
    assert folder.status == "running"
    resume(folder)
    assert (folder.record()["steps"] == 80) if "steps" in more else (folder.record()["steps"] > 60)


@pytest.mark.usefixtures("ticking")
def test_steps_instead_of_a_budget_hold_although_the_continuation_is_killed_at_once(
    car_task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, steps = _folder(car_task, tmp_path, BUDGET), itertools.count(1)
    train(car_task, BUDGET, folder, Watch(stop=lambda: next(steps) == 5))
    with monkeypatch.context() as patch:
        patch.setattr("stlc.controller.training.loop.RunWriter.note", lambda *_: sys.exit(137))
        with pytest.raises(SystemExit):
            resume(folder, steps=8)
    assert resume(folder).steps == 8
    assert folder.record()["seconds_allowed"] is None


@pytest.mark.usefixtures("ticking")
@pytest.mark.parametrize("more", [{"steps": 12}, {"budget": 4.0}])
@pytest.mark.parametrize(
    "config",
    [
        BUDGET,
        pytest.param(replace(BUDGET, steps=StepSchedule.parse("60,20@11,14@12")), marks=pytest.mark.apart),
    ],
)
def test_a_new_length_before_the_first_checkpoint_begins_anew(
    config: TrainConfig, more: dict[str, Any], car_task: Task, tmp_path: Path
) -> None:
    folder, steps = _folder(car_task, tmp_path, config), itertools.count(1)
    train(car_task, config, folder, Watch(stop=lambda: next(steps) == 25))
    shutil.rmtree(folder.path / "ckpt")
    again = itertools.count(1)
    assert resume(folder, **more, watch=Watch(stop=lambda: next(again) == 5)).interrupted
    begun = StepSchedule.parse(folder.record()["schedule"])
    assert begun.at(0) == more.get("steps", PROVISIONAL)
    resume(folder)
    assert folder.record()["steps"] == StepSchedule.parse(folder.record()["schedule"]).steps


@pytest.mark.usefixtures("ticking")
def test_a_schedule_that_is_followed_again_can_be_changed_on_the_way(car_task: Task, tmp_path: Path) -> None:
    """The entries that lie ahead no longer apply; fewer steps than were made are refused."""
    config = replace(BUDGET, budget=None, drives=0, steps=StepSchedule.parse("60,20@11,14@12"))
    folder, steps = _folder(car_task, tmp_path, config), itertools.count(1)
    assert train(car_task, config, folder, Watch(stop=lambda: next(steps) == 5)).interrupted
    before = folder.record()
    with pytest.raises(UsageError, match="has made 5 steps, more than 4") as caught:
        resume(folder, steps=4)
    assert caught.value.diagnostics[0].code == "U101"
    assert folder.record() == before
    assert resume(folder, steps=8).steps == 8
    assert folder.record()["schedule"] == "60,8@5"
    assert resume(folder, steps=9).steps == 9


@pytest.mark.bench
@pytest.mark.parametrize("busy", [0, 4])
@pytest.mark.parametrize("spec", ["traffic", "ship_track", "navigation"])
def test_half_a_minute_is_half_a_minute_on_an_idle_machine_and_on_a_busy_one(
    spec: str, busy: int, tmp_path: Path
) -> None:
    """Within a tenth for what trains and judges; and the whole command ends in time, pictures included."""
    path = Path(__file__).parents[3] / "specs" / f"{spec}.stl"
    words = ["train", str(path), "--budget", "30s", "--runs", str(tmp_path)]
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
    try:
        began = time.monotonic()
        subprocess.run([sys.executable, "-m", "stlc", *words], check=True, capture_output=True)
        whole = time.monotonic() - began
    finally:
        for other in others:
            other.kill()
            other.wait()
    (run,) = RunDir.every(tmp_path)
    assert run.record()["result"]["seconds"] == pytest.approx(30.0, rel=0.1)
    assert whole <= 1.2 * 30.0 + 10.0
