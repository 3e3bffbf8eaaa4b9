"""Search for drives: climbing that learns which of the many random numbers of a world matter.

A world draws hundreds of random numbers, most of which change nothing: rejected candidates, or obstacles that
are never reached. If a change of some coordinates leaves the robustness as it was, bit for bit, none of
them matters to that drive. So the changed coordinates of every simulation are a group test (Dorfman 1943),
from which the strategy learns the share of each coordinate in the changes to come.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import Point, SearchSpace
from stlc.assurance.strategies import Strategy

KEPT = 12
"""Least robust points from which changed points are made."""
FRESH = 0.25
"""Share of the proposals that are uniform, so that the search goes on elsewhere too."""
FIRST = 24
"""Uniform points before the first change."""
LEAST, MOST = 0.01, 8.0
"""Bounds of the weight of a coordinate, which is 1 at first."""
FADED, RISEN = 0.6, 1.5
"""Factors of the weights of changed coordinates, after a simulation without and with an effect."""
GROWTH = 1.15
"""Factor by which the number of changed coordinates grows after a simulation without an effect."""
WIDTHS = (0.02, 0.1, 0.3)
"""Standard deviations of changes, in the unit cube."""
REDRAWN = 0.4
"""Share of the changed coordinates that are drawn anew instead."""
TIRED = 40
"""Changed points without progress after which a kept point is given up."""


@dataclass(slots=True)
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


class SensitiveClimbing(Strategy):
    """Changed copies of the least robust points, in coordinates that have had an effect before."""

    name = "sensitive climbing"

    def __init__(self, space: SearchSpace, generator: np.random.Generator) -> None:
        super().__init__(space, generator)
        self._weights = np.ones(space.dim)
        self._size = max(1.0, 0.05 * space.dim)
        self._kept: list[_Kept] = []
        self._open: dict[int, _Change] = {}
        self._made = 0

    def propose(self) -> Point:
        self._made += 1
        if self._made <= FIRST or not self._kept or self.generator.random() < FRESH:
            return self.generator.random(self.space.dim)
        parent = self._parent()
        coordinates = self._coordinates()
        point = parent.point.copy()
        point[coordinates] = self._changed(point[coordinates])
        self._open[id(point)] = _Change(point, parent, coordinates)
        return point

    def tell(self, point: Point, value: float) -> None:
        super().tell(point, value)
        change = self._open.pop(id(point), None)
        if change is None:
            self._keep(point, value)
            return
        parent, effect = change.parent, value != change.parent.value
        factor = RISEN if effect else FADED
        weights = self._weights[change.coordinates]
        if effect:  # one of the coordinates is the cause, so each gets its part of the rise
            factor = 1.0 + (RISEN - 1.0) / math.sqrt(len(weights))
        self._weights[change.coordinates] = np.clip(weights * factor, LEAST, MOST)
        self._size = min(max(self._size * (1.0 / GROWTH if effect else GROWTH), 1.0), self.space.dim)
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
    def weights(self) -> NDArray[np.float64]:
        """Weight of each coordinate in the choice of changes, (dim,)."""
        return self._weights

    def _parent(self) -> _Kept:
        """One of the kept points; the least robust half of them is chosen more often."""
        ranks = np.arange(len(self._kept))
        share = np.exp(-2.0 * ranks / max(len(ranks), 1))
        return self._kept[int(self.generator.choice(len(ranks), p=share / share.sum()))]

    def _coordinates(self) -> NDArray[np.int64]:
        """Coordinates to change, about `_size` of them, by their weights."""
        count = min(max(1, int(self.generator.poisson(self._size))), self.space.dim)
        keys = np.log(self.generator.random(self.space.dim)) / self._weights  # Efraimidis and Spirakis 2006
        return np.argpartition(keys, -count)[-count:]

    def _changed(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """New values for some coordinates: drawn anew, or moved by one of three widths."""
        generator = self.generator
        width = WIDTHS[int(generator.integers(len(WIDTHS)))]
        moved = values + width * generator.standard_normal(len(values))
        inside = np.abs(np.mod(moved + 1.0, 2.0) - 1.0)  # reflected at the ends
        anew = generator.random(len(values)) < REDRAWN
        return np.where(anew, generator.random(len(values)), np.clip(inside, 0.0, 1.0))

    def _keep(self, point: Point, value: float) -> None:
        """Keep a point if it is among the least robust ones and its value is new."""
        if not math.isfinite(value) or any(each.value == value for each in self._kept):
            return
        self._kept.append(_Kept(point, value))
        self._sorted()

    def _sorted(self) -> None:
        self._kept.sort(key=lambda each: each.value)
        del self._kept[KEPT:]
