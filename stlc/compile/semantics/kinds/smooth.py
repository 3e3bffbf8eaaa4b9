"""`smooth`: log-sum-exp approximations of minimum and maximum (Meng and Fan 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, final

from stlc.compile.namespace import Array, Ops, Pick
from stlc.compile.semantics.protocol import Associative


@final
@dataclass(frozen=True, slots=True)
class LogSumExp(Associative):
    """Smooth minimum and maximum by log-sum-exp (approximated robustness score of Meng and Fan 2023).

    `max(x) = log(sum(exp(k x))) / k`, which overestimates by at most log(n) / k, and `min(x) = -max(-x)`,
    which underestimates by as much.

    Not sound: a value whose magnitude is below the summed error of all operators has no meaning for the
    verdict. In a formula of minima alone a positive value means satisfied; in one of maxima alone a negative
    value means violated.

    Attributes:
        k: the scale; larger values approach the exact extrema.
    """

    k: float = 500.0

    exact: ClassVar[bool] = False
    idempotent: ClassVar[bool] = False
    associative: ClassVar[bool] = True
    sound: ClassVar[bool] = False
    bounded: ClassVar[bool] = True

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        return ops.softmax2(a, b, self.k if pick == "max" else -self.k)

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        """Return the smooth minimum or maximum (`pick`) of one or more values, elementwise."""
        if len(items) == 1:
            return items[0]
        if len(items) == 2:
            return self.pair(items[0], items[1], pick, ops)
        return self.reduce(ops.stack(items), pick, ops)[0]

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        """Return the smooth minimum or maximum (`pick`) over time: `(time, batch)` -> `(1, batch)`."""
        if len(x) == 1:
            return x
        return ops.softmax(x, self.k if pick == "max" else -self.k)


SEMANTICS = LogSumExp
