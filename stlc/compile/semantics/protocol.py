"""Protocol of a semantics: extrema of values, at once and by merging partial results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol, TypeAlias

from stlc.compile.backends.array.namespace import Array, Ops
from stlc.compile.schedule.schedule import Pick

Parts: TypeAlias = tuple[Array, ...]
"""Partial result of an extremum: the extremum so far, or sums that determine it."""


class Semantics(Protocol):
    """Definition of extrema. Values are `(time, batch)`; infinite ones are neutral and have no gradient.

    Windows are computed by merging: operands are lifted to `Parts`, parts of disjoint sets are merged, and
    `finish` converts parts to a value.

    Attributes:
        exact: the value is that of an operand, so that native extrema of the array library apply.
        idempotent: repeated operands do not matter, so that overlapping blocks may cover a window.
        associative: the extremum of extrema is that of all their operands.
        sound: no value is positive where the exact one is negative, nor negative where it is positive.
        bounded: replacing unknown operands by their bounds, even infinite ones, bounds the value. Means
            omit infinite operands, so that a finite one may exceed such a bound.
    """

    exact: ClassVar[bool]
    idempotent: ClassVar[bool]
    associative: ClassVar[bool]
    sound: ClassVar[bool]
    bounded: ClassVar[bool]

    def lift(self, x: Array, pick: Pick, ops: Ops) -> Parts:
        """Return the parts of each single operand."""

    def merge(self, a: Parts, b: Parts, pick: Pick, ops: Ops) -> Parts:
        """Merge the parts of two disjoint sets of operands, elementwise."""

    def finish(self, parts: Parts, pick: Pick, ops: Ops) -> Array:
        """Return the value of parts."""

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        """The extremum of two values, elementwise."""

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        """The extremum of one or more values, elementwise; a single one is unchanged."""

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        """The extremum over time: `(time, batch)` -> `(1, batch)`; a single sample is unchanged."""


class Associative:
    """Base of associative semantics: the parts are the extremum so far."""

    __slots__ = ()

    def lift(self, x: Array, pick: Pick, ops: Ops) -> Parts:  # noqa: ARG002
        """Return the operands, unchanged."""
        return (x,)

    def merge(self: Semantics, a: Parts, b: Parts, pick: Pick, ops: Ops) -> Parts:
        """Return the extremum of both."""
        return (self.pair(a[0], b[0], pick, ops),)

    def finish(self, parts: Parts, pick: Pick, ops: Ops) -> Array:  # noqa: ARG002
        """Return the extremum so far."""
        return parts[0]
