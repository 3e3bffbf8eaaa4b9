"""A formula of planning windows: `end` is so many samples after each instant, and the record ends there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import history, reach
from stlc.monitor.online.asked import (
    Bounds,
    ColumnPlans,
    Ending,
    Floats,
    TrackingOptions,
    decided_first,
    first_needed,
    sides_of,
)
from stlc.monitor.online.columns import Side
from stlc.monitor.online.streams import ColumnPlan, RecursiveColumn
from stlc.monitor.values import Record, window_bounds


@dataclass(slots=True)
class PlanningWindowTracker:
    """A formula with windows to the end of a planning window, at consecutive instants.

    Every instant sees the record up to the end of its window. Windows of the formula that reach beyond it may
    still meet what the past holds there: the columns as they go on from that sample, nothing else being
    known. Samples are then taken one by one, and a value is kept when its window is full.

    Attributes:
        plans: what there is to compute.
        asked: how.
        window: how many samples after its instant the end of a window is.
        samples: how many there are by now.
    """

    plans: ColumnPlans
    asked: TrackingOptions
    window: int
    samples: int = 0
    _sides: list[Side] = field(default_factory=list)
    _back: int = 0
    _beyond: int = 0
    _kept: list[Bounds] = field(default_factory=list)
    _first: int = 0

    def __post_init__(self) -> None:
        formula = self.planned.formula
        self._back = history(formula)
        if self.asked.ending == "open" and _remembers(self.planned):
            self._beyond = max(reach(formula).future - self.window, 0)
        self._sides = sides_of(self.plans, self.window + self._beyond, self.asked)

    @property
    def planned(self) -> ColumnPlan:
        """The requirement as it is written."""
        return self.plans["truncate"]

    @property
    def settled(self) -> int:
        """The first instant whose value may still change."""
        return max(self.samples - self.window, 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Take new samples in."""
        for now in range(self.samples + 1, samples + 1) if self._beyond else (samples,):
            known = {name: values[: now - first] for name, values in signals.items()}
            for side in self._sides:
                side.grow(known, first, now)
            self.samples = now
            if self._beyond and self.settled:
                self._kept.append(self._open(self.settled - 1, self.settled))

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
        if not self._beyond:
            return self._open(start, stop)
        middle = min(max(self.settled, start), stop)
        kept = self._kept[start - self._first : middle - self._first]
        return Bounds(*map(np.concatenate, zip(*kept, self._open(middle, stop), strict=True)))

    def ended(self, starts: range) -> Bounds:
        """Where the trace is over."""
        if self.asked.ending == "open":
            return self.either(starts.start, starts.stop)
        return self.certain(starts)

    def drop(self, start: int) -> int:
        """Forget instants before `start`."""
        for side in self._sides:
            side.drop(start - self._back)
        del self._kept[: start - self._first]
        self._first = start
        return first_needed(self.planned, self.samples)

    def _open(self, start: int, stop: int) -> Bounds:
        return Bounds(self._values(0, start, stop), self._values(1, start, stop))

    def _values(self, which: int, start: int, stop: int) -> Floats:
        if stop <= start:
            return np.zeros(0)
        side = self._sides[which]
        record = Record(side.rows, NUMPY)
        starts = range(start - side.base, stop - side.base)
        if self._beyond:
            return self._continued(side, record, starts)
        ends: Ending = "truncate" if side.end == "truncate" else "open"
        low, high = window_bounds(side.plan.formula, record, starts, self.window, ends)
        return np.asarray((high if side.end == "upper" else low)[:, 0])

    def _continued(self, side: Side, record: Record, starts: range) -> Floats:
        """Where the formula reads the columns beyond the ends of its windows, many instants at once."""
        formulas, back = [side.plan.formula], self._back
        early = range(starts.start, max(min(back, starts.stop), starts.start))
        ends = [record.values(formulas, range(k, k + 1), side.end, k + self.window + 1)[0] for k in early]
        chosen = np.arange(early.stop, starts.stop)
        if len(chosen):
            rows = np.arange(-back, self.window + self._beyond + 1)[:, None] + chosen
            around = Record({name: x[rows, 0] for name, x in record.env.items()}, NUMPY)
            ends += around.values(formulas, range(back, back + 1), side.end, back + self.window + 1)
        return np.asarray(np.concatenate(ends, axis=1)[0])


def _remembers(planned: ColumnPlan) -> bool:
    """Whether more than nothing is known of a column beyond the last sample."""
    return any(
        isinstance(stream, RecursiveColumn) or stream.back > 0 or not isinstance(stream.formula, ir.Predicate)
        for stream in planned.streams
    )
