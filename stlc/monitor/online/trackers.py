"""Incremental evaluators (trackers) of one requirement on a growing trace, and the choice among them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import history, reach, uses_end
from stlc.compile.ir.traverse import map_children
from stlc.compile.pipeline import CompiledRequirement
from stlc.diagnostics import Diagnostic, UsageError
from stlc.monitor.instants import rule_bounds, window_of
from stlc.monitor.online.bounds import Ending, Floats, RobustnessBounds, Tracker, TrackingOptions
from stlc.monitor.online.columns import Beyond, ColumnPlans, ColumnReader, End, Side, shareable
from stlc.monitor.online.paced import MOST, WIDE, PacedTracker, PacedWork, span
from stlc.monitor.online.streams import (
    ColumnPlan,
    EndlessError,
    PredicateColumn,
    RecursiveColumn,
    endless,
    looks_on,
    plan,
)
from stlc.monitor.online.unbounded import UnboundedOperators, UnboundedState, skeleton
from stlc.monitor.prefix_bounds import FAR, lengthened, prefix_bound, with_seen
from stlc.monitor.values import Record, by_truth, window_bounds


def worst(
    formula: ir.Formula, end: Literal["lower", "upper"], ending: Ending, window: int | None
) -> ir.Formula:
    """Return a formula whose value is a bound on `formula` while the trace is still growing.

    The bound is valid wherever the trace may end: with the latest sample or with any later sample.

    Args:
        formula: the formula to bound.
        end: "lower" or "upper" bound.
        ending: "truncate" if windows are clipped at the end of the trace, else "open".
        window: length in samples of the planning window that the requirement refers to; None without a
            planning window. With a planning window and `ending` "open", `formula` itself is returned, since
            the trace will contain the whole window.
    """
    cut = ending == "truncate"
    return prefix_bound(formula, end, cut=cut) if cut or window is None else formula


def sides_of(plans: ColumnPlans, beyond: int, options: TrackingOptions) -> list[Side]:
    """Return the columns from which the lower and the upper bound on a formula are computed.

    A column is the time series of a subformula. `plans` contains the decompositions into columns. The first
    entry of the list is for the lower bound, the second for the upper bound. If windows are clipped at the
    end of the trace, two more entries follow: the columns for both bounds on the formula with clipped
    windows. These two bounds differ only where samples are unknown (NaN). `beyond` is the number of instants
    after the last sample at which the formulas read columns.
    """
    sides = [
        Side(plans["lower"], "lower", beyond, options.truth),
        Side(plans["upper"], "upper", beyond, options.truth, least=False),
    ]
    if options.ending == "truncate":
        cut = plans["truncate"]
        sides += [Side(cut, "truncate", 0, options.truth, least=least) for least in (True, False)]
    return sides


def first_needed(planned: ColumnPlan, samples: int) -> int:
    """Return the index of the first sample that later evaluations still read.

    `samples` is the number of samples received. The predicates in `planned` determine how far evaluations
    read back.
    """
    predicates = [stream for stream in planned.streams if isinstance(stream, PredicateColumn)]
    return max(min((samples - each.ahead - each.back for each in predicates), default=samples), 0)


# ----------------------------------------------------------------------------- in common


class _CutTracker(ABC):
    """Base of evaluators for requirements whose windows may be clipped at the end of the trace.

    An instant is settled if no later sample can change its value. If windows are to be clipped, they are
    clipped at settled instants even while the trace continues. At all other instants, windows keep their full
    length, later samples are unknown, and bounds are computed.
    """

    __slots__ = ()

    @property
    @abstractmethod
    def settled(self) -> int:
        """Index of the first instant at which a later sample may still change the robustness."""

    @property
    @abstractmethod
    def cuts(self) -> bool:
        """True if windows are clipped at the end of the trace."""

    @abstractmethod
    def certain(self, starts: range) -> RobustnessBounds:
        """Return bounds at the instants `starts`, with windows clipped at the last sample.

        The method is for settled instants, whose value no later sample can change, and for a trace that has
        ended.
        """

    @abstractmethod
    def either(self, start: int, stop: int) -> RobustnessBounds:
        """Return bounds at the instants from `start` to `stop` (exclusive), with windows of full length.

        Samples outside the trace are unknown.
        """

    def live(self, start: int, stop: int) -> RobustnessBounds:
        """Return bounds at the instants `start` to `stop` (exclusive), over all continuations of the trace.

        A predicate that reads a signal before the first sample is false if windows are clipped at the end of
        the trace, and unknown otherwise.
        """
        middle = min(max(self.settled, start), stop)
        if not self.cuts or middle <= start:
            return self.either(start, stop)
        known, rest = self.certain(range(start, middle)), self.either(middle, stop)
        return RobustnessBounds(*map(np.concatenate, zip(known, rest, strict=True)))

    def ended(self, starts: range) -> RobustnessBounds:
        return self.certain(starts) if self.cuts else self.either(starts.start, starts.stop)


@dataclass(slots=True)
class _ColumnTracker(_CutTracker):
    """Evaluator of a formula over columns (time series of its predicates and past operators).

    There is one set of columns for the lower bound and one for the upper bound. If windows are clipped at the
    end of the trace, there are two more sets, for the two bounds with clipped windows.

    Attributes:
        plans: decompositions into columns: "lower" of the formula for the lower bound, "upper" of the formula
            for the upper bound, "truncate" of the formula itself.
        options: options of the evaluation.
        samples: number of samples received.
    """

    plans: ColumnPlans
    options: TrackingOptions
    samples: int = 0
    _sides: list[Side] = field(default_factory=list, init=False)
    _back: int = field(default=0, init=False)

    @property
    def planned(self) -> ColumnPlan:
        """Columns (time series of subformulas) of the formula itself, not of its lower or upper bound."""
        return self.plans["truncate"]

    @property
    def cuts(self) -> bool:
        return self.options.ending == "truncate"

    def certain(self, starts: range) -> RobustnessBounds:
        return RobustnessBounds(*(self._values(which, starts.start, starts.stop) for which in (2, 3)))

    def either(self, start: int, stop: int) -> RobustnessBounds:
        return RobustnessBounds(self._values(0, start, stop), self._values(1, start, stop))

    def drop(self, start: int) -> int:
        for side in self._sides:
            side.drop(start - self._back)
        return first_needed(self.planned, self.samples)

    @abstractmethod
    def _values(self, which: int, start: int, stop: int) -> Floats:
        """Return one bound at the instants from `start` to `stop` (exclusive), (instants,).

        `which` selects the bound: 0 is the lower and 1 the upper bound. If windows are clipped at the end of
        the trace, 2 is the lower and 3 the upper bound with clipped windows.
        """


def _plans(formula: ir.Formula, ending: Ending, window: int | None) -> ColumnPlans:
    lower, upper = (worst(formula, end, ending, window) for end in ("lower", "upper"))
    return {"lower": plan(lower), "upper": plan(upper), "truncate": plan(formula)}


# ----------------------------------------------------------------------------- trackers


@dataclass(slots=True)
class BoundedTracker(_ColumnTracker):
    """Evaluator of a formula whose windows are all bounded; it returns values at consecutive instants."""

    _readers: list[ColumnReader] = field(default_factory=list, init=False)
    _ahead: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        formula = self.planned.formula
        self._ahead, self._back = reach(formula).future, history(formula)
        self._sides = sides_of(self.plans, self._ahead, self.options)
        self._readers = [ColumnReader([side.plan.formula], side.end) for side in self._sides]

    @property
    def settled(self) -> int:
        """Index of the first instant whose value later samples may still change."""
        return max(self.samples - self._ahead - self.planned.lag, 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        for side in self._sides:
            side.grow(signals, first, samples)
        self.samples = samples

    def ended(self, starts: range) -> RobustnessBounds:
        last = copy(self)
        last._sides = [side.over() for side in self._sides]
        return _CutTracker.ended(last, starts)

    def _values(self, which: int, start: int, stop: int) -> Floats:
        if stop <= start:
            return np.zeros(0)
        return self._sides[which].values(self._readers[which], start, stop - start)[0][:, 0]


@dataclass(slots=True)
class IntervalColumns:
    """Evaluator of several formulas with bounded windows and a common delay.

    The delay is the number of later samples after which the value at an instant is final.

    The formulas share columns (time series of their predicates and past operators), (rows, 2). A row contains
    the least and the greatest value over all continuations of the trace. One evaluation gives both bounds of
    all formulas.

    Attributes:
        truth: whether the value of a predicate is its truth value, +inf or -inf, instead of its margin.
        samples: number of samples received.
    """

    truth: bool
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
        """Add new samples to all formulas.

        Args:
            signals: signal name -> stored samples (stored, traces), up to the newest sample.
            first: index in the trace of the first stored sample.
            samples: number of samples that the trace now has.
        """
        if samples == self.samples:
            return
        if not self.samples:
            whole = plan(ir.BoolOp("and", tuple(self._formulas)))
            assert isinstance(whole.formula, ir.BoolOp)
            formulas = whole.formula.items
            beyond = max(reach(formula).future for formula in formulas)
            self.side = Side(whole, "both", beyond, self.truth, least=None)
            self._reader, self._back = ColumnReader(formulas, "both"), max(map(history, formulas))
        self.side.grow(signals, first, samples)
        self.samples, self._found = samples, None

    def values(self, which: int, start: int, stop: int) -> Floats:
        """Return the lower and the upper bound on formula number `which`, (instants, 2).

        The instants are those from `start` to `stop` (exclusive).
        """
        if self._found is None or self._found[0] != (start, stop):
            self._found = (start, stop), self.side.values(self._reader, start, stop - start)
        return self._found[1][which]

    def drop(self, which: int, start: int) -> None:
        """Free the rows that no formula needs any more.

        From now on, formula number `which` does not need the instants before `start`.
        """
        self._starts[which] = start
        self.side.drop(min(self._starts) - self._back)


@dataclass(frozen=True, slots=True)
class IntervalTracker:
    """Evaluator of one formula with bounded windows, which shares columns (time series) with other formulas.

    Attributes:
        shared: the shared columns.
        which: index of the formula among those that share the columns.
        ahead: lookahead in samples.
    """

    shared: IntervalColumns
    which: int
    ahead: int

    @property
    def samples(self) -> int:
        return self.shared.samples

    @property
    def settled(self) -> int:
        """Index of the first instant whose value later samples may still change."""
        return max(self.shared.samples - self.ahead, 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        self.shared.grow(signals, first, samples)

    def live(self, start: int, stop: int) -> RobustnessBounds:
        if stop <= start:
            return RobustnessBounds(np.zeros(0), np.zeros(0))
        return RobustnessBounds(*self.shared.values(self.which, start, stop).T)

    def ended(self, starts: range) -> RobustnessBounds:
        """Final bounds on the robustness at the instants `starts`, now that the trace has ended.

        If the formula reads samples after the end of the trace, these stay unknown.
        """
        return self.live(starts.start, starts.stop)

    def drop(self, start: int) -> int:
        """Free the memory of instants before `start`; return the index of the first sample still needed.

        The result is the index of the next sample to arrive, because the stored samples are not needed any
        more.
        """
        self.shared.drop(self.which, start)
        return self.shared.samples


@dataclass(slots=True)
class PlanningWindowTracker(_ColumnTracker):
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
    _beyond: int = field(default=0, init=False)
    _complete: list[RobustnessBounds] = field(default_factory=list, init=False)
    _first: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        formula = self.planned.formula
        self._back = history(formula)
        if self.options.ending == "open" and _remembers(self.planned):
            self._beyond = max(reach(formula).future - self.window, 0)
        self._sides = sides_of(self.plans, self.window + self._beyond, self.options)

    @property
    def settled(self) -> int:
        """Index of the first instant whose value later samples may still change."""
        return max(self.samples - self.window, 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        for now in range(self.samples + 1, samples + 1) if self._beyond else (samples,):
            known = {name: values[: now - first] for name, values in signals.items()}
            for side in self._sides:
                side.grow(known, first, now)
            self.samples = now
            if self._beyond and self.settled:
                self._complete.append(_ColumnTracker.either(self, self.settled - 1, self.settled))

    def either(self, start: int, stop: int) -> RobustnessBounds:
        if not self._beyond:
            return _ColumnTracker.either(self, start, stop)
        middle = min(max(self.settled, start), stop)
        complete = self._complete[start - self._first : middle - self._first]
        return RobustnessBounds(
            *map(np.concatenate, zip(*complete, _ColumnTracker.either(self, middle, stop), strict=True))
        )

    def drop(self, start: int) -> int:
        del self._complete[: start - self._first]
        self._first = start
        return _ColumnTracker.drop(self, start)

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
        """Values (instants,) of a formula that evaluates past operators beyond its planning window.

        `starts` are the instants, as row numbers. `record` contains the columns (time series of subformulas)
        of `side`.
        """
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
    """True if a column (time series of a subformula) has known values after the last sample.

    This is possible for a past operator, a predicate that reads earlier samples, and a `freeze`.
    """
    return any(
        isinstance(stream, RecursiveColumn) or stream.back > 0 or not isinstance(stream.formula, ir.Predicate)
        for stream in planned.streams
    )


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
        bones: dict[Beyond, UnboundedOperators] = {
            end: skeleton(planned.formula) for end, planned in self.plans.items()
        }
        self._lag = max(bones[end].reach + planned.lag for end, planned in self.plans.items()) + 1
        self._back = max(each.back for each in bones.values())
        beyond = max(bones[end].reach + bones[end].unsure(planned) for end, planned in self.plans.items())
        sides = sides_of(self.plans, beyond, self.options)
        begin = self.options.begin
        self._fronts = [UnboundedState(bones[side.end], side, begin, begin) for side in sides]

    @property
    def settled(self) -> int:
        """Index of the first instant whose value may still change.

        This is always 0, because any later sample may change the value.
        """
        return 0

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        self.samples = samples
        for front in self._fronts:
            front.side.grow(signals, first, samples)
            front.advance(samples - self._lag)

    def live(self, start: int, stop: int) -> RobustnessBounds:
        if stop <= start:
            return RobustnessBounds(np.zeros(0), np.zeros(0))
        low, high = self._fronts[:2]
        return RobustnessBounds(low.value(self.samples)[0], high.value(self.samples)[0])

    def ended(self, starts: range) -> RobustnessBounds:
        fronts = self._fronts[-2:]
        last = [replace(front, side=front.side.over()) for front in fronts]
        found = [front.ended(front.side.plan.formula, self.samples)[0] for front in last]
        return RobustnessBounds(found[0][: len(starts)], found[1][: len(starts)])

    def drop(self, start: int) -> int:  # noqa: ARG002 - only the first instant is evaluated
        """Free the samples that later evaluations do not need; return the index of the first one needed.

        The effect of the freed samples is stored in coefficients, which `UnboundedState` explains.
        """
        for front in self._fronts:
            front.side.drop(min(front.at, self.samples - self._lag) - self._back)
        return first_needed(self.plans["truncate"], self.samples)


@dataclass(slots=True)
class RecomputeTracker(_CutTracker):
    """Evaluator of a requirement that needs the whole trace; every evaluation reads all samples."""

    rule: CompiledRequirement
    horizon: int | None
    ending: Ending
    truth: bool = False
    samples: int = 0
    _signals: Mapping[str, Floats] = field(default_factory=dict)
    _ends: dict[End, ir.Formula] = field(default_factory=dict)
    _long: tuple[int, ir.Formula, ir.Formula] = (-1, ir.Truth(True), ir.Truth(True))

    def __post_init__(self) -> None:
        if self.truth:
            self.rule = replace(self.rule, formula=by_truth(self.rule.formula))
        for end in ("lower", "upper"):
            self._ends[end] = worst(self.rule.formula, end, self.ending, self.window)

    @property
    def window(self) -> int | None:
        """Number of samples from an instant to the end of its planning window; None without such a window."""
        return window_of(self.rule, self.horizon)

    @property
    def settled(self) -> int:
        """Index of the first instant whose value later samples may still change."""
        if self.window is None and endless(self.rule.formula):
            return 0
        ahead = self.rule.reach if self.window is None else self.window
        return max(self.samples - ahead - looks_on(self.rule.formula), 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:  # noqa: ARG002
        self._signals, self.samples = signals, samples

    @property
    def cuts(self) -> bool:
        return self.ending == "truncate"

    def certain(self, starts: range) -> RobustnessBounds:
        return self.ended(starts)

    def either(self, start: int, stop: int) -> RobustnessBounds:
        if stop <= start:
            return RobustnessBounds(np.zeros(0), np.zeros(0))
        starts = range(start, stop)
        low, high = self.of_all(starts)
        return RobustnessBounds(low[:, 0], high[:, 0])

    def of_all(self, starts: range) -> tuple[Floats, Floats]:
        """Return the least and the greatest robustness over all continuations of the traces.

        Each array, (instants, traces), has one row per instant in `starts`.
        """
        record, window = Record.of(with_seen(self._signals), NUMPY), self.window
        lower, upper = self._ends["lower"], self._ends["upper"]
        if window is None:
            if self._long[0] != self.samples:
                self._long = self.samples, lengthened(lower, self.samples), lengthened(upper, self.samples)
            least, most = self._long[1:]
            least, most = record.sides(least)[0], record.sides(most)[1]
            low = record.values([least], starts, "lower", FAR)[0]
            high = record.values([most], starts, "upper", FAR)[0]
            return np.asarray(low), np.asarray(high)
        low, high = window_bounds(lower, record, starts, window, "open")
        if upper != lower:
            high = window_bounds(upper, record, starts, window, "open")[1]
        return np.asarray(low), np.asarray(high)

    def ended(self, starts: range) -> RobustnessBounds:
        low, high = rule_bounds(self.rule, Record.of(self._signals, NUMPY), starts, self.horizon, self.ending)
        return RobustnessBounds(low[:, 0], high[:, 0])

    def drop(self, start: int) -> int:  # noqa: ARG002
        """Return 0: all samples, from the first one on, are still needed."""
        return 0


# ----------------------------------------------------------------------------- which one


@dataclass(slots=True)
class Trackers:
    """Factory of incremental evaluators (trackers).

    Requirements with the same delay may share one evaluation. The delay is the number of later samples after
    which the value at an instant is final.

    Attributes:
        horizon: horizon `T` of the planning window in steps; None if unknown.
    """

    horizon: int | None
    _pairs: dict[tuple[bool, bool, int, int], IntervalColumns] = field(default_factory=dict)

    def of(self, rule: CompiledRequirement, options: TrackingOptions, *, everywhere: bool) -> Tracker:
        """Return the evaluator that needs the least memory for a requirement.

        Args:
            rule: the requirement.
            options: options of the evaluation.
            everywhere: whether the requirement is evaluated at every instant or only at the first one.

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
        if found.own > MOST:
            raise UsageError(_too_much(rule, found))
        if paced.stores_all or found.rows > WIDE:
            return paced
        return self.plain(rule, options, everywhere=everywhere)

    def plain(self, rule: CompiledRequirement, options: TrackingOptions, *, everywhere: bool) -> Tracker:
        """Return the evaluator that evaluates the requirement after every sample."""
        formula, window = rule.formula, window_of(rule, self.horizon)
        if window is not None and (bounded := without_end(formula, window)) is not None:
            formula, window = bounded, None
        try:
            plans = _plans(formula, options.ending, window)
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
            counted = (self.horizon if rule.windowed else rule.reach) if everywhere else 0
            later = max(counted or 0, reach(formula).future)
            pairs = self._pairs.setdefault(
                (everywhere, options.truth, options.begin, later), IntervalColumns(options.truth)
            )
            return pairs.add(formula)
        except EndlessError:
            return RecomputeTracker(rule, self.horizon, options.ending, options.truth)


