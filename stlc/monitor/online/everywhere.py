"""A formula whose windows have an end, at consecutive instants while its signals come in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from stlc.compile.ir.support import history, reach
from stlc.monitor.online.asked import (
    Bounds,
    ColumnPlans,
    Floats,
    TrackingOptions,
    decided_first,
    first_needed,
    sides_of,
)
from stlc.monitor.online.columns import Reader, Side
from stlc.monitor.online.streams import ColumnPlan


@dataclass(slots=True)
class BoundedTracker:
    """A formula whose windows have an end, at consecutive instants."""

    plans: ColumnPlans
    asked: TrackingOptions
    samples: int = 0
    _sides: list[Side] = field(default_factory=list)
    _readers: list[Reader] = field(default_factory=list)
    _ahead: int = 0
    _back: int = 0

    def __post_init__(self) -> None:
        formula = self.planned.formula
        self._ahead = reach(formula).future
        self._back = history(formula)
        self._sides = sides_of(self.plans, self._ahead, self.asked)
        self._readers = [Reader([side.plan.formula], side.end) for side in self._sides]

    @property
    def planned(self) -> ColumnPlan:
        """The requirement as it is written."""
        return self.plans["truncate"]

    @property
    def settled(self) -> int:
        """The first instant whose value may still change."""
        return max(self.samples - self._ahead - self.planned.lag, 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Take new samples in."""
        for side in self._sides:
            side.grow(signals, first, samples)
        self.samples = samples

    def live(self, start: int, stop: int) -> Bounds:
        """Bounds over all continuations."""
        if self.asked.ending == "truncate":
            return decided_first(self, start, stop)
        return self.either(start, stop)

    def certain(self, starts: range) -> Bounds:
        """At settled instants, where windows are cut to the trace."""
        return Bounds(*(self._values(which, starts.start, starts.stop) for which in (2, 3)))

    def either(self, start: int, stop: int) -> Bounds:
        """At any instants, where nothing is assumed of what lies outside of the trace."""
        return Bounds(self._values(0, start, stop), self._values(1, start, stop))

    def ended(self, starts: range) -> Bounds:
        """Where the trace is over."""
        sides = self._sides
        self._sides = [side.over() for side in sides]
        try:
            return self._ended(starts)
        finally:
            self._sides = sides

    def _ended(self, starts: range) -> Bounds:
        if self.asked.ending == "open":
            return self.either(starts.start, starts.stop)
        return self.certain(starts)

    def drop(self, start: int) -> int:
        """Forget instants before `start`."""
        for side in self._sides:
            side.drop(start - self._back)
        return first_needed(self.planned, self.samples)

    def _values(self, which: int, start: int, stop: int) -> Floats:
        if stop <= start:
            return np.zeros(0)
        return self._sides[which].values(self._readers[which], start, stop - start)[0][:, 0]
