"""`dgmsr`: generalized means of the operands, differentiable everywhere."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

from stlc.compile.namespace import Array, Ops
from stlc.compile.semantics.kinds._mean import Mean


@final
@dataclass(frozen=True, slots=True)
class GeneralizedMean(Mean):
    """D-GMSR, the generalized mean-based smooth robustness measure (Uzun, Elango, Garoche, Acikmese 2024).

    `min(x) = sqrt(M0(x+^2)) - sqrt(Mp(x-^2))`, where x+ and x- are the positive and the negative parts of the
    n operands, `M0(z) = (eps^n + prod z)^(1/n)` and `Mp(z) = (eps^p + mean(z^p))^(1/p)`. The measure is
    continuously differentiable.

    Sound: the sign is that of the exact robustness (in floating point a value may round to 0). But the value
    is not a tolerance: the verdict can change although every predicate changes by less than the value.

    Attributes:
        eps: smoothing near 0; margins below its square root have little weight.
        p: order of the mean over violated operands; larger values give more weight to the worst operand.
    """

    eps: float = 1e-8
    p: int = 1

    def gain(self, x: Array, ops: Ops) -> Array:
        """Return log(x^2 / eps), the term of an operand x > 0 in the sum `gains`."""
        return ops.log(x) * 2.0 - math.log(self.eps)

    def loss(self, x: Array, ops: Ops) -> Array:
        """Return (x^2 / eps)^p, the term of a negative operand -x in the sum `losses`."""
        square = ops.square(x) * (1.0 / self.eps)
        return square if self.p == 1 else ops.pow(square, float(self.p))

    def satisfied(self, gains: Array, count: Array, ops: Ops) -> Array:
        """Return sqrt((eps^n + prod x^2)^(1/n)) - sqrt(eps), for operands that are all positive.

        The computation is stable for large and small sums.
        """
        soft = ops.maximum(gains, gains * 0.0) + ops.log1p(ops.exp(-ops.abs(gains)))
        return ops.expm1(soft / (count * 2.0)) * math.sqrt(self.eps)

    def violated(self, losses: Array, count: Array, ops: Ops) -> Array:
        """Return sqrt(eps) - sqrt((eps^p + mean x^(2p))^(1/p)), where some operand is not positive.

        The mean is over all finite operands; positive ones count as 0.
        """
        return ops.expm1(ops.log1p(losses / count) / (2.0 * self.p)) * -math.sqrt(self.eps)


SEMANTICS = GeneralizedMean
