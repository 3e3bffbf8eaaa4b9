"""Searches for failing drives of a policy, and the rounds of a training that use them."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from stlc.assurance.drive_search import EARLIER, WRONG, round_of, search_drives, wrong_states
from stlc.assurance.drive_simulator import DriveSimulator
from stlc.assurance.search_space import SearchSpace
from stlc.cli.framework.app import main
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording
from stlc.controller.run.run import Run
from stlc.native import never

TRAIN = "train specs/cart.stl --steps 1 --batch 16 --held-out 10 --drives 0 --no-pictures -q"


@pytest.fixture(scope="module")
def cart(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder with an untrained run of the tutorial's cart."""
    folder = tmp_path_factory.mktemp("cart")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["init", "-q"]) == 0
        assert main(TRAIN.split()) == 0
        yield folder


@pytest.fixture
def simulator(cart: Path, monkeypatch: pytest.MonkeyPatch) -> DriveSimulator:
    monkeypatch.chdir(cart)
    run = Run.open("latest")
    return DriveSimulator(run, "none", Setting((0,), 3, 6, 1), batch=4)


def test_a_search_makes_as_many_simulations_as_asked_and_repeats(simulator: DriveSimulator) -> None:
    found = search_drives(simulator, 10, seed=5)
    assert found.points.shape == (10, simulator.space.dim)
    assert found.margins.shape == (10, 3, len(simulator.requirements))
    assert found.failing.shape == (10, 3)
    assert found.least == found.margins.min()
    again = search_drives(simulator, 10, seed=5)
    assert np.array_equal(again.margins, found.margins)
    assert np.array_equal(found.worst(1)[0], found.points[found.values.argmin()])
    first = search_drives(simulator, 6, seed=1, starts=found.worst(2))
    assert np.array_equal(first.points[:2], found.worst(2))
    for requirement in range(len(simulator.requirements)):
        alone = simulator.simulate(found.points[3:4], requirement).margins
        assert alone[0] == pytest.approx(found.margins[3].min(0)[requirement], abs=1e-5)  # but for rounding


class _Bowls:
    """Stand-in for drives: two requirements, each the distance from an own corner of three coordinates."""

    space = SearchSpace(200, sparse=True)
    batch = 16

    def drive(self, points: np.ndarray, _watch: object = None) -> np.ndarray:
        return points

    def judge(self, points: np.ndarray) -> SimpleNamespace:
        low, high = points[:, 10:13], 100.0 * (1.0 - points[:, 20:23])
        return SimpleNamespace(margins=np.stack([low.mean(1) - 0.02, high.mean(1) - 2.0], 1)[:, None])


@pytest.mark.parametrize("seed", [101, 102, 103])
def test_a_search_finds_failures_of_several_requirements(seed: int) -> None:
    bowls = cast("DriveSimulator", _Bowls())
    assert not search_drives(bowls, 1000, seed=seed, random=True).failing.any()
    searched = search_drives(bowls, 1000, seed=seed)
    assert searched.failing.sum() > 50
    assert (searched.margins.min((0, 1)) < 0.0).all()


def test_numbers_without_a_coordinate_differ_between_points(simulator: DriveSimulator) -> None:
    points = np.full((2, simulator.space.dim), 0.5)
    points[1, -1] = 0.25  # the seed of the numbers that have no coordinate
    seeds = simulator._at(points).seeds
    assert seeds == (2**30, 2**29)
    assert simulator.space.sparse


def test_a_search_that_ends_early_is_repeated_by_one_of_as_many_simulations(
    simulator: DriveSimulator,
) -> None:
    asked: list[bool] = []
    early = search_drives(simulator, 100, seed=5, over=lambda: bool(asked.append(True)) or len(asked) == 2)
    assert len(early.points) == 2 * simulator.batch
    again = search_drives(simulator, len(early.points), seed=5)
    assert np.array_equal(again.points, early.points)
    assert np.array_equal(again.values, early.values)
    least = search_drives(simulator, 100, seed=5, over=lambda: True)
    assert len(least.points) == simulator.batch


