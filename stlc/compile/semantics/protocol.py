"""Protocol of a semantics: extrema of values, at once and piece by piece."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol, TypeAlias

from stlc.compile.backends.array.namespace import Array, Ops
from stlc.compile.schedule.schedule import Pick

Parts: TypeAlias = tuple[Array, ...]
"""Partial result of an extremum: the extremum itself, or sums that it follows from."""


class Semantics(Protocol):
    """Definition of extrema. Values are `(time, batch)`; infinite ones are neutral and carry no gradient.

    Windows are put together piece by piece: operands are lifted to `Parts`, the parts of some operands and
    those of others are merged, and in the end parts become a value.

    Attributes:
        exact: the value is that of an operand, so that an array library may find it in its own way.
        idempotent: an operand may be counted twice, so that windows may be covered with overlapping pieces.
        associative: the extremum of extrema is that of all their operands.
        sound: no value is positive where the exact one is negative, nor negative where it is positive.
        bounded: an operand that is not known may be put at its ends, infinite ones included, to bound the
            value. Means leave infinite operands out, and a finite one counts: their value may be beyond.
    """

    exact: ClassVar[bool]
    idempotent: ClassVar[bool]
    associative: ClassVar[bool]
    sound: ClassVar[bool]
    bounded: ClassVar[bool]

    def lift(self, x: Array, pick: Pick, ops: Ops) -> Parts:
        """The parts of every operand alone."""

    def merge(self, a: Parts, b: Parts, pick: Pick, ops: Ops) -> Parts:
        """The parts of two disjoint sets of operands together, elementwise."""

    def finish(self, parts: Parts, pick: Pick, ops: Ops) -> Array:
        """The value that the parts stand for."""

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        """The extremum of two values, elementwise."""

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        """The extremum of one or more values, elementwise; one alone stands for itself."""

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        """The extremum over time: `(time, batch)` -> `(1, batch)`; one sample stands for itself."""


class Associative:
    """For a semantics of which pairs say everything: the parts are the extremum so far."""

    __slots__ = ()

    def lift(self, x: Array, pick: Pick, ops: Ops) -> Parts:  # noqa: ARG002
        """The operand."""
        return (x,)

    def merge(self: Semantics, a: Parts, b: Parts, pick: Pick, ops: Ops) -> Parts:
        """The extremum of both."""
        return (self.pair(a[0], b[0], pick, ops),)

    def finish(self, parts: Parts, pick: Pick, ops: Ops) -> Array:  # noqa: ARG002
        """The extremum so far."""
        return parts[0]
