"""Falsification: the search for a simulation that violates a requirement.

A counterexample is accepted only if it also violates the requirement at half the time step. A search that
finds none is no proof; its result says which part of the space was searched.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from time import perf_counter
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.portfolio import Portfolio, Proposal
from stlc.assurance.search_space import Point, SearchSpace
from stlc.assurance.sharing import SharedSimulator, SimulatorWorkers
from stlc.assurance.simulation import Simulations, Simulator
from stlc.assurance.strategies import GradientVertices
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.parallel.workers import LostCall
from stlc.jsontext import Num

FALSIFIER_VERSION = 13
"""Version of the search; results of older versions are recomputed."""
CELLS = 4
"""Cells per coordinate of the grid on which pairwise coverage is counted."""
MOST_PAIRED = 40
"""Coordinates at most whose pairs are counted."""
REJECTED = 1000
"""Successive points without an admissible initial state after which a search ends."""
DIGITS = (0, 1, 2, 3)
"""Decimal digits, in the unit cube, to which values of a counterexample are rounded, the fewest first."""
SPLIT = (1, 2, 4, 8, 16)
"""Numbers of parts of a space, most of whose coordinates have no effect, that are shrunk as wholes."""
MOST_SHRUNK = 60
"""Coordinates at most that are shrunk one by one."""


@dataclass(frozen=True, slots=True)
class Counterexample:
    """Simulation that violates a requirement.

    Attributes:
        point: its point in the unit cube, (dim,).
        margin: robustness of the requirement, negative.
        half_step: robustness at half the time step; None if the step cannot be changed.
        strategy: name of the strategy that found it.
        simulation: number of simulations until it was found, itself included.
    """

    JSON: ClassVar = "margin half_step strategy simulation"

    point: Point = field(repr=False)
    margin: Num
    half_step: Num | None
    strategy: str
    simulation: int

    @property
    def spurious(self) -> bool:
        """Satisfaction of the requirement at half the time step."""
        return self.half_step is not None and TOLERANCE.satisfied(self.half_step)


@dataclass(frozen=True, slots=True)
class SearchBudget:
    """Limits of a search: number of simulations, and seconds; None: no limit."""

    simulations: int = 300
    seconds: float | None = None


@dataclass(frozen=True, slots=True)
class Falsification:
    """Result of a search for a violation of one requirement.

    Attributes:
        requirement: its name.
        found: the counterexample; None if there is none.
        shrunk: the same with fewer pieces and rounder numbers, as far as it still violates the requirement.
        spurious: violations that do not survive half the time step.
        simulations: number of simulations.
        inconclusive: number of those without a verdict, because they ended before it or failed: no evidence.
        least: least robustness of all simulations with a verdict.
        coverage: share of the cells, over all pairs of coordinates, that simulations with a verdict fell
            into.
        rejected: number of points whose initial state does not meet the conditions of `where`.
        seconds: time of the search.
        strategies: number of simulations per strategy.
    """

    requirement: str
    found: Counterexample | None
    shrunk: Counterexample | None
    spurious: tuple[Counterexample, ...]
    simulations: int
    inconclusive: int
    least: Num
    coverage: float
    rejected: int
    seconds: float
    strategies: dict[str, int]


class ViolationSearch:
    """A search for a violation of one requirement, as a dialogue: points are asked for, outcomes are told.

    Attributes:
        requirement: index of the requirement that judges the points.
        found: the counterexample; None until there is one.
        tried: number of simulations.
        inconclusive: number of those without a verdict.
        least: least robustness of all simulations with a verdict.
    """

    def __init__(
        self,
        simulator: Simulator,
        requirement: int,
        seed: int,
        *,
        random: bool = False,
        without: Collection[str] = (),
    ) -> None:
        """Begin a search; arguments as of `falsify`, and names of strategies that have no turns."""
        self._simulator, self.requirement = simulator, requirement
        self._part = simulator.space.visible(simulator.seen(requirement))
        generator, graded = np.random.default_rng(seed), simulator.graded(requirement)
        self._portfolio = Portfolio(
            self._part.space, generator, self._gradient, random=random, graded=graded, without=without
        )
        self.found: Counterexample | None = None
        self.tried, self.inconclusive, self.least = 0, 0, math.inf
        self._open: list[Proposal] = []
        self._points: list[Point] = []
        self._spurious: list[Counterexample] = []
        self._counts: Counter[str] = Counter()
        self._rejected = self._row = 0

    @property
    def exhausted(self) -> bool:
        """True if the last points had no admissible initial state."""
        return self._row >= REJECTED

    def ask(self, count: int) -> NDArray[np.float64]:
        """Points to simulate next, (count, dim)."""
        self._open = [self._portfolio.next() for _ in range(count)]
        return np.stack([self._part.whole(each.point) for each in self._open])

    def tell(self, points: NDArray[np.float64], outcome: Simulations) -> None:
        """Take the outcomes of the points that were asked for."""
        told = outcome.margins.copy()
        self._count(points, outcome, told)
        for index, each in enumerate(self._open):
            self._portfolio.tell(each, float(told[index]) if outcome.admissible[index] else math.inf)

    def _gradient(self, point: Point) -> Point | None:
        """Gradient of the robustness at a point, which counts as a simulation; None if there is none."""
        found = self._simulator.gradient(self._part.whole(point), self.requirement)
        if found is None:
            return None
        self.tried += 1
        self._counts[GradientVertices.name] += 1
        return found[list(self._part.coordinates)]

    def _count(self, points: NDArray[np.float64], outcome: Simulations, told: NDArray[np.float64]) -> None:
        """Count simulations, and examine violations; `told`, (count,), becomes what strategies are told."""
        for index, each in enumerate(self._open):
            if not outcome.admissible[index]:
                self._rejected, self._row = self._rejected + 1, self._row + 1
                continue
            self._row = 0
            self.tried += 1
            name, margin = each.strategy.name, float(outcome.margins[index])
            self._counts[name] += 1
            if not outcome.judged[index]:
                self.inconclusive += 1
                continue
            self._points.append(each.point)
            self.least = min(self.least, margin)
            if TOLERANCE.violated(margin) and self.found is None:
                told[index] = self._examined(points[index], margin, name)

    def _examined(self, point: Point, margin: float, name: str) -> float:
        """Examine a violation at half the time step, and return the robustness there, which may be positive.

        A drive is simulated alone first, as a replay does: the rounding of a policy's plans depends on the
        number of drives that are simulated side by side.
        """
        simulator = self._simulator
        if simulator.space.sparse and simulator.batch > 1:
            margin = float(simulator.simulate(point[None], self.requirement).margins[0])
            if TOLERANCE.satisfied(margin):
                return margin
        half = simulator.at_half_step(point[None], self.requirement)
        candidate = _candidate(point, margin, half, name, self.tried)
        if candidate.spurious:
            self._spurious.append(candidate)
        else:
            self.found = candidate
        return margin if half is None else float(half.margins[0])

    def result(self, seconds: float = 0.0, *, shrinks: bool = True) -> Falsification:
        """The result so far, after `seconds`; a counterexample is shrunk if `shrinks`."""
        simulator, found = self._simulator, self.found
        return Falsification(
            simulator.requirements[self.requirement],
            found,
            shrunk(simulator, self.requirement, found) if found is not None and shrinks else None,
            tuple(self._spurious),
            self.tried if found is None else found.simulation,
            self.inconclusive,
            self.least,
            coverage(np.array(self._points).reshape(len(self._points), self._part.space.dim)),
            self._rejected,
            seconds,
            dict(self._counts),
        )


def falsify(
    simulator: Simulator,
    requirement: int,
    *,
    budget: SearchBudget,
    seed: int,
    random: bool = False,
    shrinks: bool = True,
) -> Falsification:
    """Search for a violation of one requirement.

    Args:
        simulator: the closed system.
        requirement: index of the requirement.
        budget: limits of the search; shrinking a counterexample is not counted.
        seed: seed of the search; the same seed gives the same simulations.
        random: whether points are drawn from the declared distribution only, as a baseline.
        shrinks: whether a counterexample is shrunk.
    """
    began = perf_counter()
    search = ViolationSearch(simulator, requirement, seed, random=random)
    while search.found is None and search.tried < budget.simulations and not search.exhausted:
        if budget.seconds is not None and perf_counter() - began > budget.seconds:
            break
        points = search.ask(min(simulator.batch, budget.simulations - search.tried))
        search.tell(points, simulator.simulate(points, requirement))
    return search.result(perf_counter() - began, shrinks=shrinks)


@dataclass(frozen=True, slots=True)
class SearchOrder:
    """Settings of searches that differ only in their requirements.

    Attributes:
        budget: limits of each search.
        seed: seed of each search.
        random: whether points are drawn from the declared distribution only, as a baseline.
        shrinks: whether counterexamples are shrunk.
        batch: number of points that a search proposes at a time; None: as many as there are workers for. The
            same seed and number give the same simulations, whatever workers there are.
    """

    budget: SearchBudget
    seed: int
    random: bool = False
    shrinks: bool = True
    batch: int | None = None


def falsify_each(
    simulator: Simulator,
    requirements: Sequence[int],
    order: SearchOrder,
    workers: SimulatorWorkers | None = None,
) -> Iterator[Falsification]:
    """Search for violations of several requirements, and yield the results in order.

    With workers, each search is carried out by one of them, with the same result; if there is only one
    requirement, its simulations are shared out, and the search proposes as many points at a time as there are
    workers. A search that is lost with its workers is carried out in that way too, so that it costs only the
    simulations that end them.
    """
    shared = simulator if workers is None else SharedSimulator(simulator, workers, order.batch)
    if workers is None or len(requirements) == 1:
        for each in requirements:
            yield _search(shared, _Ordered(each, order))
        return
    ended = workers.run(_search, [_Ordered(each, order) for each in requirements])
    for each in requirements:
        found = next(ended)
        if isinstance(found, LostCall):
            ended = iter(list(ended))  # the workers must be free
            found = _search(shared, _Ordered(each, order))
        yield found


@dataclass(frozen=True, slots=True)
class _Ordered:
    """A search as it is sent to a worker: index of the requirement, and the settings."""

    requirement: int
    order: SearchOrder


def _search(simulator: Simulator, ordered: _Ordered) -> Falsification:
    order = ordered.order
    if order.batch is not None and not isinstance(simulator, SharedSimulator):
        simulator = SharedSimulator(simulator, None, order.batch)
    return falsify(
        simulator,
        ordered.requirement,
        budget=order.budget,
        seed=order.seed,
        random=order.random,
        shrinks=order.shrinks,
    )


def _candidate(
    point: Point, margin: float, half: Simulations | None, strategy: str, count: int
) -> Counterexample:
    """Counterexample with its robustness at half the step: NaN, which refutes nothing, without a verdict."""
    at_half = None if half is None else float(half.margins[0] if half.judged[0] else np.nan)
    return Counterexample(point, margin, at_half, strategy, count)


# ------------------------------------------------------------------------------ shrinking


def shrunk(simulator: Simulator, requirement: int, found: Counterexample) -> Counterexample:
    """Return a simpler counterexample: fewer pieces per input, rounder values.

    Every accepted change still violates the requirement, at half the time step too.
    """
    for coordinates, values in _changes(simulator.space):
        for value in values(found.point):
            point = found.point.copy()
            point[list(coordinates)] = value
            if np.array_equal(point, found.point):
                break
            outcome = simulator.simulate(point[None], requirement)
            margin = float(outcome.margins[0])
            if outcome.admissible[0] and TOLERANCE.violated(margin):
                half = simulator.at_half_step(point[None], requirement)
                simpler = _candidate(point, margin, half, found.strategy, found.simulation)
                if not simpler.spurious:
                    found = simpler
                    break
    return found


Values: TypeAlias = Callable[[Point], Sequence[float]]
"""Function from the present counterexample to the values to try, the simplest first."""


def _changes(space: SearchSpace) -> Iterator[tuple[tuple[int, ...], Values]]:
    """Yield coordinates to change together: whole inputs, equal neighbours, other numbers, rounded values.

    In a space most of whose coordinates have no effect, these are halves, quarters, and so on, of all.
    """
    for parts in SPLIT if space.sparse else ():
        for part in np.array_split(np.arange(space.dim), parts):
            yield tuple(part.tolist()), lambda _: (0.5,)
    if space.sparse:
        return
    for block in space.blocks:
        yield block.values, lambda _: (1.0, 0.0, 0.5)
        for left, right in pairwise(block.values):
            yield (right,), _like(left)
    for each in space.rest[:MOST_SHRUNK]:
        yield (each,), lambda _: (0.5, 0.0, 1.0)
    for block in space.blocks:
        for each in block.values[:MOST_SHRUNK]:
            yield (each,), _rounded(each)


def _like(coordinate: int) -> Values:
    """Return the function that proposes the value of another coordinate of the point."""
    return lambda point: (float(point[coordinate]),)


def _rounded(coordinate: int) -> Values:
    """Return the function that proposes the present value, rounded to few decimal digits."""
    return lambda point: tuple(round(float(point[coordinate]), digits) for digits in DIGITS)


def coverage(points: NDArray[np.float64]) -> float:
    """Pairwise coverage of the unit cube by points (count, dim): a share from 0 to 1.

    Each coordinate is divided into `CELLS` cells. The result is the share of the cells of all pairs of
    coordinates that hold a point, as in combinatorial testing (Kuhn, Kacker and Lei 2013). Of more than
    `MOST_PAIRED` coordinates, the first ones are counted. It is 1 without coordinates.
    """
    count, dim = points.shape
    if not dim:
        return 1.0
    if not count:
        return 0.0
    cells = np.minimum((points[:, :MOST_PAIRED] * CELLS).astype(np.int64), CELLS - 1)
    if cells.shape[1] == 1:
        return len(np.unique(cells)) / CELLS
    hit = total = 0
    for first in range(cells.shape[1]):
        for second in range(first):
            hit += len(np.unique(cells[:, first] * CELLS + cells[:, second]))
            total += CELLS * CELLS
    return hit / total
