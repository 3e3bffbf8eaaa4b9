"""Simulations shared out among worker processes, of this machine or of a Ray cluster.

Every worker loads the simulator once. The points of a search are cut into parts whose size depends on nothing
but the simulator, so that the outcomes are the same however many workers there are.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import Point, SearchSpace
from stlc.assurance.simulation import Simulations, Simulator, SimulatorSource
from stlc.controller.parallel.workers import NO_FILES, CallFiles, CallWorkers, LostCall

if TYPE_CHECKING:
    from stlc.assurance.plant_simulator import FailedSimulation

Argument = TypeVar("Argument")
Result = TypeVar("Result")


class SimulatorWorkers:
    """Worker processes that each hold the same simulator, as a context.

    Attributes:
        count: number of workers when the context was entered.
        findings: failed simulations of black boxes in the workers.
        lost: number of simulations that were lost with their workers, each time that they were tried.
        reasons: causes of the losses, each once.
    """

    def __init__(self, source: SimulatorSource, calls: CallWorkers, files: CallFiles = NO_FILES) -> None:
        """Use workers that make calls.

        Args:
            source: the simulator.
            calls: the workers; local ones must be `fresh`, since this process has used PyTorch.
            files: files that loading the simulator reads.
        """
        self._source, self._calls, self._files = source, calls, files
        self.count = 1
        self.findings: list[FailedSimulation] = []
        self.lost = 0
        self.reasons: dict[str, None] = {}

    def __enter__(self) -> Self:
        """Start the workers."""
        self._calls.__enter__()
        self.count = self._calls.size
        return self

    def __exit__(self, *raised: object) -> None:
        """End the workers."""
        self._calls.__exit__(*raised)

    def run(
        self, task: Callable[[Simulator, Argument], Result], arguments: Sequence[Argument]
    ) -> Iterator[Result | LostCall]:
        """Call `task`, a function of a module, for each argument; yield the results in order."""
        orders = [_Order(self._source, task, argument) for argument in arguments]
        ended: dict[int, Any] = {}
        following = 0
        for each in self._calls.results(_call, orders, files=lambda _: self._files):
            ended[each.index] = each.value
            while following in ended:
                found = ended.pop(following)
                following += 1
                if isinstance(found, LostCall):
                    self.reasons[found.reason] = None
                    yield found
                else:
                    self.findings += found.findings
                    yield found.value


@dataclass(frozen=True, slots=True)
class _Order:
    """Call of a task in a worker, and the simulator that it needs."""

    source: SimulatorSource
    task: Callable[[Simulator, Any], Any]
    argument: Any


@dataclass(frozen=True, slots=True)
class _Found:
    """Value of a task, and the simulations of a black box that failed meanwhile."""

    value: Any
    findings: tuple[FailedSimulation, ...]


_loaded: list[tuple[SimulatorSource, Simulator]] = []
"""The simulator of a worker process, and its source."""


def _call(order: _Order) -> _Found:
    """Carry out a task in a worker process, which has one core."""
    if not _loaded or _loaded[0][0] != order.source:
        _loaded[:] = [(order.source, order.source.load())]
        if (torch := sys.modules.get("torch")) is not None:
            torch.set_num_threads(1)
    simulator = _loaded[0][1]
    findings: list[FailedSimulation] = getattr(simulator, "findings", [])
    findings.clear()
    return _Found(order.task(simulator, order.argument), tuple(findings))


@dataclass(frozen=True)
class SharedSimulator:
    """Simulator whose points are shared out among workers.

    A simulation that is lost with its worker counts as one without an admissible initial state.

    Attributes:
        local: the same simulator in this process, for single points and descriptions.
        workers: the processes that simulate; None: this one, part by part.
        points: number of points side by side; None: as many as the simulator prefers, and a part for each
            worker at least.
    """

    local: Simulator
    workers: SimulatorWorkers | None
    points: int | None = None

    @property
    def space(self) -> SearchSpace:
        """The search space."""
        return self.local.space

    @property
    def requirements(self) -> Sequence[str]:
        """Names of the requirements."""
        return self.local.requirements

    @property
    def part(self) -> int:
        """Number of points of a part."""
        return self.local.part

    @property
    def batch(self) -> int:
        """Number of points side by side."""
        count = 1 if self.workers is None else self.workers.count
        return self.points or max(self.local.batch, self.part * count)

    def seen(self, requirement: int) -> float:
        """Share of the inputs' duration, at most 1, after which inputs no longer affect a requirement."""
        return self.local.seen(requirement)

    def graded(self, requirement: int) -> bool:
        """True if the robustness varies with real signals, rather than with whole numbers."""
        return self.local.graded(requirement)

    def simulate(self, points: NDArray[np.float64], requirement: int) -> Simulations:
        """Simulate `points`, (count, dim), in equal parts, and judge them by a requirement."""
        parts = [points[first : first + self.part] for first in range(0, len(points), self.part)]
        if self.workers is None or len(points) == 1:
            return Simulations.joined([self.local.simulate(part, requirement) for part in parts])
        found = self.workers.run(_simulated, [_Part(part, requirement) for part in parts])
        whole = []
        for part, each in zip(parts, found, strict=True):
            if isinstance(each, LostCall):
                self.workers.lost += len(part)
                outside = np.zeros(len(part), dtype=np.bool_)
                whole.append(Simulations(np.full(len(part), np.inf), outside, outside))
            else:
                whole.append(each)
        return Simulations.joined(whole)

    def at_half_step(self, points: NDArray[np.float64], requirement: int) -> Simulations | None:
        """Outcomes at half the time step; None if the step cannot be changed."""
        return self.local.at_half_step(points, requirement)

    def gradient(self, point: Point, requirement: int) -> Point | None:
        """Gradient of the exact robustness at a point, (dim,); None if there is none."""
        return self.local.gradient(point, requirement)


@dataclass(frozen=True, slots=True)
class _Part:
    """Points, (count, dim), as they are sent to a worker, and the requirement that judges them."""

    points: NDArray[np.float64]
    requirement: int


def _simulated(simulator: Simulator, part: _Part) -> Simulations:
    return simulator.simulate(part.points, part.requirement)
