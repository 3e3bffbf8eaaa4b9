"""Scratch memory that stays: mapping fresh pages costs more than the arithmetic that is done in them."""

from __future__ import annotations

import math
import threading
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from typing import final

from stlc.compile.backends.array.namespace import Array, Ops

_KEPT = 1 << 22
"""The most numbers of one kind that a thread keeps."""


@final
class Scratch:
    """A stretch of memory that arrays are cut from, one after the other; all are given back at once."""

    def __init__(self, memory: Array) -> None:
        self._memory = memory
        self._used = 0

    def take(self, *shape: int) -> Array:
        """An array of this shape; what is in it is left over from before."""
        first, self._used = self._used, self._used + math.prod(shape)
        return self._memory[first : self._used].reshape(shape)

    @contextmanager
    def lent(self, *shape: int) -> Iterator[Array]:
        """An array for a while; whatever is taken within is given back with it."""
        used = self._used
        try:
            yield self.take(*shape)
        finally:
            self._used = used

    def clear(self) -> None:
        """Give everything back."""
        self._used = 0


class _Shelf(threading.local):
    """What a thread keeps, by library, dtype and device."""

    def __init__(self) -> None:
        self.memories: dict[Hashable, Array] = {}


_SHELF = _Shelf()


@contextmanager
def scratch(numbers: int, like: Array, ops: Ops) -> Iterator[Scratch]:
    """Room for so many numbers of the kind of `like`."""
    kind = (ops.name, like.dtype, getattr(like, "device", None))
    memory = _SHELF.memories.pop(kind, None)
    if memory is None or len(memory) < numbers:
        memory = ops.empty((numbers,), like)
    try:
        yield Scratch(memory)
    finally:
        if len(memory) <= _KEPT:
            _SHELF.memories[kind] = memory
