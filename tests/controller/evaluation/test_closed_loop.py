"""Drives after a training: they are repeated, and the cheapest guard that does as well is recommended."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stlc.controller.evaluation.closed_loop import (
    COMPARED,
    LEAST,
    NEAR,
    SEED,
    ClosedLoop,
    Driven,
    Share,
    Violated,
    _Trial,
    closed_loop,
)
from stlc.controller.policies.policy import BestOfKPolicy
from stlc.controller.problem.task import Task
from stlc.controller.run.config import DRIVES, HELD_OUT_SEED
from stlc.controller.run.run import Run
from stlc.controller.training.budget import simulation_reserve
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.loop import train
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.jsontext import plain
from stlc.registry import METHODS
from stlc.view.learning import Commands, driven_lines, recommended

ROOT = Path(__file__).parents[3]
SMALL = {"test.steps": "30", "test.agents": "4", "test.world": "null"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """An untrained car on short drives."""
    spec = Spec.parse(File(ROOT / "specs" / "traffic.stl").read())
    task = Task.of(spec, System.load(ROOT / "examples" / "car.yaml", SMALL))
    config = TrainConfig()
    folder = open_folder(task, config, Launch(root=tmp_path_factory.mktemp("runs")))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        resolved = resolve_config(task, config)
        network = METHODS.get(resolved.method).network(task, resolved)
    return Run(folder, task, BestOfKPolicy(task, network))


def _looks(count: int) -> object:
    """A clock that says that time is left, so many times."""
    left = itertools.count(count, -1)
    return lambda: float(max(next(left), 0))


def test_drives_are_repeated_and_recommended_by_what_they_show(run: Run) -> None:
    first, again = (closed_loop(run, lambda: 1e6, most=4) for _ in range(2))
    assert first == again
    assert first.judge == "driving_rules"
    none = first.shares[0]
    assert none.guard == "none"
    assert 4 <= none.runs <= 8
    assert none.runs % 4 == 0
    assert none.safe is None or none.safe >= none.satisfied
    assert {share.runs for share in first.shares} == {none.runs}
    assert first.recommended is None  # of so few drives nothing follows
    for share in first.shares[1:]:
        assert share.satisfied == none.satisfied + share.gained - share.lost


def test_where_there_is_no_time_nothing_is_driven(run: Run) -> None:
    found = closed_loop(run, lambda: 0.0)
    assert found.shares == ()
    assert found.recommended is None
    assert found.why == ""


def test_a_drive_whose_time_is_over_does_not_count(run: Run) -> None:
    assert closed_loop(run, _looks(12)).shares == ()  # type: ignore[arg-type]


def test_seeds_are_nobody_elses() -> None:
    assert SEED > 10**9
    assert HELD_OUT_SEED < SEED


def test_a_training_reports_its_drives(tmp_path: Path) -> None:
    spec = Spec.parse(File(ROOT / "specs" / "traffic.stl").read())
    task = Task.of(spec, System.load(ROOT / "examples" / "car.yaml", {**SMALL, "test.judge": "null"}))
    config = TrainConfig(held_out=50, budget=0.7, clock="processor", drives=4, batch=32, seed=1)
    outcome = train(task, config, open_folder(task, config, Launch(root=tmp_path)))
    record = outcome.run.dir.record()
    assert outcome.simulated is not None
    assert record["result"]["closed_loop"] == plain(outcome.simulated)
    assert driven_lines(record["result"])


def test_nothing_is_driven_where_nobody_wants_it(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=50, steps=3, drives=0, batch=16)
    outcome = train(car_task, config, open_folder(car_task, config, Launch(root=tmp_path)))
    assert outcome.simulated is None
    assert "closed_loop" not in outcome.run.dir.record()["result"]


SHARES = st.tuples(st.integers(1, DRIVES), st.tuples(*[st.floats(0, 1)] * 3))


@given(SHARES)
def test_the_cheapest_guard_that_does_as_well_is_recommended(drawn: tuple[int, tuple[float, ...]]) -> None:
    count, parts = drawn
    shares = tuple(
        Share(guard, count, round(part * count), None) for guard, part in zip(COMPARED, parts, strict=True)
    )
    best = ClosedLoop(shares, 10).recommended
    assert (best is None) == (count < LEAST)
    if best is not None:
        assert all(share.share <= best.share + NEAR for share in shares)
        cheaper = shares[: COMPARED.index(best.guard)]
        assert not any(share.share >= best.share for share in cheaper)
        low, high = best.interval
        assert low - 1e-9 <= best.share <= high + 1e-9


def trial_of(run: Run, found: dict[str, dict[tuple[int, int], bool]]) -> _Trial:
    trial = _Trial(run, None, lambda: 0.0, DRIVES, SEED)
    for mode, drives in found.items():
        trial.known[mode].found.update({start: Driven(good) for start, good in drives.items()})  # type: ignore[index]
    return trial


STARTS = st.dictionaries(st.tuples(st.integers(0, 5), st.integers(0, 9)), st.booleans(), max_size=60)


@given(STARTS, STARTS, STARTS)
def test_guards_are_counted_and_compared_from_the_same_starts(run: Run, none, paper, full) -> None:
    found = {"none": none, "paper": paper, "full": full}
    trial = trial_of(run, found)
    shares = trial.shares()
    starts = set.intersection(*({*found[share.guard]} for share in shares)) if shares else set()
    assert {share.runs for share in shares} <= {len(starts)}
    assert len(shares) < 2 or len(starts) >= LEAST
    for share in shares:
        own = found[share.guard]
        assert share.satisfied == sum(own[start] for start in starts)
        if "none" in {each.guard for each in shares}:
            assert share.gained == sum(own[start] and not none[start] for start in starts)
            assert share.lost == sum(none[start] and not own[start] for start in starts)
    if all(share.share < 1.0 for share in shares):
        assert {share.guard for share in shares} | {*trial.left_out(shares)} == {*COMPARED}


def test_what_was_driven_from_few_common_starts_is_left_out(run: Run) -> None:
    """Fifteen drives with the guard, twenty without, five in common: they are no comparison."""
    none = {(0, agent): agent < 15 for agent in range(20)}
    paper = {(seed, agent): True for seed in range(3) for agent in range(5)}
    trial = trial_of(run, {"none": none, "paper": paper})
    shares = trial.shares()
    assert [(share.guard, share.runs, share.satisfied) for share in shares] == [("none", 20, 15)]
    result = {"closed_loop": plain(ClosedLoop(shares, 10, left_out=trial.left_out(shares)))}
    assert driven_lines(result)[1:] == [
        "too few drives in the time to compare the paper's guard and the full guard"
    ]


def test_what_is_said_of_drives() -> None:
    violated = Violated("b", 20, 30.25, 30.0), Violated("a", 3, None)
    shares = (
        Share("none", 60, 40, 50, broken=violated),
        Share("paper", 60, 59, 60, gained=20, lost=1, broken=(Violated("a", 1, 2.0),)),
    )
    result = {"closed_loop": plain(ClosedLoop(shares, 10))}
    assert driven_lines(result) == [
        "59 of 60 drives obeyed with the paper's guard: `a` (2 s); "
        "95 % interval 91.1 to 99.7 %, 100.0 % safe",
        "40 of 60 drives obeyed without a guard: `b` (30.2 s), `a` (3 drives); "
        "95 % interval 54.1 to 77.3 %, 83.3 % safe",
        "the paper's guard changes the verdicts of 21 of 60 drives: 20 obey only with it, 1 only without",
        "recommended after these drives: the paper's guard (`stlc simulate --backup`)",
    ]
    assert recommended({"result": result}) == "paper"
    near = (Share("none", 100, 99, None), Share("full", 100, 100, None, gained=1))
    assert driven_lines({"closed_loop": plain(ClosedLoop(near, 10))})[-1] == (
        "recommended after these drives: no guard (`stlc simulate`), the cheapest within 2 % of the best"
    )
    assert driven_lines({}) == []
    (nothing,) = driven_lines({"closed_loop": plain(ClosedLoop((), 10))})
    assert nothing.startswith("not driven: ")
    assert driven_lines({"closed_loop": {"guards": [{"guard": "none"}]}}) == []
    assert recommended({"result": {"closed_loop": {"recommended": "rm -rf"}}}) == "paper"


@pytest.mark.parametrize(
    ("guard", "words"), [("none", ""), ("paper", " --backup"), ("full", " --guard full")]
)
def test_the_next_command_has_the_guard_that_is_recommended(guard: str, words: str) -> None:
    record = {"result": {"closed_loop": {"recommended": guard}}}
    assert Commands.of("x", record, newest=True).simulate == f"stlc simulate{words}"
    assert Commands.of("x", record).simulate == f"stlc simulate x{words}"


def test_drives_have_a_share_of_the_budget() -> None:
    for seconds in (5.0, 60.0, 300.0, 3600.0):
        assert 0.08 * seconds <= simulation_reserve(seconds) <= 0.15 * seconds
