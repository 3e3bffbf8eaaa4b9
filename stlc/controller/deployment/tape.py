"""Random numbers of simulated worlds that are given instead of drawn, so that a search can choose them."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

MOST_NUMBERS = 512
"""Numbers of one call at most that are given: larger calls draw tables, or many candidates at once."""
MOST_VALUES = 2**31
"""Range of integers up to which they are given: larger ones are seeds of other generators."""
_INSIDE = 1e-9
BELOW = 1.0 - 2.0**-53
"""Largest quantile."""


class Tape:
    """Random numbers of several simulations, each read from a point of the unit cube.

    While the tape is in effect, `torch.rand`, `randn`, `randint` and `randperm` are replaced in the module
    `torch`. They still draw from their generators; then the numbers for which the simulation's point has
    coordinates are replaced by the quantiles at these. The numbers of one simulation are numbered in the
    order of its calls. A generator that a world makes by `numpy.random.default_rng(SEED)` is replaced by a
    `TapedGenerator`, which does the same; numbers of other libraries are drawn as usual.

    Attributes:
        points: a point per simulation, (count, dim) float64 in [0, 1].
        used: number of random numbers that each simulation asked for until now, replaced or not, (count,).
    """

    def __init__(self, points: Tensor) -> None:
        self.points = points
        self.used = [0] * len(points)
        self._owners: dict[int, int] = {}
        self._kept: list[torch.Generator] = []
        self._row: int | None = None

    def own(self, generators: Sequence[torch.Generator]) -> None:
        """Count the numbers from `generators`, one per simulation, as those of their simulations."""
        for row, generator in enumerate(generators):
            self._owners[id(generator)] = row
            self._kept.append(generator)

    @contextmanager
    def drawing(self, row: int | None = None) -> Iterator[None]:
        """Context in which the tape is in effect, in this thread.

        `row`: simulation to which numbers from other generators belong; None: they are drawn as usual.
        """
        self._row, thread = row, threading.get_ident()
        usual = {name: getattr(torch, name) for name in _READERS}
        seeded = np.random.default_rng

        def read(name: str) -> Callable[..., Tensor]:
            def drawn(*args: Any, **options: Any) -> Tensor:
                found: Tensor = usual[name](*args, **options)
                return self._read(name, found, args, options) if threading.get_ident() == thread else found

            return drawn

        def generator(seed: Any = None) -> np.random.Generator:
            if row is None or seed is None or threading.get_ident() != thread:
                return seeded(seed)
            return TapedGenerator(seeded(seed).bit_generator, lambda count: self.given(row, count))

        try:
            for name in _READERS:
                setattr(torch, name, read(name))
            np.random.default_rng = generator
            yield
        finally:
            for name, function in usual.items():
                setattr(torch, name, function)
            np.random.default_rng, self._row = seeded, None

    def given(self, row: int, count: int) -> NDArray[np.float64]:
        """Coordinates for the next `count` numbers of a simulation, (k,); fewer where its point ends."""
        first = self.used[row]
        self.used[row] = first + count
        found: NDArray[np.float64] = self.points[row, first : first + count].clamp(0.0, BELOW).numpy()
        return found

    def _read(self, name: str, drawn: Tensor, args: tuple[Any, ...], options: Mapping[str, Any]) -> Tensor:
        """Numbers of one call, with those replaced for which the simulation's point has coordinates."""
        generator = options.get("generator")
        row = self._row if generator is None else self._owners.get(id(generator), self._row)
        if row is None or drawn.numel() > MOST_NUMBERS:
            return drawn
        if name == "randint" and _ends(args, options)[1] > MOST_VALUES:
            return drawn
        given = torch.from_numpy(self.given(row, drawn.numel()))
        return _READERS[name](drawn, given, args, options) if len(given) else drawn


