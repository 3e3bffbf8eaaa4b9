"""Random numbers of simulated worlds that are given instead of drawn, so that a search can choose them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

MOST_NUMBERS = 512
"""Numbers of one call at most that are given: larger calls draw tables, or many candidates at once."""
MOST_VALUES = 2**31
"""Range of integers up to which they are given: larger ones are seeds of other generators."""
_INSIDE = 1e-9


class Tape(TorchFunctionMode):
    """Random numbers of several simulations, each read from a point of the unit cube.

    While the tape is in effect, `torch.rand`, `randn`, `randint` and `randperm` still draw from their
    generators; then the numbers for which the simulation's point has coordinates are replaced by the
    quantiles at these. The numbers of one simulation are numbered in the order of its calls. Numbers from
    other libraries, such as a NumPy generator that a world makes, are not replaced.

    Attributes:
        points: a point per simulation, (count, dim) float64 in [0, 1].
        used: number of random numbers that each simulation asked for until now, replaced or not, (count,).
    """

    def __init__(self, points: Tensor) -> None:
        super().__init__()
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
        """Context in which the tape is in effect.

        `row`: simulation to which numbers from other generators belong; None: they are drawn as usual.
        """
        self._row = row
        try:
            with self:
                yield
        finally:
            self._row = None

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Call a function of torch, and replace the numbers that it draws."""
        options = dict(kwargs or {})
        drawn = func(*args, **options)
        if func not in _READERS:
            return drawn
        generator = options.get("generator")
        row = self._row if generator is None else self._owners.get(id(generator), self._row)
        if row is None or drawn.numel() > MOST_NUMBERS:
            return drawn
        if func is torch.randint and _span(args, options) > MOST_VALUES:
            return drawn
        first = self.used[row]
        self.used[row] = first + drawn.numel()
        given = self.points[row, first : self.used[row]].clamp(0.0, 1.0 - 2.0**-53)
        return _READERS[func](drawn, given, args, options) if len(given) else drawn


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


_READERS: dict[Callable[..., Any], Callable[..., Tensor]] = {
    torch.rand: _uniforms,
    torch.randn: _normals,
    torch.randint: _integers,
    torch.randperm: _permutation,
}


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
