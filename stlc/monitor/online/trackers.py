"""Incremental evaluators (trackers) of one requirement on a growing trace, and the choice among them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import history, reach, uses_end
from stlc.compile.ir.traverse import map_children
from stlc.compile.pipeline import CompiledRequirement
from stlc.diagnostics import Diagnostic, UsageError
from stlc.monitor.instants import cut_bounds, growing_bounds, window_of
from stlc.monitor.online.bounds import Ending, RobustnessBounds, Tracker, TrackingOptions
from stlc.monitor.online.columns import Beyond, ColumnPlans, ColumnReader, Side, shareable
from stlc.monitor.online.history import Floats
from stlc.monitor.online.paced import MOST, WIDE, PacedTracker, span
from stlc.monitor.online.streams import ColumnPlan, EndlessError, endless, looks_on, plan
from stlc.monitor.online.unbounded import UnboundedState, skeleton
from stlc.monitor.prefix_bounds import prefix_bound, with_seen
from stlc.monitor.values import Record, window_bounds


def prefix_bounds(formula: ir.Formula, ending: Ending, window: int | None) -> tuple[ir.Formula, ir.Formula]:
    """Return formulas whose values are a lower and an upper bound on `formula`, wherever the trace may end.

    With a planning window of `window` samples and `ending` "open", both are `formula` itself, since the trace
    will contain the whole window.
    """
    cut = ending == "truncate"
    if window is not None and not cut:
        return formula, formula
    return prefix_bound(formula, "lower", cut=cut), prefix_bound(formula, "upper", cut=cut)


def sides_of(plans: ColumnPlans, beyond: int, options: TrackingOptions) -> list[Side]:
    """Return the columns (time series of subformulas) for the lower and for the upper bound on a formula.

    If windows are clipped at the end of the trace, two more entries follow: the columns for both bounds on
    the formula with clipped windows, which differ only where samples are unknown (NaN). `beyond` is the
    number of instants after the last sample at which the formulas read columns.
    """
    sides = [
        Side(plans["lower"], "lower", beyond),
        Side(plans["upper"], "upper", beyond, least=False),
    ]
    if options.ending == "truncate":
        cut = plans["truncate"]
        sides += [Side(cut, "truncate", 0, least=least) for least in (True, False)]
    return sides


def first_needed(planned: ColumnPlan, samples: int) -> int:
    """Return the index of the first sample that is still read after `samples` samples were received."""
    lags = (stream.ahead + stream.back for stream in planned.streams if stream.op is None)
    return max(samples - max(lags, default=0), 0)


class _CutTracker(ABC):
    """Base of evaluators for requirements whose windows may be clipped at the end of the trace (`ending`).

    If windows are to be clipped, they are clipped at settled instants even while the trace continues. At all
    other instants, windows keep their full length, and later samples are unknown.
    """

    __slots__ = ()
    ending: Ending

    @property
    @abstractmethod
    def settled(self) -> int:
        """Index of the first instant at which a later sample may still change the robustness."""

    @abstractmethod
    def bounds(self, starts: range, ending: Ending) -> RobustnessBounds:
        """Return bounds at the instants `starts`, at least one.

        With `ending` "truncate", windows are clipped at the last sample; all instants are settled, or the
        trace has ended. With "open", windows have their full length, and samples outside the trace are
        unknown.
        """

    def live(self, start: int, stop: int) -> RobustnessBounds:
        """Return bounds at the instants `start` to `stop` (exclusive), over all continuations of the trace.

        A predicate that reads a signal before the first sample is false if windows are clipped at the end of
        the trace, and unknown otherwise.
        """
        middle = start if self.ending == "open" else min(max(self.settled, start), stop)
        if middle == start:
            return self.bounds(range(start, stop), "open")
        known = self.bounds(range(start, middle), "truncate")
        if middle == stop:
            return known
        rest = self.bounds(range(middle, stop), "open")
        return RobustnessBounds(*map(np.concatenate, zip(known, rest, strict=True)))

    def ended(self, starts: range) -> RobustnessBounds:
        return self.bounds(starts, self.ending)


@dataclass(slots=True)
class BoundedTracker(_CutTracker):
    """Evaluator, at consecutive instants, of a formula over columns (time series) with bounded windows.

    There is one set of columns per bound (`sides_of`).

    Attributes:
        plans: decompositions into columns: "lower" of the formula for the lower bound, "upper" of the formula
            for the upper bound, "truncate" of the formula itself.
        options: options of the evaluation.
        samples: number of samples received.
    """

    plans: ColumnPlans
    options: TrackingOptions
    samples: int = 0
    ending: Ending = field(init=False)
    _sides: list[Side] = field(init=False)
    _readers: dict[Beyond, ColumnReader] = field(init=False)
    _ahead: int = field(init=False)
    _beyond: int = field(init=False)
    _back: int = field(init=False)

    def __post_init__(self) -> None:
        self.ending = self.options.ending
        self._ahead, self._beyond = self._lookahead(self.plans["truncate"])
        self._back = history(self.plans["truncate"].formula)
        self._sides = sides_of(self.plans, self._ahead + self._beyond, self.options)
        self._readers = {end: ColumnReader([each.formula], end) for end, each in self.plans.items()}

    def _lookahead(self, planned: ColumnPlan) -> tuple[int, int]:
        """Number of later samples on which a value depends, and of rows that are read after these."""
        return reach(planned.formula).future, 0

    @property
    def settled(self) -> int:
        return max(self.samples - self._ahead - self.plans["truncate"].lag, 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        for side in self._sides:
            side.grow(signals, first, samples)
        self.samples = samples

    def bounds(self, starts: range, ending: Ending) -> RobustnessBounds:
        low, high = self._sides[:2] if ending == "open" else self._sides[2:]
        return RobustnessBounds(self._values(low, starts), self._values(high, starts))

    def _values(self, side: Side, starts: range) -> Floats:
        """Return the bound to which the columns in `side` belong, at the instants `starts`, (instants,)."""
        return side.values(self._readers[side.end], starts.start, len(starts))[0][:, 0]

    def ended(self, starts: range) -> RobustnessBounds:
        last = copy(self)
        last._sides = [side.over() for side in self._sides]
        return last.bounds(starts, self.ending)

    def drop(self, start: int) -> int:
        for side in self._sides:
            side.drop(start - self._back)
        return first_needed(self.plans["truncate"], self.samples)


@dataclass(slots=True)
class PlanningWindowTracker(BoundedTracker):
    """Evaluator, at consecutive instants, of a formula in which `end` is the end of a planning window.

    The planning window of instant k ends with sample k + `window`. The value at k depends only on samples up
    to k + `window`.

    An interval in the formula may extend beyond the planning window. Predicates are then unknown beyond the
    window, but past operators that are evaluated there still read samples inside the window. In this case
    samples are processed one by one: the value at k is stored as soon as sample k + `window` arrives.

    Attributes:
        window: number of samples from an instant to the end of its planning window.
    """

    window: int = field(kw_only=True)
    _complete: list[RobustnessBounds] = field(default_factory=list, init=False)
    _first: int = field(default=0, init=False)

    def _lookahead(self, planned: ColumnPlan) -> tuple[int, int]:
        known_later = any(  # columns with known values after the last sample
            each.op or each.back or not isinstance(each.parts[0], ir.Predicate) for each in planned.streams
        )
        beyond = max(reach(planned.formula).future - self.window, 0)
        return self.window, beyond if self.ending == "open" and known_later else 0

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        for now in range(self.samples + 1, samples + 1) if self._beyond else (samples,):
            known = {name: values[: now - first] for name, values in signals.items()}
            BoundedTracker.grow(self, known, first, now)
            if self._beyond and self.settled:
                last = range(self.settled - 1, self.settled)
                self._complete.append(BoundedTracker.bounds(self, last, "open"))

    def bounds(self, starts: range, ending: Ending) -> RobustnessBounds:
        if not self._beyond:
            return BoundedTracker.bounds(self, starts, ending)
        middle = min(max(self.settled, starts.start), starts.stop)
        found = self._complete[starts.start - self._first : middle - self._first]
        if middle < starts.stop:
            found.append(BoundedTracker.bounds(self, range(middle, starts.stop), "open"))
        return RobustnessBounds(*map(np.concatenate, zip(*found, strict=True)))

    def drop(self, start: int) -> int:
        del self._complete[: start - self._first]
        self._first = start
        return BoundedTracker.drop(self, start)

    def _values(self, side: Side, starts: range) -> Floats:
        record = Record(side.rows, NUMPY)
        starts = range(starts.start - side.history.first, starts.stop - side.history.first)
        if self._beyond:
            return self._continued(side, record, starts)
        ends: Ending = "truncate" if side.end == "truncate" else "open"
        low, high = window_bounds(side.plan.formula, record, starts, self.window, ends)
        return np.asarray((high if side.end == "upper" else low)[:, 0])

    def _continued(self, side: Side, record: Record, starts: range) -> Floats:
        """Values at the rows `starts` of a formula with past operators beyond its planning window."""
        formulas, back = [side.plan.formula], self._back
        early = range(starts.start, max(min(back, starts.stop), starts.start))
        ends = [record.values(formulas, range(k, k + 1), side.end, k + self.window + 1)[0] for k in early]
        chosen = np.arange(early.stop, starts.stop)
        if len(chosen):
            rows = np.arange(-back, self.window + self._beyond + 1)[:, None] + chosen
            around = Record({name: x[rows, 0] for name, x in record.env.items()}, NUMPY)
            ends += around.values(formulas, range(back, back + 1), side.end, back + self.window + 1)
        return np.asarray(np.concatenate(ends, axis=1)[0])


@dataclass(slots=True)
class IntervalColumns:
    """Evaluator of several formulas with bounded windows and a common delay.

    The formulas share columns (time series of their predicates and past operators), (rows, 2). A row contains
    the least and the greatest value over all continuations of the trace. One evaluation gives both bounds of
    all formulas.

    Attributes:
        samples: number of samples received.
    """

    samples: int = 0
    side: Side = field(init=False)
    _formulas: list[ir.Formula] = field(default_factory=list)
    _starts: list[int] = field(default_factory=list)
    _reader: ColumnReader = field(init=False)
    _back: int = 0
    _found: tuple[tuple[int, int], list[Floats]] | None = None

    def add(self, formula: ir.Formula) -> IntervalTracker:
        """Add a formula and return its evaluator; allowed before the first sample only."""
        self._formulas.append(formula)
        self._starts.append(0)
        return IntervalTracker(self, len(self._starts) - 1, reach(formula).future)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Add new samples to all formulas, as `Tracker.grow` does to one."""
        if samples == self.samples:
            return
        if not self.samples:
            whole = plan(ir.BoolOp("and", tuple(self._formulas)))
            assert isinstance(whole.formula, ir.BoolOp)
            formulas = whole.formula.items
            beyond = max(reach(formula).future for formula in formulas)
            self.side = Side(whole, "both", beyond, least=None)
            self._reader, self._back = ColumnReader(formulas, "both"), max(map(history, formulas))
        self.side.grow(signals, first, samples)
        self.samples, self._found = samples, None

    def values(self, which: int, start: int, stop: int) -> Floats:
        """Return both bounds on formula number `which` at instants `start` to `stop` - 1, (instants, 2)."""
        if self._found is None or self._found[0] != (start, stop):
            self._found = (start, stop), self.side.values(self._reader, start, stop - start)
        return self._found[1][which]

    def drop(self, which: int, start: int) -> None:
        """Free the rows that no formula needs, now that number `which` needs no instants before `start`."""
        self._starts[which] = start
        self.side.drop(min(self._starts) - self._back)


