"""Samples of a finite trace at which a formula is defined.

A formula is undefined at a sample if it needs values from outside the trace there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Analysis, fold, reach_of

Defined: TypeAlias = NDArray[np.bool_]
_Instants: TypeAlias = NDArray[np.int_]


def defined(formula: ir.Formula, samples: int) -> Defined:
    """Return a mask `(samples,)` that is True at the samples of a trace at which `formula` is defined.

    Future windows are not cut: a formula is undefined if its window extends beyond the last sample. `prev`,
    `next` and `shift` are undefined if they read a sample outside the trace. A window "to the end" is defined
    if it contains a sample.
    """
    return fold(formula, _Definedness(samples))


@final
@dataclass(frozen=True, slots=True)
class _Definedness(Analysis[Defined]):
    samples: int

    def predicate(self, num: ir.Num) -> Defined:
        around, now = reach_of(num), np.arange(self.samples)
        return np.asarray((now >= around.past) & (now < self.samples - around.future))

    def constant(self) -> Defined:
        return np.ones(self.samples, dtype=bool)

    def over(self, parts: Sequence[Defined], offsets: Sequence[ir.Offsets]) -> Defined:
        """Return a mask `(samples,)` that is True where all operands of an operator are defined.

        An operand must be defined at every instant at which the operator reads it. `parts` are the masks of
        the operands; operand i is read at `offsets[i]`. If the window of the operator is empty, no operand is
        read, and the result is True.
        """
        if all(each == ir.NOW for each in offsets):
            return reduce(np.logical_and, parts)
        if len(parts) == 1:
            return _throughout(parts[0], *self._instants(*offsets[0]))
        ranges, now = [self._instants(*each) for each in offsets], np.arange(self.samples)
        unread = ranges[-1].last < ranges[-1].first
        return reduce(
            np.logical_and,
            (
                _throughout(part, np.where(unread, now + 1, read.first), np.where(unread, now, read.last))
                for part, read in zip(parts[:-1], ranges[:-1], strict=True)
            ),
            _throughout(parts[-1], *ranges[-1]),
        )

    def shift(self, body: Defined, node: ir.Shift) -> Defined:
        there = np.arange(self.samples) + node.steps
        within = (there >= 0) & (there < self.samples)
        return np.where(within, body[np.clip(there, 0, self.samples - 1)], node.outside is not None)

    def at_start(self, body: Defined) -> Defined:
        return np.full(self.samples, body[0])

    def _instants(self, first: int | None, last: int | None) -> _Ranges:
        """Return the first and last instant of a window at each sample, as two arrays `(samples,)`.

        `first` and `last` are offsets from the sample. If `first` is None, the window begins at the start of
        the trace; if `last` is None, it ends at the end of the trace. Windows that begin before the start of
        the trace are cut there.
        """
        now = np.arange(self.samples)
        start = np.zeros_like(now) if first is None else np.maximum(now + first, 0)
        end = np.where(start < self.samples, self.samples - 1, self.samples) if last is None else now + last
        return _Ranges(start, end)


class _Ranges(NamedTuple):
    first: _Instants
    last: _Instants


def _throughout(inside: Defined, first: _Instants, last: _Instants) -> Defined:
    """Return, per sample, whether all instants `first`..`last` are in the trace and defined.

    All arrays have the shape `(samples,)`. An empty range of instants gives True.
    """
    samples = len(inside)
    known = int(np.argmin(inside)) if not inside.all() else samples
    if not inside[known:].any():  # a formula without past operators is defined up to some sample
        return np.asarray(((last < known) | (last < first)) & (last < samples))
    missing = np.concatenate([[0], np.cumsum(~inside)])
    low, high = np.clip(first, 0, samples), np.clip(last + 1, 0, samples)
    whole = missing[np.maximum(high, low)] == missing[low]
    return np.asarray(whole & (last < samples))
