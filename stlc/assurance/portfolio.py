"""Portfolio of falsification: the order in which the strategies of a search have their turns."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stlc.assurance.search_space import Point, SearchSpace
from stlc.assurance.sensitive import SensitiveClimbing
from stlc.assurance.strategies import (
    PIECES,
    AlternatingVertices,
    CoarseSampling,
    ConstantVertices,
    CovarianceAdaptation,
    GradientVertices,
    HillClimbing,
    PeriodicInputs,
    Perturbation,
    SettlingInputs,
    Strategy,
    UniformSampling,
    VertexSampling,
    vertex_sampling,
)
from stlc.assurance.surrogate import SurrogateSearch, TrendSampling, TrustRegionSearch

FLAT, FLAT_VALUES = 0.9, 20
"""Share of equal values, and number of last values, at which robustness counts as flat."""
OPENING = 12
"""Points of random pieces with which a search begins, after vertices and constant inputs."""
VERTICES = 5
"""Vertices before them."""
SMALL_OPENING = 4
"""The same in a small space, all of whose vertices come first."""
PERTURBATIONS = 16
"""Greatest number of small perturbations of the best point, before these points and in a small space. Large
spaces with several inputs have none."""
SURROGATE_TURNS = 300
"""Turns after the first points in which the surrogate has most of the points, and not later."""
BLIND, BLIND_TURNS = 4, 12
"""Vertices with which a search begins if robustness is no guide; then one point in so many is a vertex."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """Point to simulate, and the strategy that proposes it."""

    strategy: Strategy
    point: Point


@dataclass(frozen=True, slots=True)
class _Opening:
    """Points with which a search begins: those of one strategy, as many as given.

    Attributes:
        strategy: the strategy.
        count: number of its points; None: all that it has.
        worthwhile: condition under which it goes on.
    """

    strategy: Strategy
    count: int | None = 1
    worthwhile: Callable[[], bool] = lambda: True


class Portfolio:
    """The strategies of a search, in turn: vertices and constant inputs, random points, then all of them.

    Two thirds of the next `SURROGATE_TURNS` points are chosen by the surrogates of the whole space and of a
    trust region, two ninths are random, and the rest goes to the other strategies in turn. In a small space,
    all of whose vertices come first, four ninths are those of CMA-ES, a third is chosen by the surrogate, and
    a ninth is random. Of the points after these a third is random, a third goes to the strategy that has
    found the least robust point, and a third to all in turn. If the robustness takes few values, as that of
    conditions on gears does, nothing can be learnt from it: then points are drawn at random. In a space most
    of whose coordinates have no effect, `SensitiveClimbing` is the only strategy, and points are uniform
    while the robustness hardly ever changes.
    """

    def __init__(
        self,
        space: SearchSpace,
        generator: np.random.Generator,
        gradient: Callable[[Point], Point | None],
        *,
        random: bool = False,
        graded: bool = True,
        without: Collection[str] = (),
    ) -> None:
        """Take turns between all strategies, or draw random points if `random`.

        Args:
            space: the search space.
            generator: source of all random numbers.
            gradient: function that returns the gradient of the robustness at a point, or None.
            random: whether all points are uniform in the unit cube, so that the simulated values have the
                declared distribution.
            graded: whether the robustness varies with the signals. If it takes only a few values, points are
                drawn at random.
            without: names of strategies that have no turns, to see what they contribute.
        """
        surrogate = SurrogateSearch(space, generator)
        self._sensitive = SensitiveClimbing(space, generator) if space.sparse and not random else None
        self._guided = not random and not space.sparse and graded and space.dim > 0
        uniform, even = UniformSampling(space, generator), VertexSampling(space, generator)
        vertices = vertex_sampling(space, generator)
        self._even, self._vertices = even, vertices
        self._blind: list[Strategy] = [uniform] if random else [*[uniform] * 5, even]
        self._samplers: list[Strategy] = [vertices, uniform]
        trends: list[Strategy] = []
        if self._guided and any(len(block.values) > max(PIECES) for block in space.blocks):
            trends.append(TrendSampling(space, generator))
            self._samplers = [*trends, CoarseSampling(space, generator), SettlingInputs(space, generator)]
        self._leading: list[Strategy] = [surrogate]
        self._drawn = [*self._samplers]
        self._others: list[Strategy] = []
        self._late: list[Strategy] = []
        self._first: deque[_Opening] = deque()
        if self._guided:
            climb, perturbation = GradientVertices(space, generator, gradient), Perturbation(space, generator)
            self._others = [climb, HillClimbing(space, generator), perturbation]
            if space.blocks:
                self._others.append(PeriodicInputs(space, generator))
            if not space.small:
                self._leading.append(TrustRegionSearch(space, generator))
            self._late = [*self._others, *self._leading]
            if CovarianceAdaptation.available(space):
                adaptation = CovarianceAdaptation(space, generator)
                self._late.append(adaptation)
                if space.small:
                    self._leading, self._drawn = [adaptation, surrogate], [adaptation, uniform]
                else:
                    self._others.append(adaptation)
            self._late += trends
            self._first.extend(self._opening(space, generator, perturbation, climb))
        elif not random and not graded:
            self._blind = [*[uniform] * (BLIND_TURNS - 1), even]
            self._first.append(_Opening(even, BLIND))
        kept = [each for each in self._first if each.count != 0 and each.strategy.name not in without]
        self._first = deque(kept)
        for turns in (self._samplers, self._drawn, self._leading, self._others, self._late):
            turns[:] = [each for each in turns if each.name not in without] or [uniform]
        self._turn = 0
        self._values: deque[float] = deque(maxlen=FLAT_VALUES)

    def _opening(
        self, space: SearchSpace, generator: np.random.Generator, perturbation: Perturbation, climb: Strategy
    ) -> Sequence[_Opening]:
        """Points with which a guided search begins."""
        constant = ConstantVertices(space, generator)
        constants, descent = _Opening(constant, None), _Opening(climb, None)
        perturbed = _Opening(perturbation, PERTURBATIONS, lambda: perturbation.scattered)
        if space.small:
            uniform = _Opening(self._samplers[-1], SMALL_OPENING)
            return _Opening(self._even, 2), constants, uniform, perturbed, descent
        drawn = [_Opening(self._samplers[index % len(self._samplers)]) for index in range(OPENING)]
        alternating = _Opening(AlternatingVertices(space, generator), None)
        simple = alternating, _Opening(constant, 2), _Opening(self._vertices, VERTICES)
        if len(space.blocks) > 1:
            return (*simple, *drawn[:4], descent, constants, *drawn[4:])
        return (*simple, constants, perturbed, *drawn[:4], descent, *drawn[4:])

    @property
    def flat(self) -> bool:
        """True if nearly all of the last values are the same."""
        count = len(self._values)
        return count > 1 and Counter(self._values).most_common(1)[0][1] >= FLAT * count

    def next(self) -> Proposal:
        """Return the next point and the strategy that proposes it."""
        while (opening := next((each for each in self._first if each.strategy.ready), None)) is not None:
            index = self._first.index(opening)
            point = opening.strategy.propose() if opening.worthwhile() else None
            if point is None or opening.count == 1:
                del self._first[index]
            elif opening.count is not None:
                self._first[index] = replace(opening, count=opening.count - 1)
            if point is not None:
                return Proposal(opening.strategy, point)
        while True:
            strategy = self._chosen()
            point = strategy.propose()
            if point is not None:
                return Proposal(strategy, point)

    def _chosen(self) -> Strategy:
        """The strategy whose turn it is, after the first points."""
        if self._sensitive is not None:
            return self._blind[0] if self.flat else self._sensitive
        if not self._guided or self.flat:
            return _rotated(self._blind)
        self._turn += 1
        if self._turn <= SURROGATE_TURNS:
            if self._turn % 3:
                return _rotated(self._leading)
            return _rotated(self._others if self._turn % 9 == 0 else self._drawn)
        if self._turn % 3 == 0:
            return _rotated(self._samplers)
        if self._turn % 3 == 1:
            return min(self._late, key=lambda each: each.best)
        return _rotated(self._late)

    def observe(self, point: Point, value: float) -> None:
        """Report the guidance value at a point that no strategy proposed."""
        for each in self._learning():
            each.observe(point, value)

    def tell(self, proposal: Proposal, value: float, decided: float = math.nan) -> None:
        """Report the guidance value at a point to its strategy, and to those that learn from others.

        Args:
            proposal: the point and its strategy.
            value: guidance value at the point.
            decided: share of the inputs' duration at the sample that decides the value; NaN if unknown.
        """
        self._values.append(value)
        proposal.strategy.tell(proposal.point, value, decided)
        for other in self._learning():
            if other is not proposal.strategy:
                other.observe(proposal.point, value, decided)

    def _learning(self) -> Sequence[Strategy]:
        """Strategies that learn from the points of others."""
        return self._late if self._sensitive is None else (self._sensitive,)


def _rotated(strategies: list[Strategy]) -> Strategy:
    """Return the first strategy of a list, which becomes the last one."""
    strategies.append(strategies.pop(0))
    return strategies[-1]