@dataclass(frozen=True, slots=True)
class IntervalTracker:
    """Evaluator of formula number `which` of those that share columns (time series).

    The lookahead of the formula is `ahead` samples.
    """

    shared: IntervalColumns
    which: int
    ahead: int

    @property
    def samples(self) -> int:
        return self.shared.samples

    @property
    def settled(self) -> int:
        return max(self.shared.samples - self.ahead, 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        self.shared.grow(signals, first, samples)

    def live(self, start: int, stop: int) -> RobustnessBounds:
        return RobustnessBounds(*self.shared.values(self.which, start, stop).T)

    def ended(self, starts: range) -> RobustnessBounds:
        return self.live(starts.start, starts.stop)

    def drop(self, start: int) -> int:
        self.shared.drop(self.which, start)
        return self.shared.samples


@dataclass(slots=True)
class UnboundedTracker:
    """Evaluator of a formula with windows that extend to the end of the trace, at a single instant."""

    plans: ColumnPlans
    options: TrackingOptions
    samples: int = 0
    _fronts: list[UnboundedState] = field(default_factory=list)
    _lag: int = 0
    _back: int = 0

    def __post_init__(self) -> None:
        bones = {end: skeleton(planned.formula) for end, planned in self.plans.items()}
        self._lag = max(bones[end].reach + planned.lag for end, planned in self.plans.items()) + 1
        self._back = max(each.back for each in bones.values())
        beyond = max(bones[end].reach + bones[end].unsure(planned) for end, planned in self.plans.items())
        sides = sides_of(self.plans, beyond, self.options)
        self._fronts = [UnboundedState(bones[side.end], side, self.options.begin) for side in sides]

    @property
    def settled(self) -> int:
        """Always 0, because any later sample may change the value."""
        return 0

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        self.samples = samples
        for front in self._fronts:
            front.side.grow(signals, first, samples)
            front.advance(samples - self._lag)

    def live(self, start: int, stop: int) -> RobustnessBounds:  # noqa: ARG002 - there is one instant
        return RobustnessBounds(*(front.value(self.samples)[0] for front in self._fronts[:2]))

    def ended(self, starts: range) -> RobustnessBounds:  # noqa: ARG002
        last = [replace(front, side=front.side.over()) for front in self._fronts[-2:]]
        return RobustnessBounds(*(each.ended(each.side.plan.formula, self.samples)[0] for each in last))

    def drop(self, start: int) -> int:  # noqa: ARG002
        """Free the samples whose effect is stored in coefficients, which `UnboundedState` explains."""
        for front in self._fronts:
            front.side.drop(min(front.at, self.samples - self._lag) - self._back)
        return first_needed(self.plans["truncate"], self.samples)


@dataclass(slots=True)
class RecomputeTracker(_CutTracker):
    """Evaluator of a requirement that needs the whole trace; every evaluation reads all samples."""

    rule: CompiledRequirement
    horizon: int | None
    ending: Ending
    samples: int = 0
    window: int | None = field(init=False)
    _signals: Mapping[str, Floats] = field(default_factory=dict)
    _ends: tuple[ir.Formula, ir.Formula] = field(init=False)

    def __post_init__(self) -> None:
        self.window = window_of(self.rule, self.horizon)
        self._ends = prefix_bounds(self.rule.formula, self.ending, self.window)

    @property
    def settled(self) -> int:
        if self.window is None and endless(self.rule.formula):
            return 0
        ahead = self.rule.reach if self.window is None else self.window
        return max(self.samples - ahead - looks_on(self.rule.formula), 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:  # noqa: ARG002
        self._signals, self.samples = signals, samples

    def bounds(self, starts: range, ending: Ending) -> RobustnessBounds:
        if ending == "truncate":
            return self.ended(starts)
        low, high = self.of_all(starts)
        return RobustnessBounds(low[:, 0], high[:, 0])

    def of_all(self, starts: range) -> tuple[Floats, Floats]:
        """Return the least and the greatest robustness over all continuations, (instants, traces) each."""
        record = Record.of(with_seen(self._signals), NUMPY)
        low, high = growing_bounds(*self._ends, record, starts, self.window)
        return np.asarray(low), np.asarray(high)

    def ended(self, starts: range) -> RobustnessBounds:
        low, high = cut_bounds(self.rule, Record.of(self._signals, NUMPY), starts, self.horizon, self.ending)
        return RobustnessBounds(low[:, 0], high[:, 0])

    def drop(self, start: int) -> int:  # noqa: ARG002 - all samples are still needed
        return 0


@dataclass(slots=True)
class Trackers:
    """Factory of incremental evaluators (trackers).

    Requirements may share one evaluation if their values are final after the same number of later samples.
    `horizon` is the horizon `T` of the planning window in steps; None if unknown.
    """

    horizon: int | None
    _pairs: dict[tuple[bool, int, int], IntervalColumns] = field(default_factory=dict)

    def of(self, rule: CompiledRequirement, options: TrackingOptions, *, everywhere: bool) -> Tracker:
        """Return the evaluator that needs the least memory for a requirement.

        If `everywhere`, the requirement is evaluated at every instant, else at the first one only.

        Raises:
            UsageError: E313, the requirement takes too much work: every instant needs many values that no
                other instant uses (in a `freeze`, or because `end` moves with the instant).
        """

        def make(part: CompiledRequirement) -> Tracker:
            return Trackers(self.horizon).plain(part, options, everywhere=everywhere)

        tried = make(rule)
        window = tried.window if isinstance(tried, PlanningWindowTracker) else None
        paced = PacedTracker(rule, make, everywhere, isinstance(tried, RecomputeTracker), window)
        found = paced.effort(rule.formula, sum(span(rule.formula)) + (window or 0))
        if found.own > MOST and (heaviest := found.heaviest) is not None:
            freeze = isinstance(heaviest, ir.Freeze)
            what = "every instant keeps values of its own" if freeze else "`end` moves"
            message = f"a stream cannot judge `{rule.name}`: {what}, and {found.own:,} samples to look at"
            advice = ("shorten its intervals", "`stlc check SPEC TRACE` judges a recording")
            raise UsageError(Diagnostic("E313", message, heaviest.span or rule.span, help=advice))
        if paced.stores_all or found.rows > WIDE:
            return paced
        return self.plain(rule, options, everywhere=everywhere)

    def plain(self, rule: CompiledRequirement, options: TrackingOptions, *, everywhere: bool) -> Tracker:
        """Return the evaluator that evaluates the requirement after every sample."""
        formula, window = rule.formula, window_of(rule, self.horizon)
        if window is not None and (bounded := without_end(formula, window)) is not None:
            formula, window = bounded, None
        try:
            lower, upper = prefix_bounds(formula, options.ending, window)
            plans: ColumnPlans = {"lower": plan(lower), "upper": plan(upper), "truncate": plan(formula)}
            if window is not None:
                if plans["truncate"].lag or not everywhere:
                    raise EndlessError
                return PlanningWindowTracker(plans, options, window=window)
            if endless(plans["truncate"].formula):
                if everywhere:
                    raise EndlessError
                return UnboundedTracker(plans, options)
            if options.ending == "truncate" or not shareable(plans):
                return BoundedTracker(plans, options)
        except EndlessError:
            return RecomputeTracker(rule, self.horizon, options.ending)
        counted = (self.horizon if rule.windowed else rule.reach) if everywhere else 0
        later = max(counted or 0, reach(formula).future)
        alike = everywhere, options.begin, later
        return self._pairs.setdefault(alike, IntervalColumns()).add(formula)


def without_end(formula: ir.Formula, window: int) -> ir.Formula | None:
    """Return the formula with bounded windows in place of its windows up to `end`.

    `end` is the end of the planning window, `window` samples after each instant. None is returned in three
    cases, in which the bounded formula would have another value: `end` occurs inside another temporal
    operator; `end` occurs in the function `sweep` (motion between samples); or a bounded window extends
    beyond `end`.
    """

    def ended(part: ir.Formula) -> ir.Formula:
        if isinstance(part, ir.BoolOp):
            return map_children(part, formulas=ended)
        if isinstance(part, (ir.Temporal, ir.Until)) and part.window.hi is None and part.window.lo <= window:
            return replace(part, window=ir.Window(part.window.lo, window))
        return part

    moved = ended(formula)
    return None if endless(moved) or uses_end(moved) or reach(moved).future > window else moved
