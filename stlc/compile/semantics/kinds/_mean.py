"""Mean-based semantics: extrema replaced by means of all operands with the same sign.

If all operands are positive, their minimum becomes their geometric mean, in which the smallest operand has
the most weight. Otherwise it becomes a power mean of the operands, in which those that are not negative count
as 0. A maximum is `max(x) = -min(-x)`. Both means are functions of sums over the operands.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import reduce
from typing import ClassVar

from stlc.compile.namespace import Array, Ops, Pick
from stlc.compile.semantics.protocol import Parts


class Mean(ABC):
    """Base of the mean-based semantics: a minimum is a function of two sums over the operands.

    A partial result (`Parts`) consists of the exact minimum, which decides the sign; the sums over the
    positive and over the negative operands; and the number of finite operands.
    """

    __slots__ = ()

    exact: ClassVar[bool] = False
    idempotent: ClassVar[bool] = False
    associative: ClassVar[bool] = False
    sound: ClassVar[bool] = True
    bounded: ClassVar[bool] = False

    @abstractmethod
    def gain(self, x: Array, ops: Ops) -> Array:
        """Return the term that an operand x > 0 adds to the sum `gains`.

        `satisfied` computes the mean from this sum where all operands are positive.
        """

    @abstractmethod
    def loss(self, x: Array, ops: Ops) -> Array:
        """Return the term that a negative operand adds to the sum `losses`.

        The argument `x` is the magnitude of the operand, so the operand is -x. The term is 0 for x = 0.
        `violated` computes the mean from this sum where some operand is not positive.
        """

    @abstractmethod
    def satisfied(self, gains: Array, count: Array, ops: Ops) -> Array:
        """Return the mean where all operands are positive.

        `gains` is the sum of `gain(x)` over the finite operands x, `count` the number of finite operands.
        """

    @abstractmethod
    def violated(self, losses: Array, count: Array, ops: Ops) -> Array:
        """Return the mean where some operand is not positive.

        `losses` is the sum of `loss(|x|)` over the finite operands x that are negative. `count` is the number
        of all finite operands.
        """

    def lift(self, x: Array, pick: Pick, ops: Ops) -> Parts:
        """Return the partial results of the operands in `x`, each operand taken alone.

        There are four arrays of the shape of `x`: the operands; their terms `gain`; their terms `loss`; and 1
        where an operand is finite, else 0. For a maximum (`pick` "max") the operands change sign first.
        """
        x = x if pick == "min" else -x
        known = ops.gt(math.inf, ops.abs(x))
        positive = ops.both(known, ops.gt(x, 0.0))
        negative = ops.both(known, ops.gt(0.0, x))
        gains = ops.where(positive, self.gain(ops.where(positive, x, 1.0), ops), 0.0)
        losses = ops.where(negative, self.loss(ops.where(negative, -x, 0.0), ops), 0.0)
        return x, gains, losses, ops.number(known, x)

    def merge(self, a: Parts, b: Parts, pick: Pick, ops: Ops) -> Parts:  # noqa: ARG002
        """Return the partial result of the union of two disjoint sets of operands.

        The least values are combined by a minimum; the sums and the numbers of operands are added.
        """
        return (ops.minimum(a[0], b[0]), a[1] + b[1], a[2] + b[2], a[3] + b[3])

    def finish(self, parts: Parts, pick: Pick, ops: Ops) -> Array:
        """Return the mean-based minimum or maximum (`pick`) of the operands from their partial result.

        A single operand is returned unchanged, and a minimum of -inf stays -inf. A sum over huge operands is
        infinite; the mean that is not asked for must not make its gradient NaN.
        """
        least, gains, losses, known = parts
        several = ops.both(ops.gt(known, 1.0), ops.gt(math.inf, ops.abs(least)))
        count = ops.where(several, known, 1.0)
        good, bad = self.satisfied(gains, count, ops.guarded), self.violated(losses, count, ops.guarded)
        value = ops.where(several, ops.where(ops.gt(least, 0.0), good, bad), least)
        return value if pick == "min" else -value

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        """Return the mean-based minimum or maximum (`pick`) of two values, elementwise."""
        return self.join([a, b], pick, ops)

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        """Return the mean-based minimum or maximum (`pick`) of one or more values, elementwise."""
        if len(items) == 1:
            return items[0]
        lifted = [self.lift(item, pick, ops) for item in items]
        return self.finish(reduce(lambda a, b: self.merge(a, b, pick, ops), lifted), pick, ops)

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        """Return the mean-based minimum or maximum (`pick`) over time: `(time, batch)` -> `(1, batch)`."""
        if len(x) == 1:
            return x
        least, *sums = self.lift(x, pick, ops)
        return self.finish((ops.amin(least), *map(ops.sum, sums)), pick, ops)
