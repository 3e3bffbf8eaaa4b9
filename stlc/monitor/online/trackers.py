"""One requirement while its signals come in: what is known of it at which instants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import reach, uses_end
from stlc.compile.pipeline import CompiledRequirement
from stlc.diagnostics import Diagnostic, UsageError
from stlc.monitor.holes import unsure
from stlc.monitor.instants import rule_bounds, window_of
from stlc.monitor.online.asked import (
    Bounds,
    ColumnPlans,
    Ending,
    Floats,
    TrackingOptions,
    decided_first,
    first_needed,
    sides_of,
    worst,
)
from stlc.monitor.online.columns import FAR, End
from stlc.monitor.online.everywhere import BoundedTracker
from stlc.monitor.online.interval_columns import IntervalColumns, fits
from stlc.monitor.online.paced import MOST, WIDE, PacedTracker, Work, effort, span
from stlc.monitor.online.streams import EndlessError, endless, looks_on, plan
from stlc.monitor.online.unbounded import UnboundedState, skeleton
from stlc.monitor.online.windowed import PlanningWindowTracker
from stlc.monitor.prefix_bounds import lengthened, with_seen
from stlc.monitor.values import Record, by_truth, window_bounds


class Tracker(Protocol):
    """What is known of a requirement.

    Instants are settled one after the other: from then on their value cannot change.
    """

    @property
    def samples(self) -> int:
        """How many it has taken in."""

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Take new samples in; the arguments are those of `Side.grow`."""

    @property
    def settled(self) -> int:
        """The first instant whose value may still change."""

    def live(self, start: int, stop: int) -> Bounds:
        """Bounds over all continuations at instants that are not settled, or just were."""

    def ended(self, starts: range) -> Bounds:
        """The same where the trace is over and windows to its end end with the last sample."""

    def drop(self, start: int) -> int:
        """Forget instants before `start`; the number of the first sample that is still needed."""


@dataclass(slots=True)
class Trackers:
    """Makes the trackers of requirements; what is counted at the same time shares its columns.

    Attributes:
        horizon: what `T` means, in steps.
    """

    horizon: int | None
    _pairs: dict[tuple[bool, bool, int, int], IntervalColumns] = field(default_factory=dict)

    def of(self, rule: CompiledRequirement, asked: TrackingOptions, *, everywhere: bool) -> Tracker:
        """The tracker of a requirement that needs the least memory.

        Args:
            rule: the requirement.
            asked: how its values are taken.
            everywhere: it is judged at every instant, and not only at the first one.

        Raises:
            UsageError: E313, what every instant has windows of its own for is too much.
        """
        alone = Trackers(self.horizon)
        tried = alone.plain(rule, asked, everywhere=everywhere)
        window = tried.window if isinstance(tried, PlanningWindowTracker) else None

        def make(part: CompiledRequirement) -> Tracker:
            return Trackers(self.horizon).plain(part, asked, everywhere=everywhere)

        paced = PacedTracker(rule, make, everywhere, isinstance(tried, RecomputeTracker), window)
        found = effort(rule.formula, sum(span(rule.formula)) + (window or 0), paced)
        if found.own > MOST:
            raise UsageError(_too_much(rule, found))
        if paced.all_kept or found.rows > WIDE:
            return paced
        return self.plain(rule, asked, everywhere=everywhere)

    def plain(self, rule: CompiledRequirement, asked: TrackingOptions, *, everywhere: bool) -> Tracker:
        """The tracker that judges a requirement after every sample."""
        formula, window = rule.formula, window_of(rule, self.horizon)
        if window is not None and (bounded := without_end(formula, window)) is not None:
            formula, window = bounded, None
        try:
            plans = _plans(formula, asked.ending, window)
            if window is not None:
                if plans["truncate"].lag or not everywhere:
                    raise EndlessError
                return PlanningWindowTracker(plans, asked, window)
            if endless(plans["truncate"].formula):
                if everywhere:
                    raise EndlessError
                return UnboundedTracker(plans, asked)
            if asked.ending == "truncate" or not fits(plans):
                return BoundedTracker(plans, asked)
            counted = (self.horizon if rule.windowed else rule.reach) if everywhere else 0
            later = max(counted or 0, reach(formula).future)
            pairs = self._pairs.setdefault(
                (everywhere, asked.truth, asked.begin, later), IntervalColumns(asked.truth)
            )
            return pairs.add(formula)
        except EndlessError:
            return RecomputeTracker(rule, self.horizon, asked.ending, asked.truth)


def without_end(formula: ir.Formula, window: int) -> ir.Formula | None:
    """The formula with `end` so many samples after its instant; None where `end` depends on more than that.

    It does under another window, for segments that would leave it (`sweep`), and where windows with an end of
    their own reach beyond it.
    """
    moved = _ended(formula, window)
    if moved is None or endless(moved) or uses_end(moved) or reach(moved).future > window:
        return None
    return moved


def _ended(formula: ir.Formula, window: int) -> ir.Formula | None:
    match formula:
        case ir.BoolOp(items=items):
            found = [_ended(item, window) for item in items]
            return None if None in found else replace(formula, items=tuple(each for each in found if each))
        case ir.Temporal(window=ir.Window(lo, None)) | ir.Until(window=ir.Window(lo, None)) if lo <= window:
            return replace(formula, window=ir.Window(lo, window))
        case _:
            return formula


