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
    `TapedGenerator`; numbers of other libraries are drawn as usual.

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
        if name == "randint" and _span(args, options) > MOST_VALUES:
            return drawn
        given = torch.from_numpy(self.given(row, drawn.numel()))
        return _READERS[name](drawn, given, args, options) if len(given) else drawn


class TapedGenerator(np.random.Generator):
    """NumPy generator whose numbers are read from the point of a simulation, as far as the point goes.

    The methods below read quantiles; all other methods draw as usual.
    """

    def __init__(
        self, source: np.random.BitGenerator, given: Callable[[int], NDArray[np.float64]] | None = None
    ) -> None:
        super().__init__(source)
        self._given = given

    def _quantiles(self, size: Any) -> Any:
        """Quantiles in [0, 1), from the point and then drawn; a float if `size` is None."""
        count = 1 if size is None else int(np.prod(size))
        known = self._given(count) if self._given is not None and count <= MOST_NUMBERS else np.zeros(0)
        found = np.concatenate((known, super().random(count - len(known))))
        return float(found[0]) if size is None else found.reshape(size)

    def random(self, size: Any = None, *_: Any, **__: Any) -> Any:
        """Uniform numbers in [0, 1)."""
        return self._quantiles(size)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """Uniform numbers from `low` to `high`."""
        shape = np.broadcast_shapes(np.shape(low), np.shape(high))
        drawn = self._quantiles(shape if size is None and shape else size)
        return low + (np.subtract(high, low) if shape else high - low) * drawn

    def integers(self, low: Any, high: Any = None, size: Any = None, *_: Any, **__: Any) -> Any:
        """Whole numbers from `low`, inclusive, to `high`, exclusive; from 0 to `low` if `high` is None."""
        first, last = (0, low) if high is None else (low, high)
        drawn = np.floor(first + (last - first) * self._quantiles(size))
        return int(drawn) if size is None else drawn.astype(np.int64)

    def standard_normal(self, size: Any = None, *_: Any, **__: Any) -> Any:
        """Normal numbers with mean 0 and standard deviation 1."""
        drawn = torch.as_tensor(self._quantiles(size), dtype=torch.float64).clamp(_INSIDE, 1.0 - _INSIDE)
        found = torch.special.ndtri(drawn).numpy()
        return float(found) if size is None else found

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """Normal numbers with mean `loc` and standard deviation `scale`."""
        return loc + scale * self.standard_normal(size)

    def permutation(self, x: Any, *_: Any, **__: Any) -> Any:
        """Shuffled copy of `x`, along its first axis, or of the whole numbers below `x`."""
        values = np.arange(x) if isinstance(x, int | np.integer) else np.asarray(x)
        return values[np.argsort(self._quantiles(len(values)), kind="stable")]

    def choice(
        self, a: Any, size: Any = None, replace: bool = True, p: Any = None, *_: Any, **__: Any
    ) -> Any:
        """Elements of `a`, with the probabilities `p` if these are given."""
        values = np.arange(a) if isinstance(a, int | np.integer) else np.asarray(a)
        if not replace and size is not None:
            if p is not None:
                return super().choice(a, size, replace=False, p=p)
            return self.permutation(values)[: int(np.prod(size))].reshape(size)
        drawn = self._quantiles(size)
        if p is None:
            return values[np.floor(len(values) * np.asarray(drawn)).astype(np.int64)]
        return values[np.minimum(np.searchsorted(np.cumsum(p), drawn, side="right"), len(values) - 1)]


def _replaced(drawn: Tensor, values: Tensor) -> Tensor:
    """Copy of `drawn` whose first numbers are `values`, (k,)."""
    found = drawn.flatten().clone()
    found[: len(values)] = values.to(found.dtype)
    return found.view(drawn.shape)


def _uniforms(drawn: Tensor, given: Tensor, *_: Any) -> Tensor:
    return _replaced(drawn, given)


def _normals(drawn: Tensor, given: Tensor, *_: Any) -> Tensor:
    return _replaced(drawn, torch.special.ndtri(given.clamp(_INSIDE, 1.0 - _INSIDE)))


def _integers(drawn: Tensor, given: Tensor, args: tuple[Any, ...], options: Mapping[str, Any]) -> Tensor:
    low = _low(args, options)
    return _replaced(drawn, low + torch.floor(given * _span(args, options)))


def _permutation(drawn: Tensor, given: Tensor, *_: Any) -> Tensor:
    return torch.argsort(given, stable=True).to(drawn.dtype) if len(given) == len(drawn) else drawn


_READERS: dict[str, Callable[..., Tensor]] = {
    "rand": _uniforms,
    "randn": _normals,
    "randint": _integers,
    "randperm": _permutation,
}
"""Functions of torch that are replaced while a tape is in effect."""


def _low(args: tuple[Any, ...], options: Mapping[str, Any]) -> int:
    """Least value of a call of `randint(high, size)` or `randint(low, high, size)`."""
    if "low" in options:
        return int(options["low"])
    return int(args[0]) if len(args) > 1 and isinstance(args[1], int) else 0


def _span(args: tuple[Any, ...], options: Mapping[str, Any]) -> float:
    """Number of values of a call of `randint`."""
    low = _low(args, options)
    if "high" in options:
        return float(int(options["high"]) - low)
    numbers = [each for each in args[:2] if isinstance(each, int)]
    return float(numbers[-1] - low) if numbers else math.inf
