"""Instants at which a formula reads signals, relative to the instant at which it is evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias, final

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Analysis, Offsets


@dataclass(frozen=True, slots=True)
class Stretch:
    """Samples that are read, both ends included.

    Attributes:
        first: offset of the first one; None: from the first sample of the trace.
        last: offset of the last one; None: to the last sample of the trace.
        absolute: whether offsets count from the first sample of the trace instead of the present one.
    """

    first: int | None
    last: int | None
    absolute: bool = False

    def over(self, offsets: Offsets) -> Stretch:
        """Return what is read if the formula is evaluated at `offsets` from now."""
        if self.absolute:
            return self
        first = None if self.first is None or offsets.first is None else self.first + offsets.first
        last = None if self.last is None or offsets.last is None else self.last + offsets.last
        return Stretch(first, last)

    def samples(self, starts: range, samples: int) -> range:
        """Return the samples of a trace of `samples` samples that are read by an evaluation at `starts`."""
        begin, end = (0, 0) if self.absolute else (starts.start, starts.stop - 1)
        first = 0 if self.first is None else max(begin + self.first, 0)
        last = samples - 1 if self.last is None else min(end + self.last, samples - 1)
        return range(first, max(last + 1, first))


_Reads: TypeAlias = frozenset[Stretch]


def reads(formula: ir.Formula) -> _Reads:
    """Return the ranges of samples at which the predicates of a formula can be read."""
    return formula.fold(_READS)


def samples_read(formula: ir.Formula, starts: range, samples: int) -> tuple[range, ...]:
    """Return the samples that an evaluation of a formula at `starts` can read, as separate ranges in order.

    The result is empty if these are all samples of the trace, if there are none, or if `starts` were chosen
    by the user, who then knows them: requirements are judged from the first sample on.
    """
    if starts.start:
        return ()
    found: list[range] = []
    ranges = (each.samples(starts, samples) for each in reads(formula))
    for each in sorted((r for r in ranges if r), key=lambda r: r.start):
        if found and each.start <= found[-1].stop:
            found[-1] = range(found[-1].start, max(found[-1].stop, each.stop))
        else:
            found.append(each)
    return () if found == [range(samples)] else tuple(found)


@final
class _Reading(Analysis[_Reads]):
    def predicate(self, num: ir.Num) -> _Reads:
        around = num.farthest
        return frozenset({Stretch(-around.past, around.future)})

    def constant(self) -> _Reads:
        return frozenset()

    def over(self, parts: Sequence[_Reads], offsets: Sequence[Offsets]) -> _Reads:
        pairs = zip(parts, offsets, strict=True)
        return frozenset(each.over(where) for part, where in pairs for each in part)

    def at_start(self, body: _Reads) -> _Reads:
        return frozenset(Stretch(each.first, each.last, absolute=True) for each in body)


_READS = _Reading()