def without_end(formula: ir.Formula, window: int) -> ir.Formula | None:
    """Return the formula with bounded windows in place of its windows up to `end`.

    `end` is the end of the planning window, `window` samples after each instant. None is returned in three
    cases, in which the bounded formula would have another value: `end` occurs inside another temporal
    operator; `end` occurs in the function `sweep` (motion between samples); or a bounded window extends
    beyond `end`.
    """
    moved = _ended(formula, window)
    return None if endless(moved) or uses_end(moved) or reach(moved).future > window else moved


def _ended(formula: ir.Formula, window: int) -> ir.Formula:
    match formula:
        case ir.BoolOp():
            return map_children(formula, formulas=lambda item: _ended(item, window))
        case ir.Temporal(window=ir.Window(lo, None)) | ir.Until(window=ir.Window(lo, None)) if lo <= window:
            return replace(formula, window=ir.Window(lo, window))
        case _:
            return formula


def _too_much(rule: CompiledRequirement, found: PacedWork) -> Diagnostic:
    """Finding E313: the requirement `rule` takes too much work on a stream.

    Every instant needs many values that no other instant uses. `found` is the amount of work.
    """
    assert found.heaviest is not None
    what = "every instant keeps values of its own" if isinstance(found.heaviest, ir.Freeze) else "`end` moves"
    return Diagnostic(
        "E313",
        f"a stream cannot judge `{rule.name}`: {what}, and {found.own:,} samples to look at",
        found.heaviest.span or rule.span,
        help=(
            "shorten its intervals",
            "`stlc check SPEC TRACE` judges a recording",
        ),
    )
