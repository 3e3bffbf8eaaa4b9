"""Protocol of a robustness semantics: minima and maxima, computed at once or from partial results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol, TypeAlias

from stlc.compile.namespace import Array, Ops, Pick

Parts: TypeAlias = tuple[Array, ...]
"""Partial result for some of the operands: their extremum, or sums that determine it."""


class Semantics(Protocol):
    """Definition of minima and maxima over arrays `(time, batch)`.

    An infinite operand that does not decide the result, such as +inf in a minimum, has no influence and no
    gradient. Extrema over windows are computed from partial results: `lift` turns operands into `Parts`,
    `merge` joins the parts of disjoint sets of operands, and `finish` converts parts to a value.

    Attributes:
        exact: whether the value is always that of an operand. Minimum and maximum of the array library then
            apply.
        idempotent: whether repeated operands make no difference, so that overlapping blocks may cover a
            window.
        associative: whether operands may be grouped: `min(min(a, b), c)` is then `min(a, b, c)`.
        sound: whether every value has the sign of the exact value, or is 0.
        bounded: whether replacing unknown operands by their lower (upper) bounds, even infinite ones, gives a
            lower (upper) bound on the value. This is not so for means, since they omit infinite operands.
    """

    exact: ClassVar[bool]
    idempotent: ClassVar[bool]
    associative: ClassVar[bool]
    sound: ClassVar[bool]
    bounded: ClassVar[bool]

    def lift(self, x: Array, pick: Pick, ops: Ops) -> Parts:
        """Return the partial result (`Parts`) of each operand in `x`, taken alone.

        `pick` is the extremum to be computed, "min" or "max".
        """

    def merge(self, a: Parts, b: Parts, pick: Pick, ops: Ops) -> Parts:
        """Return the partial result of the union of two disjoint sets of operands, elementwise.

        `a` and `b` are the partial results of the two sets.
        """

    def finish(self, parts: Parts, pick: Pick, ops: Ops) -> Array:
        """Return the minimum or maximum (`pick`) of a set of operands from their partial result `parts`."""

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        """Return the minimum or maximum (`pick`) of two values, elementwise."""

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        """Return the minimum or maximum (`pick`) of one or more values, elementwise.

        A single value is returned unchanged.
        """

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        """Return the minimum or maximum (`pick`) over time: `(time, batch)` -> `(1, batch)`.

        A single sample is returned unchanged.
        """


class Associative:
    """Base of associative semantics, whose partial results are extrema themselves."""

    __slots__ = ()

    def lift(self, x: Array, pick: Pick, ops: Ops) -> Parts:  # noqa: ARG002
        """Return the operands unchanged, as partial results."""
        return (x,)

    def merge(self: Semantics, a: Parts, b: Parts, pick: Pick, ops: Ops) -> Parts:
        """Return the extremum of two partial results."""
        return (self.pair(a[0], b[0], pick, ops),)

    def finish(self, parts: Parts, pick: Pick, ops: Ops) -> Array:  # noqa: ARG002
        """Return the partial result itself, which is the minimum or maximum of its operands."""
        return parts[0]
