"""Strategies of falsification: each proposes points of the unit cube and receives their robustness."""

from __future__ import annotations

import importlib.util
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import Point, SearchSpace

STARTS = 10
"""Points from which the best is the start of a climb."""
PATIENCE = 60
"""Steps without progress after which a climb starts anew."""
WIDTH = 0.3
"""First step width of a climb, in the unit cube."""
CMA_WIDTH, CMA_LENGTH, CMA_DIMENSIONS = 0.4, 400, 200
"""First step width of CMA-ES, evaluations after which it restarts, and coordinates up to which it is used."""
SHORTEST, LONGEST = 0.01, 0.5
"""Half periods of periodic inputs, as shares of the duration."""


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

    @abstractmethod
    def propose(self) -> Point | None:
        """Return the next point, (dim,); None if the strategy is finished."""

    def tell(self, point: Point, value: float) -> None:  # noqa: ARG002
        """Take the guidance value at a point that this strategy proposed; less is closer to a violation."""
        self.best = min(self.best, value)

    def observe(self, point: Point, value: float) -> None:  # noqa: B027
        """Take the guidance value at a point that another strategy proposed."""


class ConstantVertices(Strategy):
    """Inputs that are constant at the ends of their ranges, one after the other."""

    name = "constant vertices"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._left: Iterator[Point] = space.constant_vertices()

    def propose(self) -> Point | None:
        return next(self._left, None)


def _ends(space: SearchSpace, generator: np.random.Generator, labels: NDArray[np.int64]) -> Point:
    """Point whose values are, per label, the low end, the high end, or uniform, with a third each.

    Free switching times stay uniform.
    """
    count = int(labels.max()) + 1 if len(labels) else 0
    values = generator.choice(3, count) / 2.0
    values = np.where(values == 0.5, generator.random(count), values)
    point: Point = values[labels]
    for block in space.blocks:
        point[list(block.times)] = generator.random(len(block.times))
    return point


class UniformSampling(Strategy):
    """Points with the declared distribution: the baseline."""

    name = "uniform"

    def propose(self) -> Point:
        return self.generator.random(self.space.dim)


class VertexSampling(Strategy):
    """Each value independently at the low end, at the high end, or uniform between them."""

    name = "vertices"

    def propose(self) -> Point:
        return _ends(self.space, self.generator, np.arange(self.space.dim))


class HillClimbing(Strategy):
    """Local search, which begins at the best of a few points with long pieces.

    A step changes single values, or a run of successive values of an input.
    """

    name = "hill climbing"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._restart()

    def _restart(self) -> None:
        self._point: Point | None = None
        self._value, self._tried, self._failed, self._width = math.inf, 0, 0, WIDTH

    def propose(self) -> Point:
        self._tried += 1
        if self._tried <= STARTS or self._point is None:
            return _ends(self.space, self.generator, self.space.held(self.generator))
        return self._neighbour(self._point)

    def tell(self, point: Point, value: float) -> None:
        super().tell(point, value)
        if value < self._value:
            self._point, self._value, self._failed = point, value, 0
            self._width = min(1.5 * self._width, 0.5)
        elif self._tried > STARTS:
            self._failed += 1
            self._width = max(0.93 * self._width, 0.01)
        if self._failed > PATIENCE:
            self._restart()

    def observe(self, point: Point, value: float) -> None:
        if self._tried <= STARTS and value < self._value:
            self._point, self._value = point, value

    def _neighbour(self, point: Point) -> Point:
        """Copy of a point with a few coordinates, or with a run of successive values of an input, changed."""
        generator, changed = self.generator, point.copy()
        for picked in self._picked():
            if generator.random() < 0.35:
                changed[picked] = generator.choice((0.0, 1.0, generator.random()))
            else:
                changed[picked] = np.clip(
                    changed[picked] + self._width * generator.standard_normal(), 0.0, 1.0
                )
        return changed

    def _picked(self) -> Iterator[list[int]]:
        """Groups of coordinates to change: one and a half on average."""
        generator = self.generator
        for _ in range(1 + (generator.random() < 0.5)):
            pick = int(generator.integers(self.space.dim))
            block = next((each for each in self.space.blocks if pick in each.values), None)
            if block is None or generator.random() < 0.5:
                yield [pick]
            else:
                first, last = np.sort(generator.integers(0, len(block.values), 2))
                yield list(block.values[first : last + 1])


class PeriodicInputs(Strategy):
    """Square waves between the ends of an input's range, with random half period and phase.

    The best wave so far is changed slightly half of the time.
    """

    name = "periodic"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._waves: NDArray[np.float64] | None = None
        self._value = math.inf
        self._open: dict[int, NDArray[np.float64]] = {}

    def propose(self) -> Point | None:
        if not self.space.blocks:
            return None
        generator, count = self.generator, len(self.space.blocks)
        if self._waves is not None and generator.random() < 0.5:
            waves = self._waves + generator.normal(0.0, 0.1, self._waves.shape)
        else:
            ends = math.log(SHORTEST), math.log(LONGEST)
            waves = np.stack([generator.uniform(*ends, count), generator.random(count) * 2.0], 1)
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
            self._waves, self._value = waves, value


class CovarianceAdaptation(Strategy):
    """CMA-ES (Hansen and Ostermeier 2001) in the unit cube, by the package `cma`."""

    name = "cma-es"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._search: Any = None
        self._asked: list[Point] = []
        self._open: list[Point] = []
        self._told: list[tuple[Point, float]] = []

    @classmethod
    def available(cls, space: SearchSpace) -> bool:
        """Whether the package is installed, and the space small enough for a covariance matrix."""
        return importlib.util.find_spec("cma") is not None and 1 < space.dim <= CMA_DIMENSIONS

    def propose(self) -> Point:
        if not self._open and len(self._told) == len(self._asked):
            if self._search is None or self._search.countevals > CMA_LENGTH or self._search.stop():
                self._search = self._started()
            self._asked = [np.asarray(each) for each in self._search.ask()]
            self._open, self._told = self._asked[::-1], []
        if not self._open:  # a whole generation is being simulated
            return np.asarray(self._search.ask(1)[0])
        return self._open.pop()

    def tell(self, point: Point, value: float) -> None:
        super().tell(point, value)
        if any(point is each for each in self._asked):
            self._told.append((point, value))
        if self._told and len(self._told) == len(self._asked):
            finite = [min(value, 1e9) for _, value in self._told]
            self._search.tell([each for each, _ in self._told], finite)
            self._asked, self._told = [], []

    def _started(self) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import cma
        options = {
            "bounds": [0.0, 1.0],
            "seed": int(self.generator.integers(1, 2**31)),
            "verbose": -9,
            "verb_log": 0,
        }
        start = self.generator.random(self.space.dim)
        return cma.CMAEvolutionStrategy(start, CMA_WIDTH, options)


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
