"""Simulations as a function of points of the unit cube: what a search sees of a system, and who simulates.

A search asks a `Simulator` for the robustness of one requirement at several points. `SharedSimulator` shares
these points out among `Workers`: processes of this machine, or others that offer the same two members.
"""

from __future__ import annotations

import multiprocessing
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import SearchSpace
from stlc.stopping import leaving

Argument = TypeVar("Argument")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Focus:
    """Requirement by which simulations are judged.

    Attributes:
        requirement: its index.
        scales: factors of its predicates in the guidance; None: the guidance is the exact robustness.
        sized: whether the sizes of the margins of its predicates are wanted.
    """

    requirement: int
    scales: tuple[float, ...] | None = None
    sized: bool = False


@dataclass(frozen=True, slots=True)
class Simulations:
    """Outcomes of simulations for one requirement.

    Attributes:
        margins: exact robustness, (count,); -inf where states are not finite.
        guidance: robustness with scaled predicates, (count,), of the same sign.
        admissible: whether the initial state meets the conditions of `where`, (count,).
        sizes: sizes of the margins of the predicates, (count, predicates); no columns if they are not
            wanted, or there is nothing to compare.
    """

    margins: NDArray[np.float64]
    guidance: NDArray[np.float64]
    admissible: NDArray[np.bool_]
    sizes: NDArray[np.float64]

    @classmethod
    def unscaled(cls, margins: NDArray[np.float64], admissible: NDArray[np.bool_]) -> Simulations:
        """Outcomes whose guidance is the exact robustness."""
        return cls(margins, margins, admissible, np.zeros((len(margins), 0)))

    @classmethod
    def joined(cls, parts: Sequence[Simulations]) -> Simulations:
        """The outcomes of all parts, one after the other."""
        return cls(
            np.concatenate([part.margins for part in parts]),
            np.concatenate([part.guidance for part in parts]),
            np.concatenate([part.admissible for part in parts]),
            np.concatenate([part.sizes for part in parts]),
        )


class Simulator(Protocol):
    """Simulations of a closed system, as a function of points in the unit cube.

    The outcome of a point depends on nothing but the point and the focus.
    """

    @property
    def space(self) -> SearchSpace:
        """The search space."""

    @property
    def batch(self) -> int:
        """Number of points that are best simulated side by side."""

    @property
    def requirements(self) -> Sequence[str]:
        """Names of the requirements."""

    def seen(self, requirement: int) -> float:
        """Share of the inputs' duration, at most 1, after which inputs no longer affect a requirement."""

    def simulate(self, points: NDArray[np.float64], focus: Focus) -> Simulations:
        """Simulate and judge `points`, (count, dim)."""

    def at_half_step(self, points: NDArray[np.float64], requirement: int) -> NDArray[np.float64] | None:
        """Margins at half the time step, (count,); None if the step cannot be changed."""


class SimulatorSource(Protocol):
    """Description of a simulator that can be sent to another process."""

    def load(self) -> Simulator:
        """Load the simulator."""


class Workers(Protocol):
    """Processes that each hold the same simulator.

    Attributes:
        count: number of processes.
    """

    count: int

    def run(
        self, task: Callable[[Simulator, Argument], Result], arguments: Sequence[Argument]
    ) -> Iterator[Result]:
        """Call `task`, a function at the top of a module, for each argument; yield the results in order."""


@dataclass(frozen=True)
class SharedSimulator:
    """Simulator whose points are shared out among workers.

    Attributes:
        local: the same simulator in this process, for single points and descriptions.
        workers: the processes that simulate.
    """

    local: Simulator
    workers: Workers

    @property
    def space(self) -> SearchSpace:
        """The search space."""
        return self.local.space

    @property
    def requirements(self) -> Sequence[str]:
        """Names of the requirements."""
        return self.local.requirements

    @property
    def batch(self) -> int:
        """Number of points side by side: at least one for each worker."""
        return max(self.local.batch, self.workers.count)

    def seen(self, requirement: int) -> float:
        """Share of the inputs' duration, at most 1, after which inputs no longer affect a requirement."""
        return self.local.seen(requirement)

    def simulate(self, points: NDArray[np.float64], focus: Focus) -> Simulations:
        """Simulate and judge `points`, (count, dim), in equal parts."""
        if len(points) == 1:
            return self.local.simulate(points, focus)
        parts = [part for part in np.array_split(points, self.workers.count) if len(part)]
        return Simulations.joined(list(self.workers.run(_simulated, [(part, focus) for part in parts])))

    def at_half_step(self, points: NDArray[np.float64], requirement: int) -> NDArray[np.float64] | None:
        """Margins at half the time step, (count,); None if the step cannot be changed."""
        return self.local.at_half_step(points, requirement)


class LocalWorkers:
    """Processes of this machine; `close` or the end of a `with` block ends them."""

    def __init__(self, source: SimulatorSource, count: int) -> None:
        """Use `count` processes that each load the simulator of `source`."""
        self.count = count
        self._pool = ProcessPoolExecutor(
            count, multiprocessing.get_context("spawn"), initializer=_load, initargs=(source,)
        )
        self._close = weakref.finalize(self, self._pool.shutdown, cancel_futures=True)

    def __enter__(self) -> LocalWorkers:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all processes."""
        self._close()

    def run(
        self, task: Callable[[Simulator, Argument], Result], arguments: Sequence[Argument]
    ) -> Iterator[Result]:
        """Call `task`, a function at the top of a module, for each argument; yield the results in order."""
        with leaving(lambda _code: self._kill()):
            try:
                yield from self._pool.map(_call, [task] * len(arguments), arguments)
            except (KeyboardInterrupt, SystemExit):
                self._kill()
                raise

    def _kill(self) -> None:
        for process in list((self._pool._processes or {}).values()):
            process.kill()


_loaded: list[Simulator] = []
"""The simulator of a worker process."""


def _load(source: SimulatorSource) -> None:
    """Load the simulator of a worker process, which has one core."""
    import torch

    torch.set_num_threads(1)
    _loaded[:] = [source.load()]


def _call(task: Callable[[Simulator, Any], Any], argument: Any) -> Any:
    return task(_loaded[0], argument)


def _simulated(simulator: Simulator, order: tuple[NDArray[np.float64], Focus]) -> Simulations:
    return simulator.simulate(*order)
