"""Strategies of falsification: each proposes points of the unit cube and receives their robustness."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import Point, SearchSpace

KEPT = 8
"""Points that a local search keeps, and starts from."""
NARROW, WIDE = 0.01, 0.5
"""Least and greatest width of a change, in the unit cube."""
REDRAWN = 0.35
"""Share of the changes that draw a value anew, at an end of its range or uniform between them."""
PERTURBED, PERTURBATIONS = (0.02, 0.05), 16
"""Least and greatest width of a perturbation of all values; greatest number of perturbations."""
SCATTER, JUDGED = 0.1, 3
"""Interquartile range of the robustness of perturbations, as a share of that of other points, above which it
counts as scattered; and the number of perturbations that are judged at least."""
SHORTEST, LONGEST = 0.01, 0.5
"""Half periods of periodic inputs, as shares of the duration."""
SWEPT = 12
"""Half periods that are tried before the best is refined."""
ENDS = 2.0 / 3.0
"""Share of the values of vertices at the ends of their ranges."""
PIECES = (1, 2, 3, 5)
"""Maximum numbers of pieces of coarse inputs; one of them is drawn for each point."""


class Strategy(ABC):
    """Search for the least robust point, one point at a time.

    Attributes:
        name: name in reports.
        best: least guidance value that this strategy has found.
    """

    name: str

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        self.space, self.generator = space, generator
        self.best = math.inf

    @property
    def ready(self) -> bool:
        """False if the strategy waits for the outcomes of other points."""
        return True

    @abstractmethod
    def propose(self) -> Point | None:
        """Return the next point, (dim,); None if the strategy is finished."""

    def tell(self, point: Point, value: float) -> None:  # noqa: ARG002
        """Take the guidance value at a point that this strategy proposed; less is closer to a violation."""
        self.best = min(self.best, value)

    def observe(self, point: Point, value: float) -> None:  # noqa: B027
        """Take the guidance value at a point that another strategy proposed."""


class ConstantVertices(Strategy):
    """Inputs that are constant at the ends of their ranges, one after the other; then few other vertices."""

    name = "constant vertices"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        constant = list(space.constant_vertices())
        others = (each for each in space.corners() if not any(np.array_equal(each, old) for old in constant))
        self._left: Iterator[Point] = chain(constant, others)

    def propose(self) -> Point | None:
        return next(self._left, None)


def _values(
    space: SearchSpace, generator: np.random.Generator, labels: NDArray[np.int64], ends: float
) -> Point:
    """Point with one value per label: at an end of the range with the probability `ends`, else uniform.

    Free switching times are uniform.
    """
    count = int(labels.max()) + 1 if len(labels) else 0
    drawn, at_end = generator.random((2, count))
    values = np.where(at_end < ends, np.round(drawn), drawn)
    point: Point = values[labels]
    for block in space.blocks:
        point[list(block.times)] = generator.random(len(block.times))
    return point


class UniformSampling(Strategy):
    """Points with the declared distribution: the baseline."""

    name = "uniform"

    def propose(self) -> Point:
        return self.generator.random(self.space.dim)


class AlternatingVertices(Strategy):
    """Two opposite points at which inputs switch between the ends of their ranges after every piece.

    At the first point each input begins at a random end, and all other coordinates are at random ends. Free
    switching times divide the duration evenly.
    """

    name = "alternating vertices"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._left = self._points()

    def propose(self) -> Point | None:
        return next(self._left, None)

    def _points(self) -> Iterator[Point]:
        point: Point = np.round(self.generator.random(self.space.dim))
        for block in self.space.blocks:
            values = np.arange(len(block.values)) + self.generator.integers(2)
            point[list(block.values)] = values % 2
        for vertex in (point, 1.0 - point):
            for block in self.space.blocks:
                count = len(block.times)
                vertex[list(block.times)] = quantiles_of(np.arange(1, count + 1) / (count + 1))
            yield vertex


class VertexSampling(Strategy):
    """Each value independently at a random end of its range, or uniform between the ends."""

    name = "vertices"

    def propose(self) -> Point:
        return _values(self.space, self.generator, np.arange(self.space.dim), ENDS)


class InputVertices(VertexSampling):
    """Vertices at which each input has its own share of values at the high end, drawn for each point.

    So there are points at which one input is high nearly always and another one hardly ever.
    """

    name = "input vertices"

    def propose(self) -> Point:
        point = super().propose()
        for block in self.space.blocks:
            share = self.generator.random()
            at_end, high, drawn = self.generator.random((3, len(block.values)))
            point[list(block.values)] = np.where(at_end < ENDS, high < share, drawn)
        return point


def vertex_sampling(space: SearchSpace, generator: np.random.Generator) -> VertexSampling:
    """Vertices for a space: with a share of high values per input if there are several inputs."""
    several = len(space.blocks) > 1 and not space.small
    return InputVertices(space, generator) if several else VertexSampling(space, generator)


class CoarseSampling(Strategy):
    """Inputs of a few long pieces with uniform values."""

    name = "coarse"

    def propose(self) -> Point:
        most = PIECES[int(self.generator.integers(len(PIECES)))]
        return _values(self.space, self.generator, self.space.held(self.generator, most), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """Simulated point.

    Attributes:
        point: the point, (dim,).
        value: its guidance value.
    """

    point: Point
    value: float


class LocalSearch(Strategy):
    """Search that starts from the best points so far, whichever strategy has found them."""

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._kept: list[Told] = []

    @property
    def ready(self) -> bool:
        return bool(self._kept)

    def tell(self, point: Point, value: float) -> None:
        super().tell(point, value)
        self.observe(point, value)

    def observe(self, point: Point, value: float) -> None:
        """Take a point into account; the earlier one of equally good points is the better one."""
        if math.isfinite(value):
            known = [*self._kept, Told(point, value)]
            self._kept = sorted(known, key=lambda each: each.value)[:KEPT]

    def _one_of_the_best(self) -> Point:
        """The best point with probability one half, else the second best with one half, and so on."""
        return self._kept[min(int(self.generator.geometric(0.5)), len(self._kept)) - 1].point


def neighbour(space: SearchSpace, generator: np.random.Generator, point: Point) -> Point:
    """Copy of a point with other values, of a few coordinates or successive values of an input."""
    changed = point.copy()
    width = math.exp(generator.uniform(math.log(NARROW), math.log(WIDE)))
    for picked in _picked(space, generator, point):
        if generator.random() < REDRAWN:
            changed[picked] = generator.choice((0.0, 1.0, generator.random()))
        else:
            changed[picked] = np.clip(changed[picked] + width * generator.standard_normal(), 0.0, 1.0)
    return changed


def _picked(space: SearchSpace, generator: np.random.Generator, point: Point) -> Iterator[list[int]]:
    """One or two groups of coordinates; those of a group are changed together.

    A group starts from a random coordinate. If this is a value of an input, the group is half of the time the
    stretch around it over which the input has the same value, and otherwise a run of successive values of the
    input, or the coordinate alone. Any other coordinate is changed alone.
    """
    for _ in range(1 + (generator.random() < 0.5)):
        pick = int(generator.integers(space.dim))
        block = next((each for each in space.blocks if pick in each.values), None)
        kind = generator.random()
        if block is None or kind < 0.25:
            yield [pick]
        elif kind < 0.75:
            values, last = block.values, len(block.values) - 1
            first = end = values.index(pick)
            while first > 0 and point[values[first - 1]] == point[pick]:
                first -= 1
            while end < last and point[values[end + 1]] == point[pick]:
                end += 1
            yield list(values[first : end + 1])
        else:
            first, last = np.sort(generator.integers(0, len(block.values), 2))
            yield list(block.values[first : last + 1])


class Perturbation(LocalSearch):
    """The best point so far with a small change of all values, mirrored at the ends of their ranges.

    Where robustness varies more between close points than between distant ones, as in a closed loop that
    chatters, the surroundings of a good vertex hold violations that the vertex itself misses. The strategy is
    finished after a few points, and where their robustness is not scattered.
    """

    name = "perturbation"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._own: list[float] = []
        self._others: list[float] = []
        self._proposed = 0

    def tell(self, point: Point, value: float) -> None:
        super().tell(point, value)
        self._own.append(value)

    def observe(self, point: Point, value: float) -> None:
        super().observe(point, value)
        self._others.append(value)

    def propose(self) -> Point | None:
        calm = len(self._own) >= JUDGED and _spread(self._own) <= SCATTER * _spread(self._others)
        if calm or not self._kept or self._proposed == PERTURBATIONS:
            return None
        self._proposed += 1
        low, high = map(math.log, PERTURBED)
        width = math.exp(self.generator.uniform(low, high))
        moved = self._kept[0].point + width * self.generator.standard_normal(self.space.dim)
        mirrored: Point = 1.0 - np.abs(1.0 - np.abs(moved) % 2.0)
        return mirrored


def _spread(values: Sequence[float]) -> float:
    """Interquartile range of the finite ones of values; 0 if there are fewer than two."""
    finite = [value for value in values if math.isfinite(value)]
    low, high = np.quantile(finite, (0.25, 0.75)) if len(finite) > 1 else (0.0, 0.0)
    return float(high - low)


class GradientVertices(LocalSearch):
    """Vertices of the cube to which the gradient at the best point so far leads, while that makes progress.

    They minimise the linearised robustness over the whole cube, as the steps of Frank and Wolfe (1956) do.
    """

    name = "gradient"

    def __init__(
        self, space: SearchSpace, generator: np.random.Generator, gradient: Callable[[Point], Point | None]
    ) -> None:
        """Search with a function that returns the gradient of the robustness at a point, or None."""
        super().__init__(space, generator)
        self._gradient = gradient
        self._last: Point | None = None

    def propose(self) -> Point | None:
        start = self._kept[0].point if self._kept else None
        if start is None or start is self._last:
            return None
        self._last, slope = start, self._gradient(start)
        if slope is None:
            return None
        target = np.where(slope < 0.0, 1.0, np.where(slope > 0.0, 0.0, start))
        return None if np.array_equal(target, start) else target


class PeriodicInputs(Strategy):
    """Square waves between the ends of an input's range.

    First half periods are swept, from short to long in the order of a van der Corput sequence, with random
    phases. Then the best wave is changed slightly.
    """

    name = "periodic"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._waves: NDArray[np.float64] | None = None
        self._value, self._proposed, self._width = math.inf, 0, 0.15
        self._shift = generator.random()
        self._open: dict[int, NDArray[np.float64]] = {}

    def propose(self) -> Point | None:
        if not self.space.blocks:
            return None
        generator, count = self.generator, len(self.space.blocks)
        self._proposed += 1
        if self._waves is not None and self._proposed > SWEPT and generator.random() < 0.8:
            waves = self._waves + generator.normal(0.0, self._width, self._waves.shape)
        else:
            bits = f"{self._proposed:b}"  # van der Corput sequence: 1/2, 1/4, 3/4, 1/8 and so on
            share = (int(bits[::-1], 2) / (1 << len(bits)) + self._shift) % 1.0
            half = math.log(SHORTEST) + share * (math.log(LONGEST) - math.log(SHORTEST))
            waves = np.stack([np.full(count, half), generator.random(count) * 2.0], 1)
        point = self.space.middle()
        for block, (period, phase) in zip(self.space.blocks, waves, strict=True):
            self._fill(point, block.values, block.times, math.exp(period), phase, block.fractions)
        for each in self.space.rest:
            point[each] = generator.choice((0.0, 1.0, generator.random()))
        self._open[id(point)] = waves
        return point

    @staticmethod
    def _fill(
        point: Point,
        values: Sequence[int],
        times: Sequence[int],
        half: float,
        phase: float,
        fractions: Sequence[float],
    ) -> None:
        """Write a wave into the values of one input; free switching times are put at its switches."""
        count = len(values)
        if times:
            switches = np.clip((np.arange(1, count) - phase % 1.0) * half, 0.0, 1.0)
            point[list(times)] = quantiles_of(switches[: len(times)])
            point[list(values)] = (np.arange(count) + int(phase)) % 2
            return
        at = np.asarray(fractions) if fractions else np.arange(count) / count
        point[list(values)] = np.floor((at + 0.5 / count) / half + phase) % 2

    def tell(self, point: Point, value: float) -> None:
        super().tell(point, value)
        waves = self._open.pop(id(point))
        if value < self._value:
            self._waves, self._value, self._width = waves, value, 0.15
        elif self._proposed > SWEPT:
            self._width = max(0.9 * self._width, 0.02)


def quantiles_of(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Uniform quantiles from which sorted random times are drawn one after the other.

    Of k sorted uniform times, the rest of the duration after the i-th (from 0) is the rest after the one
    before it times the (k - i)-th root of a uniform number (order statistics, Devroye 1986, chapter V.2).

    Args:
        times: sorted times as shares of the duration, (k,).
    """
    rest = 1.0 - times
    before = np.concatenate(([1.0], rest[:-1]))
    ratio = np.divide(rest, before, out=np.zeros_like(rest), where=before > 0.0)
    found: NDArray[np.float64] = ratio ** np.arange(len(times), 0, -1)
    return found
