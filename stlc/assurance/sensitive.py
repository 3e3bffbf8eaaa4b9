"""Search for drives: local search that learns which of the many random numbers of a world matter.

A world draws hundreds of random numbers, most of which change nothing: rejected candidates, or obstacles that
are never reached. A change of some coordinates that leaves the robustness as it was makes it likely that none
of them matters. So every simulation is a group test (Dorfman 1943) of the coordinates that it changes, from
which the strategy learns the probability that a coordinate matters (Bayes).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import Point, SearchSpace
from stlc.assurance.strategies import Strategy

KEPT = 4
"""Least robust points from which changed points are made."""
FRESH = 0.15
"""Share of the proposals that are uniform, so that the search goes on elsewhere too."""
FIRST = 24
"""Uniform points before the first change."""
SUSPECTED = 20.0
"""Number of coordinates that are expected to matter at first."""
LEAST, MOST = 0.02, 0.9
"""Bounds of the probability that a coordinate matters; the lower one is a share of the first probability."""
MASKED = 0.5
"""Probability that a change of a coordinate that matters has no effect on the robustness."""
CHANGED = 1.2
"""Expected number of coordinates that matter among those that are changed, on average."""
EVEN = 0.15
"""Share of the changes whose coordinates are chosen evenly, so that each is tested now and then."""
SAME = 1e-5
"""Difference of robustness that counts as rounding, absolute or relative."""
WIDTHS = (0.02, 0.1, 0.3)
"""Standard deviations of changes, in the unit cube."""
REDRAWN = 0.4
"""Share of the changed coordinates that are drawn anew instead."""
TIRED = 40
"""Changed points without progress after which a kept point is given up."""


@dataclass(slots=True, eq=False)
class _Kept:
    """Point with a small robustness, and the number of its changed copies since the last better one."""

    point: Point
    value: float
    tried: int = 0


@dataclass(frozen=True, slots=True)
class _Change:
    """Changed copy of a point that waits for its robustness."""

    point: Point
    parent: _Kept
    coordinates: NDArray[np.int64]


class SensitiveSearch(Strategy):
    """Changed copies of the least robust points, in coordinates that have had an effect before."""

    name = "sensitive climbing"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._prior = min(SUSPECTED / max(space.dim, 1), 0.5)
        self._matters = np.full(space.dim, self._prior)
        self._kept: list[_Kept] = []
        self._open: dict[int, _Change] = {}
        self._made = 0

    def propose(self) -> Point:
        self._made += 1
        if self._made <= FIRST or not self._kept or self.generator.random() < FRESH:
            return self.generator.random(self.space.dim)
        ranks = np.arange(len(self._kept))
        share = np.exp(-2.0 * ranks / max(len(ranks), 1))
        parent = self._kept[int(self.generator.choice(len(ranks), p=share / share.sum()))]
        coordinates = self._coordinates()
        point = parent.point.copy()
        values = point[coordinates]
        generator = self.generator
        width = WIDTHS[int(generator.integers(len(WIDTHS)))]
        moved = values + width * generator.standard_normal(len(values))
        inside = np.abs(np.mod(moved + 1.0, 2.0) - 1.0)  # reflected at the ends
        anew = generator.random(len(values)) < REDRAWN
        point[coordinates] = np.where(anew, generator.random(len(values)), np.clip(inside, 0.0, 1.0))
        self._open[id(point)] = _Change(point, parent, coordinates)
        return point

    def tell(self, point: Point, value: float) -> None:
        super().tell(point, value)
        change = self._open.pop(id(point), None)
        if change is None:
            self._keep(point, value)
            return
        parent = change.parent
        effect = not math.isclose(value, parent.value, rel_tol=SAME, abs_tol=SAME)
        before = self._matters[change.coordinates]
        if effect:  # any of them may be the cause
            now = before * (1.0 - MASKED) / (1.0 - np.prod(1.0 - before * (1.0 - MASKED))) + before * MASKED
        else:
            now = before * MASKED / (1.0 - before * (1.0 - MASKED))
        self._matters[change.coordinates] = np.clip(now, LEAST * self._prior, MOST)
        parent.tried += 1
        if value < parent.value:
            parent.point, parent.value, parent.tried = point, value, 0
            self._sorted()
        if parent.tried > TIRED and len(self._kept) > 1 and parent in self._kept:
            self._kept.remove(parent)

    def observe(self, point: Point, value: float) -> None:
        self._made += 1
        self._keep(point, value)

    @property
    def matters(self) -> NDArray[np.float64]:
        """Probability that a coordinate matters to the robustness of the kept points, (dim,)."""
        return self._matters

    def _coordinates(self) -> NDArray[np.int64]:
        """Coordinates to change: as many as are expected to contain a few that matter."""
        random = np.log(self.generator.random(self.space.dim))
        if self.generator.random() >= EVEN:
            random /= self._matters  # drawn without replacement, by weight (Efraimidis and Spirakis 2006)
        order = np.argsort(-random)
        expected = np.cumsum(self._matters[order])
        count = int(np.searchsorted(expected, self.generator.exponential(CHANGED))) + 1
        return order[:count]

    def _keep(self, point: Point, value: float) -> None:
        """Keep a point if it is among the least robust ones and its value is new."""
        if not math.isfinite(value) or any(each.value == value for each in self._kept):
            return
        self._kept.append(_Kept(point, value))
        self._sorted()

    def _sorted(self) -> None:
        self._kept.sort(key=lambda each: each.value)
        del self._kept[KEPT:]
