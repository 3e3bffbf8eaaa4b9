"""Samples of a finite trace at which a formula is defined.

A formula is undefined at a sample if it needs values from outside the trace there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Analysis, Offsets

Undefined: TypeAlias = tuple[range, ...]
"""Samples at which something is undefined, in order: disjoint ranges, none of them empty."""

_EVER = 1 << 60
"""More samples than any trace has."""


def defined(formula: ir.Formula, samples: int) -> NDArray[np.bool_]:
    """Return a mask `(samples,)` that is True at the samples of a trace at which `formula` is defined."""
    found = np.ones(samples, dtype=bool)
    for each in undefined(formula, samples):
        found[each.start : each.stop] = False
    return found


def defined_at(formula: ir.Formula, samples: int, instants: range) -> bool:
    """True if `formula` is defined at all of the consecutive `instants` of a trace."""
    missing = undefined(formula, samples)
    return not any(each.start < instants.stop and instants.start < each.stop for each in missing if instants)


@lru_cache(maxsize=512)
def undefined(formula: ir.Formula, samples: int) -> Undefined:
    """Return the samples of a trace at which `formula` is undefined.

    Future windows are not cut: a formula is undefined if its window extends beyond the last sample. `prev`,
    `next` and `shift` are undefined if they read a sample outside the trace. A window "to the end" is defined
    if it contains a sample.
    """
    return formula.fold(_Undefinedness(samples))


@final
@dataclass(frozen=True, slots=True)
class _Undefinedness(Analysis[Undefined]):
    samples: int

    def predicate(self, num: ir.Num) -> Undefined:
        around = num.reach
        return self._merged([range(around.past), range(self.samples - around.future, self.samples)])

    def constant(self) -> Undefined:
        return ()

    def over(self, parts: Sequence[Undefined], offsets: Sequence[Offsets]) -> Undefined:
        """Return the samples at which an operator reads an operand where that is undefined.

        Operand i is undefined at `parts[i]`, and is read at `offsets[i]`, which begin with the trace and end
        with it at the latest if they are None, and begin with the trace if they would begin before. If the
        window of the operator is empty, no operand is read.
        """
        nonempty, found = -(offsets[-1].last or 0), []
        for part, (first, last) in zip(parts, offsets, strict=True):
            for each in (*part, range(self.samples, _EVER)):
                if last is not None:
                    begin = each.start - last
                else:
                    begin = 0 if each.start < self.samples else each.start - (first or 0)
                found.append(range(max(begin, nonempty), _EVER if first is None else each.stop - first))
        return self._merged(found)

    def shift(self, body: Undefined, node: ir.Shift) -> Undefined:
        steps, moved = node.steps, [range(each.start - node.steps, each.stop - node.steps) for each in body]
        if node.outside is None:
            moved += [range(-steps), range(self.samples - steps, self.samples)]
        return self._merged(moved)

    def at_start(self, body: Undefined) -> Undefined:
        return self._merged([range(self.samples)]) if body and not body[0].start else ()

    def _merged(self, parts: Iterable[range]) -> Undefined:
        """Samples of the trace in any of the ranges."""
        found: list[range] = []
        for each in sorted(parts, key=lambda part: part.start):
            start, stop = max(each.start, 0), min(each.stop, self.samples)
            if start < stop and found and start <= found[-1].stop:
                found[-1] = range(found[-1].start, max(found[-1].stop, stop))
            elif start < stop:
                found.append(range(start, stop))
        return tuple(found)