class TapedGenerator(np.random.Generator):
    """NumPy generator whose numbers are read from the point of a simulation, as far as the point goes.

    The methods below draw as usual, which also checks their arguments; then the numbers for which the point
    has coordinates are replaced by the quantiles at these. All other methods draw as usual.
    """

    def __init__(
        self, source: np.random.BitGenerator, given: Callable[[int], NDArray[np.float64]] | None = None
    ) -> None:
        super().__init__(source)
        self._given = given
        self._usual = np.random.Generator(source)

    def _coordinates(self, count: int) -> NDArray[np.float64]:
        """Coordinates for the next `count` numbers, (k,); fewer where the point ends."""
        return np.zeros(0) if self._given is None or count > MOST_NUMBERS else self._given(count)

    def _read(self, drawn: Any, quantiles: Callable[..., Any], *parameters: Any) -> Any:
        """Numbers of one call, a scalar or in place, with those replaced for which there are coordinates.

        `quantiles`: function of coordinates (k,), and of as many values of each parameter.
        """
        given = self._coordinates(np.size(drawn))
        if not len(given):
            return drawn
        each = (np.broadcast_to(values, np.shape(drawn)).ravel()[: len(given)] for values in parameters)
        found = quantiles(given, *each)
        if not isinstance(drawn, np.ndarray):
            return type(drawn)(found[0])
        drawn.reshape(-1)[: len(given)] = found
        return drawn

    def random(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Uniform numbers in [0, 1)."""
        below = 1.0 - np.finfo(dtype).epsneg
        return self._read(self._usual.random(size, dtype, out), lambda at: np.minimum(at, below))

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Uniform numbers from `low` to `high`."""
        drawn = self._usual.uniform(low, high, size)
        return self._read(drawn, lambda at, low, high: low + (high - low) * at, low, high)

    def integers(
        self, low: Any, high: Any = None, size: Any = None, dtype: Any = np.int64, endpoint: bool = False
    ) -> Any:
        """Whole numbers from `low` to `high`, exclusive unless `endpoint`; from 0 if `high` is None."""
        drawn = self._usual.integers(low, high, size, dtype, endpoint)
        first, last = (0, low) if high is None else (low, high)
        span = np.asarray(last) - np.asarray(first) + int(endpoint)
        if np.any(span > MOST_VALUES):
            return drawn
        return self._read(
            drawn, lambda at, first, span: first + np.floor(span * at).astype(np.int64), first, span
        )

    def standard_normal(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """Normal numbers with mean 0 and standard deviation 1."""
        return self._read(self._usual.standard_normal(size, dtype, out), _standard_normals)

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """Normal numbers with mean `loc` and standard deviation `scale`."""
        drawn = self._usual.normal(loc, scale, size)
        return self._read(drawn, lambda at, loc, scale: loc + scale * _standard_normals(at), loc, scale)

    def permutation(self, x: Any, axis: int = 0) -> Any:
        """Shuffled copy of `x`, along an axis, or of the whole numbers below `x`."""
        drawn = self._usual.permutation(x, axis)
        values = np.arange(x) if isinstance(x, int | np.integer) else np.asarray(x)
        given = self._coordinates(values.shape[axis])
        whole = len(given) == values.shape[axis]
        return np.take(values, np.argsort(given, kind="stable"), axis) if whole else drawn

    def choice(
        self,
        a: Any,
        size: Any = None,
        replace: bool = True,
        p: Any = None,
        axis: int = 0,
        shuffle: bool = True,
    ) -> Any:
        """Elements of `a`, along an axis, with the probabilities `p` if these are given."""
        if not replace and size is not None and p is not None:
            return super().choice(a, size, replace, p, axis, shuffle)  # which calls `random`
        plain = isinstance(a, int | np.integer)
        count = a if plain else np.shape(a)[axis]
        places = self._usual.choice(count, size, replace, p, 0, shuffle)
        if replace or size is None:
            ends = None if p is None else np.cumsum(p)[:-1]
            places = self._read(
                places,
                lambda at: np.floor(count * at) if ends is None else np.searchsorted(ends, at, side="right"),
            )
        elif len(given := self._coordinates(count)) == count:
            places = np.argsort(given, kind="stable")[: np.size(places)].reshape(np.shape(places))
        return places if plain else np.take(a, places, axis)


def _standard_normals(at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Same as `_normal_quantiles`, for NumPy."""
    found: NDArray[np.float64] = _normal_quantiles(torch.from_numpy(at)).numpy()
    return found


def _normal_quantiles(at: Tensor) -> Tensor:
    """Quantiles of the standard normal distribution."""
    found: Tensor = torch.special.ndtri(at.clamp(_INSIDE, 1.0 - _INSIDE))
    return found


def _replaced(drawn: Tensor, values: Tensor) -> Tensor:
    """Copy of `drawn` whose first numbers are `values`, (k,)."""
    found = drawn.flatten().clone()
    found[: len(values)] = values.to(found.dtype)
    return found.view(drawn.shape)


_READERS: dict[str, Callable[..., Tensor]] = {
    "rand": lambda drawn, at, *_: _replaced(drawn, at.clamp(max=1.0 - 0.5 * torch.finfo(drawn.dtype).eps)),
    "randn": lambda drawn, at, *_: _replaced(drawn, _normal_quantiles(at)),
    "randint": lambda drawn, at, *call: _replaced(drawn, _ends(*call)[0] + torch.floor(at * _ends(*call)[1])),
    "randperm": lambda drawn, at, *_: (
        torch.argsort(at, stable=True).to(drawn.dtype) if len(at) == len(drawn) else drawn
    ),
}
"""Functions of torch that are replaced while a tape is in effect."""


def _ends(args: tuple[Any, ...], options: Mapping[str, Any]) -> tuple[int, float]:
    """Least value, and number of values, of a call of `randint(high, size)` or `randint(low, high, size)`."""
    numbers = [int(each) for each in args[:2] if isinstance(each, int | np.integer)]
    high = int(options["high"]) if "high" in options else numbers.pop() if numbers else math.inf
    low = int(options["low"]) if "low" in options else numbers.pop() if numbers else 0
    return low, high - low
