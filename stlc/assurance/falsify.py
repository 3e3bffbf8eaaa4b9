"""Falsification: the search for a simulation that violates a requirement.

A counterexample is accepted only if it also violates the requirement at half the time step. What is reported
when none is found is what was searched, which is never a proof.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from time import perf_counter
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import Point, SearchSpace
from stlc.assurance.sensitive import SensitiveClimbing
from stlc.assurance.strategies import (
    ConstantVertices,
    CovarianceAdaptation,
    HillClimbing,
    PeriodicInputs,
    Strategy,
    UniformSampling,
    VertexSampling,
)
from stlc.compile.semantics.semantics import TOLERANCE

FALSIFIER_VERSION = 1
"""Version of the search; results of older versions are recomputed."""
FLAT, FLAT_VALUES = 0.9, 20
"""Share of equal values, and number of last values, at which robustness counts as flat."""
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
class Simulations:
    """Outcomes of simulations.

    Attributes:
        margins: exact robustness per requirement, (count, requirements); -inf where states are not finite.
        guidance: scaled robustness per requirement, (count, requirements), of the same sign.
        admissible: whether the initial state meets the conditions of `where`, (count,).
    """

    margins: NDArray[np.float64]
    guidance: NDArray[np.float64]
    admissible: NDArray[np.bool_]


class Simulator(Protocol):
    """Simulations of a closed system, as a function of points in the unit cube."""

    @property
    def space(self) -> SearchSpace:
        """The search space."""

    @property
    def batch(self) -> int:
        """Number of points that are best simulated side by side."""

    @property
    def requirements(self) -> Sequence[str]:
        """Names of the requirements, in the order of the margins."""

    def seen(self, requirement: int) -> float:
        """Share of the inputs' duration, at most 1, after which inputs no longer affect a requirement."""

    def simulate(self, points: NDArray[np.float64]) -> Simulations:
        """Simulate and judge `points`, (count, dim)."""

    def at_half_step(self, points: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Margins at half the time step, (count, requirements); None if the step cannot be changed."""


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

    point: Point = field(repr=False)
    margin: float
    half_step: float | None
    strategy: str
    simulation: int

    @property
    def spurious(self) -> bool:
        """Whether the requirement is satisfied at half the time step."""
        return self.half_step is not None and self.half_step >= -TOLERANCE


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
        least: least robustness of all simulations.
        coverage: share of the cells, over all pairs of coordinates, that simulations fell into.
        rejected: number of points whose initial state does not meet the conditions of `where`.
        seconds: time of the search.
        strategies: number of simulations per strategy.
    """

    requirement: str
    found: Counterexample | None
    shrunk: Counterexample | None
    spurious: tuple[Counterexample, ...]
    simulations: int
    least: float
    coverage: float
    rejected: int
    seconds: float
    strategies: dict[str, int]


@dataclass(frozen=True, slots=True)
class Proposal:
    """Point to simulate, and the strategy that proposes it."""

    strategy: Strategy
    point: Point


class Portfolio:
    """The strategies of a search, in turn: constant vertices first, then the others.

    Every other turn goes to the strategy that has found the least robust point. In a space most of whose
    coordinates have no effect, `SensitiveClimbing` is the only strategy.

    While the robustness is flat, that is, hardly ever changes, nothing can be learnt from it: then points are
    uniform.
    """

    def __init__(self, space: SearchSpace, generator: np.random.Generator, *, random: bool = False) -> None:
        """Take turns between all strategies, or sample uniformly if `random`."""
        self._uniform = UniformSampling(space, generator)
        self._first: Strategy | None = None
        self._turns: list[Strategy] = []
        if not random and space.sparse:
            self._turns = [SensitiveClimbing(space, generator)]
        elif not random and space.dim:
            self._first = ConstantVertices(space, generator)
            self._turns = [VertexSampling(space, generator), HillClimbing(space, generator)]
            if CovarianceAdaptation.available(space):
                self._turns.append(CovarianceAdaptation(space, generator))
            if space.blocks:
                self._turns.append(PeriodicInputs(space, generator))
        self._turn = 0
        self._values: deque[float] = deque(maxlen=FLAT_VALUES)

    @property
    def flat(self) -> bool:
        """Whether nearly all of the last values are the same."""
        count = len(self._values)
        return count > 1 and Counter(self._values).most_common(1)[0][1] >= FLAT * count

    def next(self) -> Proposal:
        """Return the next point and the strategy that proposes it."""
        if not self._turns or self.flat:
            return Proposal(self._uniform, self._uniform.propose())
        if self._first is not None:
            point = self._first.propose()
            if point is not None:
                return Proposal(self._first, point)
            self._first = None
        leads = self._turn % 2 == 1
        self._turn += 1
        strategy = min(self._turns, key=lambda each: each.best) if leads else self._turns[0]
        if not leads:
            self._turns = [*self._turns[1:], strategy]
        point = strategy.propose()
        return (
            Proposal(self._uniform, self._uniform.propose()) if point is None else Proposal(strategy, point)
        )

    def observe(self, point: Point, value: float) -> None:
        """Report the guidance value at a point that no strategy proposed."""
        for each in self._turns:
            each.observe(point, value)

    def tell(self, proposal: Proposal, value: float) -> None:
        """Report the guidance value at a point to its strategy, and to those that learn from others."""
        self._values.append(value)
        proposal.strategy.tell(proposal.point, value)
        for other in self._turns:
            if other is not proposal.strategy:
                other.observe(proposal.point, value)


def falsify(
    simulator: Simulator,
    requirement: int,
    *,
    budget: SearchBudget,
    seed: int,
    random: bool = False,
    shrinks: bool = True,
    progress: Callable[[int, float], None] | None = None,
) -> Falsification:
    """Search for a violation of one requirement.

    Args:
        simulator: the closed system.
        requirement: index of the requirement.
        budget: limits of the search; shrinking a counterexample is not counted.
        seed: seed of the search; the same seed gives the same simulations.
        random: whether points are drawn from the declared distribution only, as a baseline.
        shrinks: whether a counterexample is shrunk.
        progress: function that receives the number of simulations and the least robustness so far.
    """
    began, generator = perf_counter(), np.random.default_rng(seed)
    whole = simulator.space
    part = whole.visible(simulator.seen(requirement))
    portfolio = Portfolio(part.space, generator, random=random)
    tried: list[Point] = []
    spurious: list[Counterexample] = []
    counts: dict[str, int] = {}
    least, rejected, row, found = math.inf, 0, 0, None
    while found is None and len(tried) < budget.simulations and row < REJECTED:
        if budget.seconds is not None and perf_counter() - began > budget.seconds:
            break
        count = min(simulator.batch, budget.simulations - len(tried))
        proposals = [portfolio.next() for _ in range(count)]
        points = np.stack([part.whole(each.point) for each in proposals])
        outcome = simulator.simulate(points)
        for index, each in enumerate(proposals):
            if not outcome.admissible[index]:
                rejected, row = rejected + 1, row + 1
                portfolio.tell(each, math.inf)
                continue
            row = 0
            tried.append(each.point)
            name = each.strategy.name
            counts[name] = counts.get(name, 0) + 1
            margin = float(outcome.margins[index, requirement])
            least = min(least, margin)
            portfolio.tell(each, float(outcome.guidance[index, requirement]))
            if margin < -TOLERANCE and found is None:
                margin = _alone(simulator, requirement, points[index], margin)
            if margin < -TOLERANCE and found is None:
                candidate = _candidate(simulator, requirement, points[index], margin, name, len(tried))
                if candidate.spurious:
                    spurious.append(candidate)
                else:
                    found = candidate
        if progress is not None:
            progress(len(tried), least)
    return Falsification(
        simulator.requirements[requirement],
        found,
        shrunk(simulator, requirement, found) if found is not None and shrinks else None,
        tuple(spurious),
        len(tried) if found is None else found.simulation,
        least,
        coverage(np.array(tried).reshape(len(tried), part.space.dim)),
        rejected,
        perf_counter() - began,
        counts,
    )


def _alone(simulator: Simulator, requirement: int, point: Point, margin: float) -> float:
    """Robustness of a drive that is simulated alone, as a replay does; of other simulations, `margin`.

    The rounding of a policy's plans depends on the number of drives that are simulated side by side.
    """
    if not simulator.space.sparse or simulator.batch == 1:
        return margin
    return float(simulator.simulate(point[None]).margins[0, requirement])


def _candidate(
    simulator: Simulator, requirement: int, point: Point, margin: float, strategy: str, count: int
) -> Counterexample:
    half = simulator.at_half_step(point[None])
    at_half = None if half is None else float(half[0, requirement])
    return Counterexample(point, margin, at_half, strategy, count)


# ------------------------------------------------------------------------------ shrinking


def shrunk(simulator: Simulator, requirement: int, found: Counterexample) -> Counterexample:
    """Return a simpler counterexample: fewer pieces per input, rounder values.

    Every accepted change still violates the requirement, at half the time step too.
    """
    for coordinates, values in _changes(simulator.space):
        for value in values(found.point):
            point = _set(found.point, coordinates, value)
            if np.array_equal(point, found.point):
                break
            outcome = simulator.simulate(point[None])
            margin = float(outcome.margins[0, requirement])
            if outcome.admissible[0] and margin < -TOLERANCE:
                simpler = _candidate(simulator, requirement, point, margin, found.strategy, found.simulation)
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
    """The value of another coordinate."""
    return lambda point: (float(point[coordinate]),)


def _rounded(coordinate: int) -> Values:
    """The value with few decimal digits."""
    return lambda point: tuple(round(float(point[coordinate]), digits) for digits in DIGITS)


def _set(point: Point, coordinates: Sequence[int], value: float) -> Point:
    changed = point.copy()
    changed[list(coordinates)] = value
    return changed


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
