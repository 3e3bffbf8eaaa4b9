"""`exact`: exact minima and maxima."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, final

from stlc.compile.namespace import Array, Ops, Pick
from stlc.compile.semantics.protocol import Associative


@final
@dataclass(frozen=True, slots=True)
class Exact(Associative):
    """Exact minimum and maximum (Fainekos and Pappas 2009; Donzé and Maler 2010).

    Sound: a positive value means satisfied, a negative one violated, and the verdict does not change as long
    as every predicate changes by less than the magnitude of the value. The subgradient is that of operands
    that attain the extremum.
    """

    exact: ClassVar[bool] = True
    idempotent: ClassVar[bool] = True
    associative: ClassVar[bool] = True
    sound: ClassVar[bool] = True
    bounded: ClassVar[bool] = True

    def pair(self, a: Array, b: Array, pick: Pick, ops: Ops) -> Array:
        return ops.join([a, b], pick)

    def join(self, items: Sequence[Array], pick: Pick, ops: Ops) -> Array:
        return ops.join(items, pick)

    def reduce(self, x: Array, pick: Pick, ops: Ops) -> Array:
        return ops.amin(x) if pick == "min" else ops.amax(x)


SEMANTICS = Exact
