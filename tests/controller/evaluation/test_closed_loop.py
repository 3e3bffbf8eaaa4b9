"""Drives after a training: they are repeated, and the cheapest guard that does as well is recommended."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stlc.controller.evaluation.closed_loop import LEAST, NEAR, SEED, ClosedLoop, Share, closed_loop
from stlc.controller.policies.policy import BestOfKPolicy
from stlc.controller.problem.task import Task
from stlc.controller.training.budget import simulation_reserve
from stlc.controller.training.config import DRIVES, HELD_OUT_SEED, TrainConfig, resolve_config
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.loop import train
from stlc.controller.training.run import Run
from stlc.dynamics.model.system import System
from stlc.files import read_source
from stlc.grammar.parse.parser import parse
from stlc.registry import METHODS
from stlc.view.learning import Commands, driven_lines, recommended

ROOT = Path(__file__).parents[3]
SMALL = {"test.steps": "30", "test.agents": "4", "test.world": "null"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """An untrained car on short drives."""
    spec = parse(read_source(ROOT / "specs" / "traffic.stl"))
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
    best = first.recommended
    assert best is not None
    assert best.share >= none.share
    for share in first.shares[1:]:
        assert share.compared <= share.runs
        assert share.gained <= share.satisfied


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
    spec = parse(read_source(ROOT / "specs" / "traffic.stl"))
    task = Task.of(spec, System.load(ROOT / "examples" / "car.yaml", {**SMALL, "test.judge": "null"}))
    config = TrainConfig(held_out=50, budget=1.5, clock="processor", drives=4, batch=32, seed=1)
    outcome = train(task, config, open_folder(task, config, Launch(root=tmp_path)))
    record = outcome.run.dir.record()
    assert outcome.simulated is not None
    assert record["result"]["closed_loop"] == outcome.simulated.summary()
    assert driven_lines(record["result"])


def test_nothing_is_driven_where_nobody_wants_it(car_task: Task, tmp_path: Path) -> None:
    config = TrainConfig(held_out=50, steps=3, drives=0, batch=16)
    outcome = train(car_task, config, open_folder(car_task, config, Launch(root=tmp_path)))
    assert outcome.simulated is None
    assert "closed_loop" not in outcome.run.dir.record()["result"]


def test_few_drives_are_compared_with_many() -> None:
    many = Share("none", 5_000, 2_500, None)
    assert Share("full", LEAST - 4, LEAST - 4, None).better_than(many)
    assert not Share("full", LEAST - 4, LEAST // 2, None).better_than(many)


SHARES = st.tuples(*[st.tuples(st.integers(1, DRIVES), st.floats(0, 1)) for _ in range(3)])


@given(SHARES)
def test_the_cheapest_guard_that_does_as_well_is_recommended(drawn: tuple[tuple[int, float], ...]) -> None:
    guards = ("none", "paper", "full")
    shares = tuple(
        Share(guard, count, round(part * count), None)  # type: ignore[arg-type]
        for guard, (count, part) in zip(guards, drawn, strict=True)
    )
    best = ClosedLoop(shares, 10).recommended
    assert best is not None
    assert all(share.share <= best.share + NEAR for share in shares if share.runs >= LEAST)
    assert not any(share.share >= best.share for share in shares[: guards.index(best.guard)])
    low, high = best.interval
    assert low - 1e-9 <= best.share <= high + 1e-9


def test_few_drives_prove_little() -> None:
    shares = (Share("none", 40, 29, 29), Share("paper", 20, 5, 20), Share("full", 5, 5, 5))
    best = ClosedLoop(shares, 10).recommended
    assert best is not None
    assert best.guard == "none"
    shares = (Share("none", 10, 2, 2), Share("paper", 1, 1, 1))
    best = ClosedLoop(shares, 10).recommended
    assert best is not None
    assert best.guard == "paper"
    shares = (Share("none", 20, 0, 0), Share("full", 5, 5, 5))
    best = ClosedLoop(shares, 10).recommended
    assert best is not None
    assert best.guard == "full"


def test_what_is_said_of_drives() -> None:
    shares = (Share("none", 60, 40, 50), Share("paper", 60, 59, 60, compared=60, gained=20, lost=1))
    result = {"closed_loop": ClosedLoop(shares, 10).summary()}
    assert driven_lines(result) == [
        "59 of 60 drives satisfied (98.3 %, 95 % interval 91.1 to 99.7 %) with the paper's guard, "
        "100.0 % safe",
        "40 of 60 drives satisfied (66.7 %, 95 % interval 54.1 to 77.3 %) without a guard, 83.3 % safe",
        "the paper's guard changes 21 of 60 drives: 20 are satisfied only with it, 1 only without",
        "recommended: the paper's guard (`--backup`), by what was driven",
    ]
    assert recommended({"result": result}) == "paper"
    assert driven_lines({}) == []
    (nothing,) = driven_lines({"closed_loop": ClosedLoop((), 10).summary()})
    assert nothing.startswith("not driven: ")
    assert driven_lines({"closed_loop": {"guards": [{"guard": "none"}]}}) == []
    assert recommended({"result": {"closed_loop": {"recommended": "rm -rf"}}}) == "paper"


@pytest.mark.parametrize(
    ("guard", "words"), [("none", ""), ("paper", " --backup"), ("full", " --guard full")]
)
def test_the_next_command_has_the_guard_that_is_recommended(guard: str, words: str) -> None:
    assert Commands.of("x", newest=True, guard=guard).simulate == f"stlc simulate{words}"
    assert Commands.of("x", guard=guard).simulate == f"stlc simulate x{words}"


def test_drives_have_a_share_of_the_budget() -> None:
    for seconds in (5.0, 60.0, 300.0, 3600.0):
        assert 0.08 * seconds <= simulation_reserve(seconds) <= 0.15 * seconds
