"""Search space of falsification: the unit cube of everything that a simulation draws at random.

A coordinate is the quantile of one random number: a part of the initial state, a parameter, or a value of an
input signal. A uniformly distributed point is therefore a simulation as the system file declares it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

Point = NDArray[np.float64]
"""Point of the unit cube, (dim,)."""
MOST_VERTICES, MOST_CORNERS = 64, 16
"""Maximum number of constant vertices that are simulated, and of all vertices of a small cube."""


@dataclass(frozen=True, slots=True)
class SignalBlock:
    """Coordinates of the successive values of one input signal.

    Attributes:
        name: name of the input signal.
        values: coordinates of its values, in the order of time, (pieces,).
        times: coordinates of its free switching times, in the order of time; empty if they are fixed.
        fractions: times of the values as shares of the signal's duration if the times are fixed, (pieces,).
        lead: number of pieces by which a value acts before its time, where the signal is interpolated.
        length: duration of the signal as a share of that of the longest one.
    """

    name: str
    values: tuple[int, ...]
    times: tuple[int, ...] = ()
    fractions: tuple[float, ...] = ()
    lead: int = 0
    length: float = 1.0

    def acting_before(self, share: float) -> int:
        """Number of the values, at least one, that act before a share of the longest duration, 0 to 1."""
        if self.times or not self.fractions:
            return len(self.values)
        return min(
            max(sum(each * self.length < share for each in self.fractions), 1) + self.lead, len(self.values)
        )


@dataclass(frozen=True, slots=True)
class SearchSpace:
    """The unit cube with the meaning of its coordinates.

    Attributes:
        dim: number of coordinates.
        blocks: input signals.
        sparse: whether most coordinates have no effect on most simulations.
    """

    dim: int
    blocks: tuple[SignalBlock, ...] = ()
    sparse: bool = False

    @property
    def rest(self) -> tuple[int, ...]:
        """Coordinates that belong to no input signal."""
        taken = {each for block in self.blocks for each in (*block.values, *block.times)}
        return tuple(each for each in range(self.dim) if each not in taken)

    @property
    def small(self) -> bool:
        """True if all vertices of the cube are simulated at the beginning of a search."""
        return bool(2**self.dim <= MOST_CORNERS)

    def visible(self, share: float) -> PartOfSpace:
        """The part of the space in which inputs are varied up to a share of their duration, 0 to 1."""
        blocks, dropped = list[SignalBlock](), set[int]()
        for block in self.blocks:
            count = block.acting_before(share)
            dropped |= set(block.values[count:])
            blocks.append(replace(block, values=block.values[:count], fractions=block.fractions[:count]))
        kept = [each for each in range(self.dim) if each not in dropped]
        index = {old: new for new, old in enumerate(kept)}
        moved = tuple(
            replace(
                block,
                values=tuple(index[each] for each in block.values),
                times=tuple(index[each] for each in block.times),
            )
            for block in blocks
        )
        return PartOfSpace(SearchSpace(len(kept), moved, self.sparse), tuple(kept), self.dim)

    def middle(self) -> Point:
        """Centre of the cube, (dim,); free switching times are evenly spread."""
        point = np.full(self.dim, 0.5)
        for block in self.blocks:
            point[list(block.times)] = (np.arange(len(block.times)) + 1.0) / (len(block.times) + 1.0)
        return point

    def constant_vertices(self) -> Iterator[Point]:
        """Points at which each input is constant at an end of its range, and other numbers at ends of theirs.

        If there are too many, inputs alone are at their ends, and other numbers at their medians; with too
        many inputs, all are at the same end.
        """
        inputs = tuple(block.values for block in self.blocks)
        handles = (*inputs, *((each,) for each in self.rest))
        if 2 ** len(handles) > MOST_VERTICES:
            handles = inputs
        if not handles:
            return
        if 2 ** len(handles) > MOST_VERTICES:
            handles = (tuple(each for handle in handles for each in handle),)
        ends_of_all = product((1.0, 0.0), repeat=len(handles))
        for ends in sorted(ends_of_all, key=lambda ends: len(set(ends)) == 1):  # opposite ends first
            point = self.middle()
            for handle, end in zip(handles, ends, strict=True):
                point[list(handle)] = end
            yield point

    def corners(self) -> Iterator[Point]:
        """All vertices of the cube, those with most switches of inputs first; none if there are too many."""
        if not self.small or not self.blocks:
            return
        corners = np.array(list(product((1.0, 0.0), repeat=self.dim)))
        switches = np.zeros(len(corners))
        for block in self.blocks:
            switches += np.abs(np.diff(corners[:, list(block.values)], axis=1)).sum(1)
        yield from corners[np.argsort(-switches, kind="stable")]

    def held(self, generator: np.random.Generator, most: int = 5) -> NDArray[np.int64]:
        """Labels (dim,): coordinates with one label hold one value, in 1 to `most` pieces per input.

        The cuts between the pieces are random; a coordinate outside of inputs has a label of its own.
        """
        labels, count = np.zeros(self.dim, dtype=np.int64), 0
        for block in self.blocks:
            pieces = min(int(generator.integers(1, most + 1)), len(block.values))
            cuts = np.sort(generator.choice(np.arange(1, len(block.values)), pieces - 1, replace=False))
            labels[list(block.values)] = count + np.searchsorted(cuts, np.arange(len(block.values)), "right")
            count += pieces
            for each in block.times:
                labels[each], count = count, count + 1
        for each in self.rest:
            labels[each], count = count, count + 1
        return labels


@dataclass(frozen=True, slots=True)
class PartOfSpace:
    """Part of a search space, in which only some coordinates vary; the others are 0.5.

    Attributes:
        space: the smaller space.
        coordinates: its coordinates in the larger space, (space.dim,).
        dim: number of coordinates of the larger space.
    """

    space: SearchSpace
    coordinates: tuple[int, ...]
    dim: int

    def whole(self, point: Point) -> Point:
        """Point of the larger space, (dim,), for a point of the smaller one, (space.dim,)."""
        found = np.full(self.dim, 0.5)
        found[list(self.coordinates)] = point
        return found
