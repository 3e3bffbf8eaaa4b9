"""Extrema as they are, and the paper's smooth ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, final

from stlc.compile.backends.array.namespace import Array, Ops, Pick
from stlc.compile.semantics.protocol import Associative


@final
@dataclass(frozen=True, slots=True)
class Exact(Associative):
    """Minimum and maximum as they are (Fainekos and Pappas 2009; Donzé and Maler 2010).

    Sound: a positive value means satisfied, a negative one violated, and it stays so while no predicate
    changes by as much as the value. The gradient is a subgradient: operands that attain the extremum get it.
    """

    exact: ClassVar[bool] = True
    idempotent: ClassVar[bool] = True
    associative: ClassVar[bool] = True
    sound: ClassVar[bool] = True
    bounded: ClassVar[bool] = True

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        """The extremum of two values."""
        return ops.join([a, b], pick)

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        """The extremum of one or more values."""
        return ops.join(items, pick)

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        """The extremum over time."""
        return ops.amin(x) if pick == "min" else ops.amax(x)


@final
@dataclass(frozen=True, slots=True)
class LogSumExp(Associative):
    """The paper's smooth operators (its equation for the approximated robustness score).

    `max(x) = log(sum(exp(k x))) / k`, which overestimates by at most log(n) / k, and `min(x) = -max(-x)`,
    which underestimates by as much.

    Not sound: a value nearer to 0 than what all operators on the way may be off by says nothing. Where only
    minima are taken a positive value means satisfied, where only maxima are taken a negative one violated.

    Attributes:
        k: the scale; the larger, the nearer to the exact extrema.
    """

    k: float = 500.0

    exact: ClassVar[bool] = False
    idempotent: ClassVar[bool] = False
    associative: ClassVar[bool] = True
    sound: ClassVar[bool] = False
    bounded: ClassVar[bool] = True

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        """The smooth extremum of two values."""
        return ops.softmax2(a, b, self.k if pick == "max" else -self.k)

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        """The smooth extremum of one or more values."""
        if len(items) == 1:
            return items[0]
        if len(items) == 2:
            return self.pair(items[0], items[1], pick, ops)
        return self.reduce(ops.stack(items), pick, ops)[0]

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        """The smooth extremum over time."""
        if len(x) == 1:
            return x
        return ops.softmax(x, self.k if pick == "max" else -self.k)
