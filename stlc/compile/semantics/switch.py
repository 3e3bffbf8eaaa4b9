"""Switches: conditions as indicators, and choices as blends (Eq. 6 of the paper).

A hybrid system flows where a condition fails and jumps where it holds. `Hard` is exact; `Tanh` is the paper's
smooth approximation; `StraightThrough` is exact forward, with a smooth gradient backward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol, final

from stlc.compile.backends.array.namespace import Array, Ops


class Switch(Protocol):
    """Evaluation of conditions in a program.

    Attributes:
        exact: only the truth of a condition matters, not its margin: it is evaluated with comparisons and
            masks, and each predicate keeps its own strictness.
    """

    exact: ClassVar[bool]

    def indicator(self, rho: Array, strict: bool, sharpness: float | None, ops: Ops) -> Array:
        """Return the indicator of a condition with margin `rho`, in [0, 1].

        Args:
            rho: margin; true iff > 0 (`strict`) or >= 0.
            strict: whether the inequality is strict.
            sharpness: of this indicator; None takes the default of the switch.
            ops: the array library.
        """

    def settle(self, weight: Array, truth: Array, ops: Ops) -> Array:
        """Adjust the indicator `weight` of a condition of mixed strictness; `truth` is its mask."""

    def blend(self, weight: Array, yes: Array | float, no: Array | float, ops: Ops) -> Array:
        """Return a blend of two values: `yes` where the indicator `weight` is 1, `no` where it is 0."""


@final
@dataclass(frozen=True, slots=True)
class Hard:
    """Exact switching: 0 or 1, without gradient and without tolerance."""

    exact: ClassVar[bool] = True

    def indicator(self, rho: Array, strict: bool, sharpness: float | None, ops: Ops) -> Array:  # noqa: ARG002
        """1 where the condition holds, else 0."""
        return ops.number(ops.gt(rho, 0.0) if strict else ops.ge(rho, 0.0), rho)

    def settle(self, weight: Array, truth: Array, ops: Ops) -> Array:
        """Return the mask as a number."""
        return ops.number(truth, weight)

    def blend(self, weight: Array, yes: Array | float, no: Array | float, ops: Ops) -> Array:
        """Return the value of the taken branch, bit for bit."""
        return ops.where(ops.gt(weight, 0.5), yes, no)


@final
@dataclass(frozen=True, slots=True)
class Tanh:
    """The paper's Eq. 6: `(1 + tanh(w rho)) / 2`, that is `sigmoid(2 w rho)`, and a blend of branches."""

    exact: ClassVar[bool] = False
    sharpness: float = 500.0

    def indicator(self, rho: Array, strict: bool, sharpness: float | None, ops: Ops) -> Array:  # noqa: ARG002
        """`(1 + tanh(w rho)) / 2` with the indicator's own sharpness where it has one."""
        width = self.sharpness if sharpness is None else sharpness
        return ops.sigmoid(rho * ops.constant(2.0 * width, rho))

    def settle(self, weight: Array, truth: Array, ops: Ops) -> Array:  # noqa: ARG002
        """Return `weight` unchanged: at the boundary it is 1/2 for strict and non-strict inequalities."""
        return weight

    def blend(self, weight: Array, yes: Array | float, no: Array | float, ops: Ops) -> Array:
        """`no + weight (yes - no)`."""
        return ops.lerp(no, yes, weight)


@final
@dataclass(frozen=True, slots=True)
class StraightThrough:
    """Exact forward; backward the slope of `(1 + tanh(slope rho)) / 2`, regardless of `sharpness`.

    A choice has the value and gradient of the taken branch, plus the gradient of the condition.
    """

    exact: ClassVar[bool] = False
    slope: float = 10.0

    def indicator(self, rho: Array, strict: bool, sharpness: float | None, ops: Ops) -> Array:  # noqa: ARG002
        """0 or 1, with a gradient."""
        return ops.straight_through(rho, strict, self.slope)

    def settle(self, weight: Array, truth: Array, ops: Ops) -> Array:
        """Return the mask as 0 or 1, with the gradient of `weight`."""
        return ops.settled(weight, truth)

    def blend(self, weight: Array, yes: Array | float, no: Array | float, ops: Ops) -> Array:
        """`no + weight (yes - no)`."""
        return ops.lerp(no, yes, weight)
