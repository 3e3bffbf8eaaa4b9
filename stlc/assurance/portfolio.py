"""Portfolio of falsification: the order in which the strategies of a search have their turns."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from stlc.assurance.search_space import Point, SearchSpace
from stlc.assurance.sensitive import SensitiveSearch
from stlc.assurance.strategies import (
    PIECES,
    AlternatingVertices,
    CoarseSampling,
    ConstantVertices,
    GradientVertices,
    PeriodicInputs,
    Perturbation,
    Strategy,
    UniformSampling,
    VertexSampling,
)
from stlc.assurance.surrogate import SurrogateSearch

FLAT, FLAT_VALUES = 0.9, 20
"""Share of equal values, and number of last values, at which robustness counts as flat."""
OPENING = 4
"""Coarse inputs with which a search begins, beside vertices."""
SURROGATE_TURNS = 300
"""Turns after the first points in which the surrogate has most of the points, and not later."""
FLAT_TURNS, BLIND_TURNS = 6, 12
"""Points one of which is a vertex, the others uniform: while robustness is flat, and if it is no guide."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """Point to simulate, and the strategy that proposes it."""

    strategy: Strategy
    point: Point


class Portfolio:
    """The strategies of a search, in turn: vertices and constant inputs, coarse inputs, then all of them.

    Two thirds of the next `SURROGATE_TURNS` points are chosen by the surrogate, two ninths are coarse, or
    uniform if no input has many values, and a ninth follows the gradient or is periodic. Of the points after
    these a third is random, a third goes to the strategy that has found the least robust point, and a third
    to all in turn. If the robustness takes few values, as that of conditions on gears does, nothing can be
    learnt from it: then points are drawn at random. In a space most of whose coordinates have no effect,
    `SensitiveSearch` is the only strategy, and points are uniform while the robustness hardly ever changes.
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
        uniform = UniformSampling(space, generator)
        self._sensitive = SensitiveSearch(space, generator) if space.sparse and not random else None
        self._guided = not random and not space.sparse and graded and space.dim > 0
        self._blind: list[Strategy] = [uniform]
        if not random:
            turns = FLAT_TURNS if graded else BLIND_TURNS
            self._blind = [*self._blind * (turns - 1), VertexSampling(space, generator)]
        self._drawn: Strategy = uniform
        self._leading: Strategy = uniform
        self._first: list[Strategy] = []
        self._others: list[Strategy] = []
        if self._guided:
            descent, coarse = GradientVertices(space, generator, gradient), CoarseSampling(space, generator)
            constant, surrogate = ConstantVertices(space, generator), SurrogateSearch(space, generator)
            self._others.append(descent)
            if space.blocks:
                self._others.append(PeriodicInputs(space, generator))
            if any(len(block.values) > max(PIECES) for block in space.blocks) and coarse.name not in without:
                self._drawn = coarse
            drawn = [coarse] if self._drawn is coarse else []
            alternating, perturbed = AlternatingVertices(space, generator), Perturbation(space, generator)
            if space.small:
                self._first = [constant, perturbed, descent]
            elif len(space.blocks) > 1:
                self._first = [alternating, constant, constant, *drawn, descent, constant]
            else:
                self._first = [alternating, constant, perturbed, *drawn, descent]
            self._first += drawn * (OPENING - 1)
            self._leading = self._drawn if surrogate.name in without else surrogate
            self._first = [each for each in self._first if each.name not in without]
            self._others = [each for each in self._others if each.name not in without] or [self._drawn]
        self._late = [*self._others, self._leading]
        self._turn = 0
        self._values: deque[float] = deque(maxlen=FLAT_VALUES)

    @property
    def flat(self) -> bool:
        """True if nearly all of the last values are the same."""
        count = len(self._values)
        return count > 1 and Counter(self._values).most_common(1)[0][1] >= FLAT * count

    def next(self) -> Proposal:
        """Return the next point and the strategy that proposes it."""
        while (opening := next((each for each in self._first if each.ready), None)) is not None:
            point = opening.propose()
            # one point for each entry of a strategy, and for the last one all that are left
            if point is None or self._first.count(opening) > 1 or opening is self._drawn:
                self._first.remove(opening)
            if point is not None:
                return Proposal(opening, point)
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
                return self._leading
            return self._drawn if self._turn % 9 else _rotated(self._others)
        if self._turn % 3 == 0:
            return self._drawn
        if self._turn % 3 == 1:
            return min(self._late, key=lambda each: each.best)
        return _rotated(self._late)

    def observe(self, point: Point, value: float) -> None:
        """Report the guidance value at a point that no strategy proposed."""
        for each in self._learning():
            each.observe(point, value)

    def tell(self, proposal: Proposal, value: float) -> None:
        """Report the guidance value at a point to its strategy, and to those that learn from others.

        Args:
            proposal: the point and its strategy.
            value: guidance value at the point.
        """
        self._values.append(value)
        proposal.strategy.tell(proposal.point, value)
        for other in self._learning():
            if other is not proposal.strategy:
                other.observe(proposal.point, value)

    def _learning(self) -> Sequence[Strategy]:
        """Strategies that learn from the points of others."""
        if self._sensitive is not None:
            return (self._sensitive,)
        return tuple(dict.fromkeys((*self._late, *self._first)))


def _rotated(strategies: list[Strategy]) -> Strategy:
    """Return the first strategy of a list, which becomes the last one."""
    strategies.append(strategies.pop(0))
    return strategies[-1]