def test_a_round_returns_states_of_the_system(simulator: DriveSimulator) -> None:
    found = round_of(simulator.run, 2, 3, np.zeros((0, 0)), never, never)
    assert found is not None
    assert found.states.shape[1] == len(simulator.run.task.system.names)
    assert 0 <= found.failing <= found.drives
    assert len(found.points) == 2
    assert found.drives == 2 * simulator.run.task.system.decl.test.agents
    assert round_of(simulator.run, 2, 3, np.zeros((0, 0)), never, lambda: True) is None


@pytest.mark.apart
def test_a_round_ends_after_a_batch_and_begins_with_few_points_of_others(simulator: DriveSimulator) -> None:
    seen: list[np.ndarray] = []
    drive = DriveSimulator.drive

    def noted(self: DriveSimulator, points: np.ndarray, watch: object = None) -> DeploymentRecording:
        seen.append(points)
        return drive(self, points, watch)  # type: ignore[arg-type]

    any_round = round_of(simulator.run, 2, 3, np.zeros((0, 0)), never, never)
    assert any_round is not None
    starts = np.full((8, any_round.points.shape[1]), 0.5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DriveSimulator, "drive", noted)
        few = round_of(simulator.run, 3, 3, starts, never, never)
        assert few is not None
        assert len(few.points) == 3
        assert (few.points == 0.5).all(1).sum() == 1
        ended = round_of(simulator.run, 100, 3, starts, lambda: True, never)
    assert ended is not None
    assert len(ended.points) == len(seen[-1]) < 100
    assert (ended.points == 0.5).all(1).sum() == min(len(seen[-1]) // 2, len(starts))


def test_states_of_wrong_decisions_and_some_before_them() -> None:
    rho = np.ones((3, 40))
    rho[0, 20:] = -1.0  # a failing drive
    rho[1, 30:] = -1.0  # another drive
    states = np.arange(3 * 41, dtype=float).reshape(3, 41, 1)
    blank = np.zeros((3, 40))
    recording = DeploymentRecording(
        *(1, states, blank[..., None], blank.astype(int), blank.astype(int), rho, rho, rho > 0),
        progress=(),
        units={},
        scene={},
    )
    kept = wrong_states(recording, np.array([True, False, True]), 1)[:, 0]
    assert kept.tolist() == [
        *range(20 - EARLIER, 20 + WRONG),
        *range(41 + 30, 41 + 30 + WRONG // 4),
    ]
    every_fourth = wrong_states(recording, np.array([True, False, True]), 4)[:, 0]
    assert set(every_fourth[:EARLIER].tolist()) == {8.0, 12.0, 16.0}


@pytest.mark.apart
@pytest.mark.parametrize("guard", ["none", "full"])
def test_a_counterexample_of_a_drive_is_replayed_checked_and_plotted(
    cart: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], guard: str
) -> None:
    monkeypatch.chdir(cart)
    search = f"falsify latest --guard {guard} --agents 2 --steps 30 --simulations 12 -o {guard} --json"
    code = main(search.split())
    document = json.loads(capsys.readouterr().out)
    violated = [each for each in document["result"]["requirements"] if each["verdict"] == "violated"]
    assert code == int(bool(violated))
    if guard == "none":
        assert violated  # an untrained policy fails
    for each in violated:
        words = shlex.split(each["replay"])[1:]
        assert "latest" not in words  # which may be another run later
        assert main(words) == 1
        assert "bit for bit" in capsys.readouterr().out
        trace = str(Path(each["file"]).with_suffix(".npz"))
        assert main(["check", trace, "--require", each["name"]]) == 1
        assert main(["plot", trace, "-o", "drive.png"]) == 0


@pytest.mark.apart
def test_a_training_with_falsification_notes_its_rounds(
    cart: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(cart)
    train = TRAIN.replace("--steps 1 ", "--steps 52 ").replace(" -q", " --json")
    assert main([*train.split(), "--falsify", "--name", "hard"]) in (0, 1)
    found = json.loads(capsys.readouterr().out)["result"]["falsification"]
    assert found["rounds"] == 1
    assert found["drives"] > 0
    assert Run.open("hard").policy is not None