def _too_much(rule: CompiledRequirement, found: Work) -> Diagnostic:
    """E313 for a formula that every instant judges on its own, on too many samples."""
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


def _plans(formula: ir.Formula, ending: Ending, window: int | None) -> ColumnPlans:
    lower, upper = (worst(formula, end, ending, window) for end in ("lower", "upper"))
    return {"lower": plan(lower), "upper": plan(upper), "truncate": plan(formula)}


@dataclass(slots=True)
class UnboundedTracker:
    """A formula with endless windows, at the first sample."""

    plans: ColumnPlans
    asked: TrackingOptions
    samples: int = 0
    _fronts: list[UnboundedState] = field(default_factory=list)
    _lag: int = 0
    _back: int = 0

    def __post_init__(self) -> None:
        bones = {end: skeleton(planned.formula) for end, planned in self.plans.items()}
        self._lag = max(bones[end].reach + planned.lag for end, planned in self.plans.items()) + 1
        self._back = max(each.back for each in bones.values())
        beyond = max(bones[end].reach + bones[end].unsure(planned) for end, planned in self.plans.items())
        sides = sides_of(self.plans, beyond, self.asked)
        begin = self.asked.begin
        self._fronts = [UnboundedState(bones[side.end], side, begin, begin) for side in sides]

    @property
    def settled(self) -> int:
        """Never before the end of the trace."""
        return 0

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Take new samples in."""
        self.samples = samples
        for front in self._fronts:
            front.side.grow(signals, first, samples)
            front.advance(samples - self._lag)

    def live(self, start: int, stop: int) -> Bounds:
        """Bounds over all continuations."""
        if stop <= start:
            return Bounds(np.zeros(0), np.zeros(0))
        low, high = self._fronts[:2]
        return Bounds(low.value(self.samples)[0], high.value(self.samples)[0])

    def ended(self, starts: range) -> Bounds:
        """Where the trace is over."""
        fronts = self._fronts[-2:]
        last = [replace(front, side=front.side.over()) for front in fronts]
        found = [front.ended(front.side.plan.formula, self.samples)[0] for front in last]
        return Bounds(found[0][: len(starts)], found[1][: len(starts)])

    def drop(self, start: int) -> int:  # noqa: ARG002 - only the first instant is judged
        """Forget what the frontier has passed, and before it is reached what nobody reads any more."""
        for front in self._fronts:
            front.side.drop(min(front.at, self.samples - self._lag) - self._back)
        return first_needed(self.plans["truncate"], self.samples)


@dataclass(slots=True)
class RecomputeTracker:
    """A requirement that has to be judged on the whole trace: nothing is forgotten."""

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
        """How many samples after its instant `end` is; None: the end of the trace."""
        return window_of(self.rule, self.horizon)

    @property
    def settled(self) -> int:
        """The first instant whose value may still change."""
        if self.window is None and endless(self.rule.formula):
            return 0
        ahead = self.rule.reach if self.window is None else self.window
        return max(self.samples - ahead - looks_on(self.rule.formula), 0)

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:  # noqa: ARG002
        """Take new samples in."""
        self._signals, self.samples = signals, samples

    def live(self, start: int, stop: int) -> Bounds:
        """Bounds over all continuations."""
        if self.ending == "truncate":
            return decided_first(self, start, stop)
        return self.either(start, stop)

    def certain(self, starts: range) -> Bounds:
        """At settled instants, where windows are cut to the trace."""
        return self.ended(starts)

    def either(self, start: int, stop: int) -> Bounds:
        """At any instants, where nothing is assumed of what lies outside of the trace."""
        if stop <= start:
            return Bounds(np.zeros(0), np.zeros(0))
        starts = range(start, stop)
        low, high = self.of_all(starts)
        return Bounds(low[:, 0], high[:, 0])

    def of_all(self, starts: range) -> tuple[Floats, Floats]:
        """Both ends of what is possible, wherever the traces end: (instants, traces) each."""
        record, window = Record.of(with_seen(self._signals), NUMPY), self.window
        lower, upper = self._ends["lower"], self._ends["upper"]
        if window is None:
            if self._long[0] != self.samples:
                self._long = self.samples, lengthened(lower, self.samples), lengthened(upper, self.samples)
            least, most = self._long[1:]
            if record.holes:
                least, most = (
                    unsure(least, record.holes, least=True),
                    unsure(most, record.holes, least=False),
                )
            low = record.values([least], starts, "lower", FAR)[0]
            high = record.values([most], starts, "upper", FAR)[0]
            return np.asarray(low), np.asarray(high)
        low, high = window_bounds(lower, record, starts, window, "open")
        if upper != lower:
            high = window_bounds(upper, record, starts, window, "open")[1]
        return np.asarray(low), np.asarray(high)

    def ended(self, starts: range) -> Bounds:
        """Where the trace is over."""
        low, high = rule_bounds(self.rule, Record.of(self._signals, NUMPY), starts, self.horizon, self.ending)
        return Bounds(low[:, 0], high[:, 0])

    def drop(self, start: int) -> int:  # noqa: ARG002
        """Nothing can be forgotten."""
        return 0
