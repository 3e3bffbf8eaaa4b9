"""`agm`: arithmetic and geometric means of the operands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from stlc.compile.namespace import Array, Ops
from stlc.compile.semantics.kinds._mean import Mean


@final
@dataclass(frozen=True, slots=True)
class ArithmeticGeometricMean(Mean):
    """AGM robustness (Mehdipour, Vasile and Belta, ACC 2019).

    Where all operands are positive, `min(x)` is the geometric mean of `1 + x`, minus 1. Elsewhere it is the
    arithmetic mean of the operands, where positive ones count as 0. The semantics rewards more satisfied
    operands and larger margins. Predicates should be of similar magnitude: the authors normalise them to [-1,
    1].

    Sound: the sign is that of the exact robustness. But the value is not a tolerance: the verdict can change
    although every predicate changes by less than the value. The gradient is discontinuous where an operand
    changes sign.
    """

    def gain(self, x: Array, ops: Ops) -> Array:
        """Return log(1 + x), the term of an operand x > 0 in the sum `gains`."""
        return ops.log1p(x)

    def loss(self, x: Array, ops: Ops) -> Array:  # noqa: ARG002
        """Return x, the term of a negative operand -x in the sum `losses`."""
        return x

    def satisfied(self, gains: Array, count: Array, ops: Ops) -> Array:
        """Return the geometric mean of `1 + x` minus 1, for operands that are all positive."""
        return ops.expm1(gains / count)

    def violated(self, losses: Array, count: Array, ops: Ops) -> Array:  # noqa: ARG002
        """Return the arithmetic mean of all operands, where positive ones count as 0."""
        return -(losses / count)


SEMANTICS = ArithmeticGeometricMean
