"""Requirements with bounded windows, evaluated together: least and greatest values in one array.

Every column is `(rows, 2)`: the least and the greatest value over all continuations. Known rows hold a value
twice, the rows after them -inf and +inf; so one evaluation gives both bounds of all requirements.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import history, reach
from stlc.monitor.online.bounds import Bounds, Floats
from stlc.monitor.online.columns import NOTHING, ColumnPlans, ColumnReader, continued
from stlc.monitor.online.streams import ColumnPlan, PredicateColumn, RecursiveColumn, plan
from stlc.monitor.values import by_truth

_UNKNOWN = (-math.inf, math.inf)

_SPARE = 64
"""Rows that are free after the columns were moved."""


def fits(plans: ColumnPlans) -> bool:
    """True if both bounds follow from one formula, over predicates of the present and latched values."""
    planned = plans["truncate"]
    return plans["lower"] == plans["upper"] == planned and all(map(_of_the_present, planned.streams))


def _of_the_present(stream: PredicateColumn | RecursiveColumn) -> bool:
    if isinstance(stream, RecursiveColumn):
        return not stream.ahead
    return isinstance(stream.formula, ir.Predicate) and not stream.back and not stream.ahead


@dataclass(slots=True)
class IntervalColumns:
    """The columns of requirements whose instants are settled at the same time.

    Attributes:
        truth: predicates are true or false, +inf or -inf.
        samples: number of samples taken in.
    """

    truth: bool
    samples: int = 0
    _formulas: list[ir.Formula] = field(default_factory=list)
    _starts: list[int] = field(default_factory=list)
    _plan: ColumnPlan | None = None
    _leaves: tuple[list[str], ColumnReader] | None = None
    _latched: list[tuple[RecursiveColumn, ColumnReader]] = field(default_factory=list)
    _reader: ColumnReader = field(init=False)
    _beyond: int = 0
    _back: int = 0
    _latch_back: int = 0
    _rows: dict[str, Floats] = field(default_factory=dict)
    _origin: int = 0
    _base: int = 0
    _room: int = 0
    _env: dict[str, Floats] = field(default_factory=dict)
    _found: tuple[tuple[int, int], list[Floats]] | None = None

    def add(self, formula: ir.Formula) -> IntervalTracker:
        """Add a requirement; only before the first sample."""
        self._formulas.append(formula)
        self._starts.append(0)
        return IntervalTracker(self, len(self._starts) - 1, reach(formula).future)

    def grow(self, signals: Mapping[str, Floats], samples: int) -> None:
        """Take in the new samples; `signals` (stored, 1) end with the last one."""
        if samples == self.samples:
            return
        first, self.samples, self._found = self.samples, samples, None
        if self._plan is None:
            self._prepare()
        self._make_room(first)
        begin, end = first - self._origin, samples - self._origin
        if self._leaves is not None:
            names, reader = self._leaves
            kept = len(next(iter(signals.values())))
            found = reader.of_signals(signals, kept - (samples - first), samples - first)
            for name, values in zip(names, found, strict=True):
                self._rows[name][begin:end] = values
        self._view()
        for stream, reader in self._latched:
            parts = reader(self._env, first - self._base, samples + self._beyond - first)
            last = self._rows[stream.name][begin - 1] if first else None
            self._rows[stream.name][begin : end + self._beyond] = continued(stream.op, parts, last)

    def values(self, which: int, start: int, stop: int) -> Floats:
        """Both bounds of a requirement at consecutive instants, (instants, 2)."""
        if self._found is None or self._found[0] != (start, stop):
            self._found = (start, stop), self._reader(self._env, start - self._base, stop - start)
        return self._found[1][which]

    def drop(self, which: int, start: int) -> None:
        """Forget rows that a requirement needs only for instants before `start`."""
        self._starts[which] = start
        needed = min(min(self._starts) - self._back, self.samples - self._latch_back)
        if needed > self._base:
            self._base = needed
            self._view()

    def _view(self) -> None:
        """Update the views of the stored rows, from `_base` on."""
        kept = slice(self._base - self._origin, self.samples - self._origin + self._beyond)
        self._env = {name: column[kept] for name, column in self._rows.items()}

    def _prepare(self) -> None:
        whole = plan(ir.BoolOp("and", tuple(self._formulas)))
        assert isinstance(whole.formula, ir.BoolOp)
        formulas = whole.formula.items
        self._plan = whole
        self._beyond = max(reach(formula).future for formula in formulas)
        self._latched = [
            (stream, ColumnReader(stream.parts, "both"))
            for stream in whole.streams
            if isinstance(stream, RecursiveColumn)
        ]
        self._back = max(map(history, formulas))
        self._latch_back = max((max(stream.back, 1) for stream, _ in self._latched), default=0)
        leaves = [stream for stream in whole.streams if isinstance(stream, PredicateColumn)]
        judged = [by_truth(leaf.formula) if self.truth else leaf.formula for leaf in leaves]
        if leaves:
            self._leaves = [leaf.name for leaf in leaves], ColumnReader(judged, "truncate")
        self._reader = ColumnReader(formulas, "both")
        self._rows = {
            name: np.empty((0, 2)) for name in (NOTHING, *(stream.name for stream in whole.streams))
        }

    def _make_room(self, known: int) -> None:
        """Move the rows from `_base` on to the front where the free rows at the end are too few."""
        if self.samples + self._beyond - self._origin <= self._room:
            return
        kept = slice(self._base - self._origin, known - self._origin)
        self._room = 2 * (self.samples + self._beyond - self._base) + _SPARE
        for name, old in self._rows.items():
            column = np.full((self._room, 2), _UNKNOWN)
            column[: known - self._base] = old[kept]
            self._rows[name] = column
        self._origin = self._base


@dataclass(frozen=True, slots=True)
class IntervalTracker:
    """Tracker of one formula with bounded windows; shares columns with others.

    Attributes:
        shared: the columns.
        which: number of the formula.
        ahead: lookahead in samples.
    """

    shared: IntervalColumns
    which: int
    ahead: int

    @property
    def samples(self) -> int:
        """Number of samples taken in."""
        return self.shared.samples

    @property
    def settled(self) -> int:
        """The first instant whose value may still change."""
        return max(self.shared.samples - self.ahead, 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:  # noqa: ARG002
        """Take in new samples."""
        self.shared.grow(signals, samples)

    def live(self, start: int, stop: int) -> Bounds:
        """Bounds over all continuations."""
        if stop <= start:
            return Bounds(np.zeros(0), np.zeros(0))
        found = self.shared.values(self.which, start, stop)
        return Bounds(found[:, 0], found[:, 1])

    def ended(self, starts: range) -> Bounds:
        """Bounds at the end of the trace: what is missing stays unknown."""
        return self.live(starts.start, starts.stop)

    def drop(self, start: int) -> int:
        """Forget instants before `start`; no signals are stored."""
        self.shared.drop(self.which, start)
        return self.shared.samples
