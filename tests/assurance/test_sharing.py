"""Simulations shared out among processes, some of which are lost."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from stlc.assurance.falsify import Falsification, SearchBudget, SearchOrder, falsify_each
from stlc.assurance.search_space import Point, SearchSpace
from stlc.assurance.sharing import SharedSimulator, SimulatorWorkers
from stlc.assurance.simulation import Simulations
from stlc.controller.parallel.workers import LocalProcesses

pytestmark = pytest.mark.apart


@dataclass(frozen=True)
class Bowl:
    """Robustness that is least in the middle of the unit square; a corner of it ends the process.

    Attributes:
        marks: folder where each ended process leaves a file.
        deaths: number of processes that end; none in the process that tests.
        batch: number of points that are best simulated side by side.
    """

    marks: Path
    deaths: int = 0
    batch: int = 1
    home: int = os.getpid()

    @property
    def space(self) -> SearchSpace:
        return SearchSpace(2, ())

    @property
    def part(self) -> int:
        return max(self.batch // 4, 1)

    @property
    def requirements(self) -> tuple[str, ...]:
        return ("centre", "edge", "none")

    def load(self) -> Bowl:
        return self

    def seen(self, requirement: int) -> float:  # noqa: ARG002
        return 1.0

    def graded(self, requirement: int) -> bool:  # noqa: ARG002
        return True

    def gradient(self, point: Point, requirement: int) -> Point | None:  # noqa: ARG002
        return None

    def simulate(self, points: NDArray[np.float64], requirement: int) -> Simulations:
        assert len(points) <= max(self.batch, 1)
        if os.getpid() != self.home and (points.min(1) > 0.8).any():
            self.end()
        away = np.abs(points - 0.5).max(1)
        margins = np.stack([away - 1e-3, 0.499 - away, away + 1.0], 1)[:, requirement]
        every = np.ones(len(points), dtype=np.bool_)
        return Simulations(margins, every, every)

    def end(self) -> None:
        """End this process, unless enough have ended."""
        for number in range(self.deaths):
            with suppress(FileExistsError):
                (self.marks / str(number)).touch(exist_ok=False)
                os._exit(3)

    def at_half_step(self, points: NDArray[np.float64], requirement: int) -> Simulations | None:  # noqa: ARG002
        return None


def told(found: Falsification) -> tuple[object, ...]:
    point = None if found.found is None else found.found.point.tolist()
    return (found.requirement, point, found.simulations, found.least, found.strategies, found.rejected)


def searched(
    simulator: Bowl, requirements: tuple[int, ...], processes: int, batch: int | None = 5
) -> tuple[list[tuple[object, ...]], int]:
    """The results of searches, and the number of lost simulations."""
    order = SearchOrder(SearchBudget(60), seed=4, shrinks=False, batch=batch)
    if not processes:
        return [told(each) for each in falsify_each(simulator, requirements, order)], 0
    with SimulatorWorkers(simulator, LocalProcesses(processes)) as workers:
        return [told(each) for each in falsify_each(simulator, requirements, order, workers)], workers.lost


@pytest.mark.parametrize("requirements", [(0,), (2,), (0, 1, 2)])
def test_results_do_not_depend_on_the_processes(requirements: tuple[int, ...], tmp_path: Path) -> None:
    alone = searched(Bowl(tmp_path), requirements, 0)
    for processes in (1, 3):
        assert searched(Bowl(tmp_path), requirements, processes) == alone
    assert searched(Bowl(tmp_path), requirements, 0, batch=6) != alone


@pytest.mark.parametrize("requirements", [(2,), (0, 2)])
def test_processes_that_are_lost_once_or_twice_change_nothing(
    requirements: tuple[int, ...], tmp_path: Path
) -> None:
    alone = searched(Bowl(tmp_path), requirements, 0)
    assert searched(Bowl(tmp_path, deaths=2), requirements, 2) == alone
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("requirements", [(2,), (0, 2)])
def test_simulations_that_always_end_their_process_are_counted(
    requirements: tuple[int, ...], tmp_path: Path
) -> None:
    found, lost = searched(Bowl(tmp_path, deaths=10**6), requirements, 2)
    name, point, simulations, _, _, rejected = found[-1]
    assert (name, point, simulations) == ("none", None, 60)
    assert lost >= rejected > 0  # the first ones are simulated twice
    searches = len(requirements) if len(requirements) > 1 else 0
    assert len(list(tmp_path.iterdir())) == 3 * (lost + searches)


def test_parts_depend_on_the_simulator_only(tmp_path: Path) -> None:
    with SimulatorWorkers(Bowl(tmp_path), LocalProcesses(3)) as workers:
        assert SharedSimulator(Bowl(tmp_path, batch=16), workers).batch == 16
        assert SharedSimulator(Bowl(tmp_path), workers).batch == 3
        assert SharedSimulator(Bowl(tmp_path), workers, 8).batch == 8
    points = np.random.default_rng(0).random((10, 2))
    parts = SharedSimulator(Bowl(tmp_path, batch=16), None).simulate(points, 0)
    whole = Bowl(tmp_path, batch=16).simulate(points, 0)
    assert np.array_equal(parts.margins, whole.margins)
