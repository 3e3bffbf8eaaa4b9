"""Semantics in which every operand counts: extrema replaced by means that keep their sign.

A minimum is positive where all operands are: then it becomes a geometric mean of them, which the smallest
pull down most. Elsewhere it becomes a power mean of the violated ones, in which satisfied operands count as
0. A maximum is the mirror, `max(x) = -min(-x)`. Both kinds of mean follow from sums over the operands.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import ClassVar, final

from stlc.compile.backends.array.namespace import Array, Ops, Pick
from stlc.compile.semantics.protocol import Parts


class Mean(ABC):
    """A minimum as a mean: what is summed over the operands, and what follows from the sums.

    The parts are the exact minimum, which decides the sign; the sums over satisfied and over violated
    operands; and the number of operands that are finite.
    """

    __slots__ = ()

    exact: ClassVar[bool] = False
    idempotent: ClassVar[bool] = False
    associative: ClassVar[bool] = False
    sound: ClassVar[bool] = True
    bounded: ClassVar[bool] = False

    @abstractmethod
    def gain(self, x: Array, ops: Ops) -> Array:
        """What an operand x > 0 adds where all are satisfied."""

    @abstractmethod
    def loss(self, x: Array, ops: Ops) -> Array:
        """What an operand -x, x >= 0, adds where one is violated; 0 at 0."""

    @abstractmethod
    def satisfied(self, gains: Array, count: Array, ops: Ops) -> Array:
        """The value where all operands are positive."""

    @abstractmethod
    def violated(self, losses: Array, count: Array, ops: Ops) -> Array:
        """The value where one is not."""

    def lift(self, x: Array, pick: Pick, ops: Ops) -> Parts:
        """The sums over every operand alone."""
        x = x if pick == "min" else -x
        known = ops.gt(math.inf, ops.abs(x))
        positive = ops.both(known, ops.gt(x, 0.0))
        negative = ops.both(known, ops.gt(0.0, x))
        gains = ops.where(positive, self.gain(ops.where(positive, x, 1.0), ops), 0.0)
        losses = ops.where(negative, self.loss(ops.where(negative, -x, 0.0), ops), 0.0)
        return x, gains, losses, ops.number(known, x)

    def merge(self, a: Parts, b: Parts, pick: Pick, ops: Ops) -> Parts:  # noqa: ARG002
        """The sums over both."""
        return (ops.minimum(a[0], b[0]), a[1] + b[1], a[2] + b[2], a[3] + b[3])

    def finish(self, parts: Parts, pick: Pick, ops: Ops) -> Array:
        """The mean; one operand stands for itself, and infinitely violated is infinitely violated."""
        least, gains, losses, known = parts
        several = ops.both(ops.gt(known, 1.0), ops.gt(math.inf, ops.abs(least)))
        count = ops.where(several, known, 1.0)
        good, bad = self.satisfied(gains, count, ops), self.violated(losses, count, ops)
        value = ops.where(several, ops.where(ops.gt(least, 0.0), good, bad), least)
        return value if pick == "min" else -value

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        """The mean of two values."""
        return self.join([a, b], pick, ops)

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        """The mean of one or more values."""
        if len(items) == 1:
            return items[0]
        lifted = [self.lift(item, pick, ops) for item in items]
        return self.finish(reduce(lambda a, b: self.merge(a, b, pick, ops), lifted), pick, ops)

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        """The mean over time."""
        if len(x) == 1:
            return x
        least, *sums = self.lift(x, pick, ops)
        return self.finish((ops.amin(least), *map(ops.sum, sums)), pick, ops)


@final
@dataclass(frozen=True, slots=True)
class ArithmeticGeometricMean(Mean):
    """AGM robustness (Mehdipour, Vasile and Belta, ACC 2019).

    `min(x)` is the geometric mean of `1 + x`, less 1, where all operands are positive; else the arithmetic
    mean of the negative ones, the others counting as 0. It rewards satisfying more operands, and by more.
    Predicates should be of the same size: the paper normalises them to [-1, 1].

    Sound: the sign is that of the exact robustness. The value does not say how far predicates may change.
    Its slope jumps where an operand changes its sign.
    """

    def gain(self, x: Array, ops: Ops) -> Array:
        """log(1 + x)."""
        return ops.log1p(x)

    def loss(self, x: Array, ops: Ops) -> Array:  # noqa: ARG002
        """Its size."""
        return x

    def satisfied(self, gains: Array, count: Array, ops: Ops) -> Array:
        """The geometric mean."""
        return ops.expm1(gains / count)

    def violated(self, losses: Array, count: Array, ops: Ops) -> Array:  # noqa: ARG002
        """The arithmetic mean."""
        return -(losses / count)


@final
@dataclass(frozen=True, slots=True)
class GeneralizedMean(Mean):
    """D-GMSR, the generalized mean-based smooth robustness measure (Uzun, Elango, Garoche, Acikmese 2024).

    `min(x) = sqrt(M0(x+^2)) - sqrt(Mp(x-^2))`, where x+ and x- are the positive and the negative parts of the
    n operands, `M0(z) = (eps^n + prod z)^(1/n)` and `Mp(z) = (eps^p + mean(z^p))^(1/p)`. Continuously
    differentiable.

    Sound: the sign is that of the exact robustness (in floating point a value may round to 0). The value does
    not say how far predicates may change.

    Attributes:
        eps: smoothing near 0; distances below its square root count little.
        p: order of the mean over violated operands; the larger, the more the worst one counts.
    """

    eps: float = 1e-8
    p: int = 1

    def gain(self, x: Array, ops: Ops) -> Array:
        """log(x^2 / eps)."""
        return ops.log(x) * 2.0 - math.log(self.eps)

    def loss(self, x: Array, ops: Ops) -> Array:
        """(x^2 / eps)^p."""
        square = ops.square(x) * (1.0 / self.eps)
        return square if self.p == 1 else ops.pow(square, float(self.p))

    def satisfied(self, gains: Array, count: Array, ops: Ops) -> Array:
        """sqrt((eps^n + prod x^2)^(1/n)) - sqrt(eps), where gains are large and where they are small."""
        soft = ops.maximum(gains, gains * 0.0) + ops.log1p(ops.exp(-ops.abs(gains)))
        return ops.expm1(soft / (count * 2.0)) * math.sqrt(self.eps)

    def violated(self, losses: Array, count: Array, ops: Ops) -> Array:
        """sqrt(eps) - sqrt((eps^p + mean x^2p)^(1/p))."""
        return ops.expm1(ops.log1p(losses / count) / (2.0 * self.p)) * -math.sqrt(self.eps)
