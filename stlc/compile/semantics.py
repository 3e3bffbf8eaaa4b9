"""What "max" means: exactly, or smoothly enough for a gradient to see more than one operand.

A semantics says how a maximum and a minimum of robustness values are taken; everything else about formulas is
the same for all of them (`stlc.compile.graph`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Literal, Protocol, TypeAlias, final

from stlc.compile.ops import Array, Ops
from stlc.registry import Registry

TOLERANCE = 1e-6
"""A robustness of at least minus this, in float64, is satisfied (time and start states lie on grids)."""

Pick: TypeAlias = Literal["min", "max"]


class Semantics(Protocol):
    """How extrema are taken. Values are `(time, batch)`; infinite ones are neutral and carry no gradient.

    `idempotent` says that `pick(a, a) == a`, so that windows may be covered with overlapping pieces.
    """

    @property
    def idempotent(self) -> bool:
        """Whether an operand may be counted twice."""

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        """The extremum of two values, elementwise."""

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        """The extremum of one or more values, elementwise."""

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        """The extremum over time: `(time, batch)` -> `(1, batch)`."""


SEMANTICS: Registry[type[Semantics]] = Registry("semantics")


@SEMANTICS.register("exact")
@final
@dataclass(frozen=True, slots=True)
class Exact:
    """Minimum and maximum as they are; the gradient is a subgradient (ties share it)."""

    @property
    def idempotent(self) -> bool:
        """An operand may be counted twice."""
        return True

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        """The extremum of two values."""
        return ops.minimum(a, b) if pick == "min" else ops.maximum(a, b)

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        """The extremum of one or more values."""
        return reduce(ops.minimum if pick == "min" else ops.maximum, items)

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        """The extremum over time."""
        return ops.amin(x) if pick == "min" else ops.amax(x)


@SEMANTICS.register("smooth")
@final
@dataclass(frozen=True, slots=True)
class LogSumExp:
    """The paper's smooth operators (its equation for the approximated robustness score).

    `max(x) = log(sum(exp(k x))) / k`, which overestimates by at most log(n) / k, and
    `min(x) = -max(-x)`, which underestimates by as much. Infinite operands are neutral.
    """

    k: float = 500.0

    @property
    def idempotent(self) -> bool:
        """An operand that is counted twice weighs twice."""
        return False

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
