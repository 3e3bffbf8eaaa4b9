"""One requirement while its signals come in: what is known of it at which instants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile import ir
from stlc.compile.horizon import reach
from stlc.compile.ops_numpy import NUMPY
from stlc.compile.pipeline import Rule
from stlc.monitor.columns import FAR, End, Reader, Side
from stlc.monitor.endings import lengthened, may_end, with_seen
from stlc.monitor.frontier import Frontier, skeleton
from stlc.monitor.instants import rule_bounds, window_of
from stlc.monitor.streams import EndlessError, Plan, endless, looks_on, plan
from stlc.monitor.values import Record, by_truth, history, window_bounds

Floats: TypeAlias = NDArray[np.float64]
Ending: TypeAlias = Literal["open", "truncate"]
Plans: TypeAlias = Mapping[End, Plan]
"""Least and greatest value wherever the trace ends, and the requirement as it is written."""


@dataclass(frozen=True, slots=True)
class Asked:
    """How values are taken.

    Attributes:
        ending: what becomes of windows that the end of the trace cuts.
        truth: predicates are true or false (+inf or -inf), without any tolerance.
    """

    ending: Ending = "open"
    truth: bool = False


class Bounds(NamedTuple):
    """Least and greatest robustness at consecutive instants, each (instants,)."""

    low: Floats
    high: Floats


class Tracker(Protocol):
    """What is known of a requirement.

    Instants are settled one after the other: from then on their value cannot change.
    """

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


def tracker_of(rule: Rule, horizon: int | None, asked: Asked, *, everywhere: bool) -> Tracker:
    """The tracker of a requirement that needs the least memory.

    Args:
        rule: the requirement.
        horizon: what `T` means, in steps.
        asked: how its values are taken.
        everywhere: it is judged at every instant, and not only at the first one.
    """
    window = window_of(rule, horizon)
    try:
        plans = _plans(rule.formula, asked.ending, window)
        planned = plans["truncate"]
        if window is not None:
            if planned.lag or not everywhere:
                raise EndlessError
            return Everywhere(plans, asked, window)
        if endless(planned.formula):
            if everywhere:
                raise EndlessError
            return FromTheStart(plans, asked)
        return Everywhere(plans, asked, None)
    except EndlessError:
        return Whole(rule, horizon, asked.ending, asked.truth)


def _plans(formula: ir.Formula, ending: Ending, window: int | None) -> Plans:
    lower, upper = (_worst(formula, end, ending, window) for end in ("lower", "upper"))
    return {"lower": plan(lower), "upper": plan(upper), "truncate": plan(formula)}


def _worst(
    formula: ir.Formula, end: Literal["lower", "upper"], ending: Ending, window: int | None
) -> ir.Formula:
    """The formula for one end of what is possible; with a `window`, an early end is unknown or cuts."""
    cut = ending == "truncate"
    return may_end(formula, end, cut=cut) if cut or window is None else formula


def _sides(plans: Plans, beyond: int, asked: Asked) -> list[Side]:
    """Both ends of what is possible, and the ending where it is another one."""
    ends: list[End] = ["lower", "upper"] if asked.ending == "open" else ["lower", "upper", "truncate"]
    return [Side(plans[end], end, 0 if end == "truncate" else beyond, asked.truth) for end in ends]


@dataclass(slots=True)
class Everywhere:
    """A formula whose windows have an end, at consecutive instants.

    With a `window`, the windows to the end of the trace end so many samples after their instant.
    """

    plans: Plans
    asked: Asked
    window: int | None
    samples: int = 0
    _sides: list[Side] = field(default_factory=list)
    _readers: list[Reader] = field(default_factory=list)
    _ahead: int = 0
    _back: int = 0

    def __post_init__(self) -> None:
        formula = self.planned.formula
        self._ahead = reach(formula).future if self.window is None else self.window
        self._back = history(formula)
        self._sides = _sides(self.plans, self._ahead, self.asked)
        self._readers = [Reader([side.plan.formula], side.end) for side in self._sides]

    @property
    def planned(self) -> Plan:
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
            return _decided_first(self, start, stop)
        return self.either(start, stop)

    def certain(self, starts: range) -> Bounds:
        """At settled instants, where windows are cut to the trace."""
        values = self._values(2, starts.start, starts.stop)
        return Bounds(values, values)

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
        return _first_needed(self.planned, self.samples)

    def _values(self, which: int, start: int, stop: int) -> Floats:
        side = self._sides[which]
        if stop <= start:
            return np.zeros(0)
        if self.window is None:
            return side.values(self._readers[which], start, stop - start)[0][:, 0]
        record = Record(side.rows, NUMPY)
        starts = range(start - side.base, stop - side.base)
        ends: Ending = "truncate" if side.end == "truncate" else "open"
        low, high = window_bounds(side.plan.formula, record, starts, self.window, ends)
        return np.asarray((high if side.end == "upper" else low)[:, 0])


def _first_needed(planned: Plan, samples: int) -> int:
    """The first sample whose signals a column still reads."""
    reads = [samples - stream.ahead - stream.back for stream in planned.streams if hasattr(stream, "formula")]
    return max(min(reads, default=samples), 0)


@dataclass(slots=True)
class FromTheStart:
    """A formula with endless windows, at the first sample."""

    plans: Plans
    asked: Asked
    samples: int = 0
    _fronts: list[Frontier] = field(default_factory=list)
    _lag: int = 0
    _back: int = 0

    def __post_init__(self) -> None:
        bones = {end: skeleton(planned.formula) for end, planned in self.plans.items()}
        self._lag = max(bones[end].reach + planned.lag for end, planned in self.plans.items()) + 1
        self._back = max(each.back for each in bones.values())
        beyond = max(bones[end].reach + bones[end].unsure(planned) for end, planned in self.plans.items())
        sides = _sides(self.plans, beyond, self.asked)
        self._fronts = [Frontier(bones[side.end], side) for side in sides]

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
        fronts = self._fronts[:2] if self.asked.ending == "open" else [self._fronts[2]] * 2
        last = [replace(front, side=front.side.over()) for front in fronts]
        found = [front.ended(front.side.plan.formula, self.samples)[0] for front in last]
        return Bounds(found[0][: len(starts)], found[1][: len(starts)])

    def drop(self, start: int) -> int:  # noqa: ARG002 - only the first instant is judged
        """Forget what the frontier has passed."""
        for front in self._fronts:
            front.side.drop(front.at - self._back)
        return _first_needed(self.plans["truncate"], self.samples)


@dataclass(slots=True)
class Whole:
    """A requirement that has to be judged on the whole trace: nothing is forgotten."""

    rule: Rule
    horizon: int | None
    ending: Ending
    truth: bool = False
    samples: int = 0
    _signals: Mapping[str, Floats] = field(default_factory=dict)
    _ends: dict[End, ir.Formula] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.truth:
            self.rule = replace(self.rule, formula=by_truth(self.rule.formula))
        for end in ("lower", "upper"):
            self._ends[end] = _worst(self.rule.formula, end, self.ending, self.window)

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
            return _decided_first(self, start, stop)
        return self.either(start, stop)

    def certain(self, starts: range) -> Bounds:
        """At settled instants, where windows are cut to the trace."""
        return self.ended(starts)

    def either(self, start: int, stop: int) -> Bounds:
        """At any instants, where nothing is assumed of what lies outside of the trace."""
        if stop <= start:
            return Bounds(np.zeros(0), np.zeros(0))
        starts = range(start, stop)
        return Bounds(self._end(starts, "lower"), self._end(starts, "upper"))

    def _end(self, starts: range, end: Literal["lower", "upper"]) -> Floats:
        """One end of what is possible, wherever the trace ends."""
        record, formula = Record(with_seen(self._signals), NUMPY), self._ends[end]
        if self.window is None:
            return np.asarray(record.values([lengthened(formula, self.samples)], starts, end, FAR)[0][:, 0])
        both = window_bounds(formula, record, starts, self.window, "open")
        return np.asarray(both[end == "upper"][:, 0])

    def ended(self, starts: range) -> Bounds:
        """Where the trace is over."""
        low, high = rule_bounds(self.rule, Record(self._signals, NUMPY), starts, self.horizon, self.ending)
        return Bounds(low[:, 0], high[:, 0])

    def drop(self, start: int) -> int:  # noqa: ARG002
        """Nothing can be forgotten."""
        return 0


def _decided_first(tracker: Everywhere | Whole, start: int, stop: int) -> Bounds:
    """Where windows are cut, what a settled instant reads before the first sample is false, not unknown."""
    middle = min(max(tracker.settled, start), stop)
    if middle <= start:
        return tracker.either(start, stop)
    known, rest = tracker.certain(range(start, middle)), tracker.either(middle, stop)
    return Bounds(*map(np.concatenate, zip(known, rest, strict=True)))
