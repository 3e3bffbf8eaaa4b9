"""Definedness of a formula on a finite trace, sample by sample (needs NumPy, unlike `support`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Analysis, fold, reach_of

Defined: TypeAlias = NDArray[np.bool_]
_Instants: TypeAlias = NDArray[np.int_]


def defined(formula: ir.Formula, samples: int) -> Defined:
    """Return where `formula` is defined on a trace of `samples` samples, as a mask `(samples,)`.

    Windows of the future are not cut: one that extends beyond the last sample is undefined, as are `prev`,
    `next` and `shift` outside the trace. A window "to the end" is defined where it has a sample.
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

    def all_of(self, parts: Sequence[Defined]) -> Defined:
        return reduce(np.logical_and, parts)

    def ahead(self, body: Defined, window: ir.Window) -> Defined:
        return _throughout(body, *self._future(window))

    def back(self, body: Defined, window: ir.Window) -> Defined:
        return _throughout(body, *self._past(window))

    def until(self, left: Defined, right: Defined, window: ir.Window) -> Defined:
        """Definedness of `until`; the left side is read from now on, and now in any case."""
        (first, last), now = self._future(window), np.arange(self.samples)
        return _throughout(left, now, np.maximum(last, now)) & _throughout(right, first, last)

    def since(self, left: Defined, right: Defined, window: ir.Window) -> Defined:
        """Definedness of `since`; neither side is read where the window lies before the trace."""
        (first, last), now = self._past(window), np.arange(self.samples)
        held = _throughout(left, np.where(last < 0, now + 1, first), now)
        return held & _throughout(right, first, last)

    def shift(self, body: Defined, node: ir.Shift) -> Defined:
        there = np.arange(self.samples) + node.steps
        within = (there >= 0) & (there < self.samples)
        return np.where(within, body[np.clip(there, 0, self.samples - 1)], node.outside is not None)

    def at_start(self, body: Defined) -> Defined:
        return np.full(self.samples, body[0])

    def _future(self, window: ir.Window) -> tuple[_Instants, _Instants]:
        """First and last instant of each sample's future window."""
        now = np.arange(self.samples)
        if window.hi is not None:
            return now + window.lo, now + window.hi
        beyond = now + window.lo >= self.samples
        return now + window.lo, np.where(beyond, self.samples, self.samples - 1)

    def _past(self, window: ir.Window) -> tuple[_Instants, _Instants]:
        now = np.arange(self.samples)
        first = np.zeros_like(now) if window.hi is None else np.maximum(now - window.hi, 0)
        return first, now - window.lo


def _throughout(inside: Defined, first: _Instants, last: _Instants) -> Defined:
    """True if all instants first..last are within the trace and defined; true for an empty range."""
    samples = len(inside)
    known = int(np.argmin(inside)) if not inside.all() else samples
    if not inside[known:].any():  # a formula without past operators is defined up to some sample
        return np.asarray(((last < known) | (last < first)) & (last < samples))
    missing = np.concatenate([[0], np.cumsum(~inside)])
    low, high = np.clip(first, 0, samples), np.clip(last + 1, 0, samples)
    whole = missing[np.maximum(high, low)] == missing[low]
    return np.asarray(whole & (last < samples))
