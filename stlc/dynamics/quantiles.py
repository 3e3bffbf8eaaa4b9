"""Initial states at points of the unit cube: the random numbers of a draw are given instead of drawn."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.dynamics.model.samplers import Rows

if TYPE_CHECKING:
    from stlc.dynamics.system import System

MOST_COORDINATES = 4096
"""Maximum number of random numbers that the draw of one initial state may use."""
_PROBED = 512
_BASES = 4
"""Points at which it is tried whether a coordinate affects a column."""
_INSIDE = 1e-9
"""Distance of quantiles from 0 and 1, where those of a normal distribution are infinite."""


class QuantileRows(Rows):
    """Random numbers that are read from points in the unit cube, one point per state.

    Every draw reads the next coordinate of each point. States that follow different branches of a mixture
    read the same coordinates; draws after the mixture continue behind the longest branch.
    """

    __slots__ = ("_branches", "_next", "points")

    def __init__(self, points: Tensor, first: int = 0) -> None:
        """Read from `points`, (count, dim) float64 in [0, 1], beginning with the coordinate `first`."""
        super().__init__(len(points), torch.Generator())
        self.points, self._next = points, first
        self._branches: list[QuantileRows] = []

    @property
    def used(self) -> int:
        """Number of coordinates read so far, on the longest branch."""
        return max([self._next, *(branch.used for branch in self._branches)])

    def uniforms(self) -> Tensor:
        """Next coordinate of each point as a number in [0, 1), (count,)."""
        place = self.used
        self._next = place + 1
        if place >= self.points.shape[1]:
            return torch.full((len(self.points),), 0.5, dtype=torch.float64)
        found: Tensor = self.points[:, place].clamp(0.0, 1.0 - 2.0**-53)
        return found

    def normals(self) -> Tensor:
        """Quantiles of the standard normal distribution at the next coordinate, (count,)."""
        found: Tensor = torch.special.ndtri(self.uniforms().clamp(_INSIDE, 1.0 - _INSIDE))
        return found

    def index(self, count: int) -> Tensor:
        """Indices from 0 to `count` - 1 at the next coordinate, (self.count,)."""
        return torch.floor(self.uniforms() * count).to(torch.int64)

    def subset(self, at: Tensor) -> Rows:
        """Numbers for the states with indices `at`, (k,); they begin where these rows stand."""
        branch = QuantileRows(self.points[at], self.used)
        self._branches.append(branch)
        return branch


class InitialPoints:
    """Map from the unit cube to the initial states of a system.

    A point that is uniformly distributed gives a state with the distribution that the system file declares,
    before the conditions of `where`.

    Attributes:
        dim: number of coordinates: random numbers that the draw of a state uses, on the longest branch.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        shape, generator = (_PROBED, MOST_COORDINATES), torch.Generator().manual_seed(0)
        rows = QuantileRows(torch.rand(shape, generator=generator, dtype=torch.float64))
        self._drawn(rows)
        self.dim = rows.used

    def states(self, points: Tensor) -> Tensor:
        """Initial states at `points`: (count, dim) in [0, 1] -> (count, n) float64, with added columns."""
        return self._drawn(QuantileRows(points.to(torch.float64)))

    def admissible(self, states: Tensor) -> Tensor:
        """Mask (count,) of the states (count, n) that meet every condition of `where`."""
        return self._system.initial.holds(states[:, : len(self._system.decl.signature.names)])

    def coordinates_of(self, columns: Sequence[str]) -> dict[str, int]:
        """Coordinate that alone determines a column, for those of `columns` that have one: name -> index."""
        found = {}
        for name in columns:
            touching = self._affecting(name)
            if len(touching) == 1:
                found[name] = touching[0]
        return found

    def last_coordinates_of(self, columns: Sequence[str]) -> tuple[int, ...]:
        """Last of the coordinates that affect each of `columns`; columns that none affects are left out."""
        return tuple(touching[-1] for touching in map(self._affecting, columns) if touching)

    def _affecting(self, column: str) -> list[int]:
        """Coordinates that affect a column, in order."""
        changed = self._sensitive[:, self._system.names.index(column)]
        found: list[int] = torch.nonzero(changed).flatten().tolist()
        return found

    @cached_property
    def _sensitive(self) -> Tensor:
        """Mask of the columns that each coordinate affects, (dim, n): each is changed at a few points."""
        generator = torch.Generator().manual_seed(0)
        base = torch.rand((_BASES, self.dim), generator=generator, dtype=torch.float64)
        moved = base[None].repeat(self.dim, 1, 1)
        each = torch.arange(self.dim)
        moved[each, :, each] = torch.rand((self.dim, _BASES), generator=generator, dtype=torch.float64)
        states = self.states(torch.cat((base[None], moved)).flatten(0, 1))
        states = states.reshape(self.dim + 1, _BASES, -1)
        return (states[1:] != states[0]).any(1)

    def _drawn(self, rows: QuantileRows) -> Tensor:
        return self._system.with_drawn(self._system.initial.proposed(rows), rows)
