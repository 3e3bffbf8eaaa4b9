"""Switches: how conditions become numbers from 0 to 1, and how a condition chooses between two values.

For example, the next state of a hybrid system is the result of its jump where the jump condition holds, and
of its flow elsewhere. `Hard` is exact. `Tanh` is the smooth approximation of Meng and Fan 2023 (Eq. 6).
`StraightThrough` has exact values with smooth gradients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol, final

from stlc.compile.namespace import Array, Ops


class Switch(Protocol):
    """Protocol of a switch, which evaluates conditions as numbers and uses them to choose between values.

    Attributes:
        exact: whether conditions are evaluated as masks of booleans, by the comparisons `>` and `>=` as
            written. If not, a condition is evaluated from its margin (robustness).
    """

    exact: ClassVar[bool]

    def indicator(self, rho: Array, strict: bool, sharpness: float | None, ops: Ops) -> Array:
        """Return the indicator of a condition, from 0 (false) to 1 (true).

        Args:
            rho: margin of the condition, which is true iff the margin is > 0 (`strict`) or >= 0.
            strict: whether the inequality is strict.
            sharpness: factor w of a smooth indicator `(1 + tanh(w rho)) / 2`; None: the default of the
                switch.
            ops: the array library.
        """

    def settle(self, weight: Array, truth: Array, ops: Ops) -> Array:
        """Return the indicator of a condition that contains both strict and non-strict inequalities.

        Where the margin of such a condition is 0, the condition may be true or false. `weight` is the
        indicator computed from the margin, `truth` the mask of the exact truth.
        """

    def blend(self, weight: Array, yes: Array | float, no: Array | float, ops: Ops) -> Array:
        """Return `no + weight * (yes - no)`, the choice between two values for an indicator `weight`."""


@final
@dataclass(frozen=True, slots=True)
class Hard:
    """Exact evaluation of conditions as 0 or 1, without gradient and without tolerance."""

    exact: ClassVar[bool] = True

    def indicator(self, rho: Array, strict: bool, sharpness: float | None, ops: Ops) -> Array:  # noqa: ARG002
        """Return 1 where the condition holds, else 0."""
        return ops.number(ops.gt(rho, 0.0) if strict else ops.ge(rho, 0.0), rho)

    def settle(self, weight: Array, truth: Array, ops: Ops) -> Array:
        """Return the mask `truth` as numbers 0 or 1; the indicator `weight` is not used."""
        return ops.number(truth, weight)

    def blend(self, weight: Array, yes: Array | float, no: Array | float, ops: Ops) -> Array:
        """Return exactly `yes` where the indicator `weight` is 1, and exactly `no` where it is 0."""
        return ops.where(ops.gt(weight, 0.5), yes, no)


@final
@dataclass(frozen=True, slots=True)
class Tanh:
    """Smooth evaluation of conditions by `(1 + tanh(w rho)) / 2` (Meng and Fan 2023, Eq. 6).

    `if cond then a else b` becomes I a + (1 - I) b. Here I is the value above, and rho is the margin of
    `cond`: positive where the condition holds. I equals `sigmoid(2 w rho)`.
    """

    exact: ClassVar[bool] = False
    sharpness: float = 500.0

    def indicator(self, rho: Array, strict: bool, sharpness: float | None, ops: Ops) -> Array:  # noqa: ARG002
        """Return `(1 + tanh(w rho)) / 2`, where w is `sharpness`, or `self.sharpness` if this is None."""
        width = self.sharpness if sharpness is None else sharpness
        return ops.sigmoid(rho * ops.constant(2.0 * width, rho))

    def settle(self, weight: Array, truth: Array, ops: Ops) -> Array:  # noqa: ARG002
        """Return `weight` unchanged; where the margin is 0, `weight` is 1/2, both for `>` and for `>=`."""
        return weight

    def blend(self, weight: Array, yes: Array | float, no: Array | float, ops: Ops) -> Array:
        return ops.lerp(no, yes, weight)


@final
@dataclass(frozen=True, slots=True)
class StraightThrough:
    """Exact evaluation of conditions as 0 or 1, with the gradient of `(1 + tanh(slope rho)) / 2`.

    The argument `sharpness` is not used. `if cond then a else b` has the value of the branch taken. Its
    gradient is that of this branch, plus `a - b` times the gradient of the smooth indicator of `cond`.
    """

    exact: ClassVar[bool] = False
    slope: float = 10.0

    def indicator(self, rho: Array, strict: bool, sharpness: float | None, ops: Ops) -> Array:  # noqa: ARG002
        """Return 1 where the condition holds, else 0, with the gradient of `(1 + tanh(slope rho)) / 2`."""
        return ops.straight_through(rho, strict, self.slope)

    def settle(self, weight: Array, truth: Array, ops: Ops) -> Array:
        """Return the mask `truth` as 0 or 1, with the gradient of `weight`."""
        return ops.settled(weight, truth)

    def blend(self, weight: Array, yes: Array | float, no: Array | float, ops: Ops) -> Array:
        return ops.lerp(no, yes, weight)
