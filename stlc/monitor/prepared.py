"""Signals prepared for the evaluation of requirements: the arrays, their times, and the parts that count."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.compile.semantics.semantics import Semantics
from stlc.diagnostics import TraceError
from stlc.monitor.facts.fact import Fact
from stlc.monitor.signals import Signals
from stlc.monitor.values import Record
from stlc.trace.resample import TimeRange

if TYPE_CHECKING:
    from stlc.monitor.explain.report import Cause
    from stlc.monitor.judgement import RequirementVerdict, Verdict

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Timeline:
    """Times of the samples of a recording.

    Attributes:
        dt: time step in seconds; None if unknown.
        t0: time of the first sample in seconds.
        duration: time from the first to the last sample.
        times: time of each sample, where that differs from the grid; None if it does not.
    """

    dt: float | None
    t0: float
    duration: TimeRange
    times: Floats | None = None

    def time(self, sample: int) -> float:
        """Time of a sample in seconds; the sample number if the time step is unknown."""
        if self.times is not None and 0 <= sample < len(self.times):
            return float(self.times[sample])
        return float(sample) if self.dt is None else self.t0 + sample * self.dt

    def moment(self, sample: int) -> str:
        """Time of a sample as text: `t = 4.6 s`, or `sample 46` if the time step is unknown."""
        return f"sample {sample}" if self.dt is None else f"t = {self.time(sample):.10g} s"


@dataclass(frozen=True, slots=True)
class Prepared:
    """Signals and compiled requirements, ready for evaluation.

    Attributes:
        compiled: the specification, compiled for the time step of the signals.
        rules: the requirements to evaluate.
        signals: the signals with their shape and times.
        record: the same signals as arrays (time, batch), and the array library (NumPy or torch).
        why: function that finds the cause of a violation.
        facts: function that finds the facts that a verdict rests on.
    """

    compiled: Compiled
    rules: tuple[CompiledRequirement, ...]
    signals: Signals
    record: Record
    why: Callable[[RequirementVerdict], Cause | None] = lambda _: None
    facts: Callable[[Verdict], tuple[Fact, ...]] = lambda _: ()

    @property
    def horizon(self) -> int | None:
        """Horizon `T` of the planning window in steps; None if unknown."""
        return self.compiled.grid.horizon

    @property
    def dt(self) -> float | None:
        """Time step in seconds; None if unknown."""
        return None if self.compiled.grid.dt is None else float(self.compiled.grid.dt)

    def under(self, semantics: Semantics) -> Prepared:
        """Return a copy that is evaluated in the given `semantics` (definition of minimum and maximum)."""
        return replace(self, record=replace(self.record, semantics=semantics))

    @property
    def timeline(self) -> Timeline:
        """Times of the samples."""
        signals, last = self.signals, self.record.samples - 1
        found = Timeline(self.dt, signals.t0, TimeRange(0.0, 0.0), signals.times)
        return replace(found, duration=self.whole or TimeRange(found.time(0), found.time(last)))

    def time(self, sample: int) -> float:
        """Time of a sample in seconds; the sample number if the time step is unknown."""
        return self.timeline.time(sample)

    @property
    def whole(self) -> TimeRange | None:
        """Time in which any signal was seen, if signals were seen at different times."""
        spans = self.signals.spans.values()
        if self.signals.dt is None or not spans or not self.signals.samples:
            return None
        first = min(span.first for span in spans)
        return TimeRange(first, max(max(span.last for span in spans), first))

    def seen(self, rule: CompiledRequirement) -> TimeRange | None:
        """Time in which all signals of a requirement were seen (E602 without one); None if it is `whole`."""
        whole = found = self.whole
        if whole is None or found is None or rule.absolute:
            return None
        spans = {name: span for name, span in self.signals.spans.items() if name in rule.formula.columns}
        for span in spans.values():
            found = found.within(span)
        if found.last < found.first:
            told = [
                f"`{name}` is "
                + (f"seen from {x.first:.6g} s to {x.last:.6g} s" if x.first <= x.last else "never seen")
                for name, x in spans.items()
            ]
            message = f"the signals of `{rule.name}` in `{self.signals.name}` have no time in common"
            raise TraceError.of("E602", message, rule.span, note=("; ".join(told),))
        return None if found == whole else found

    def part(self, rule: CompiledRequirement) -> Part:
        """Return the samples on which a requirement is judged: those at which its signals were seen."""
        seen, samples, dt = self.seen(rule), self.signals.samples, self.signals.dt
        if seen is None or dt is None:
            return Part(0, self.record.samples)
        there = seen.samples(self.signals.t0, dt)
        stop = max(min(there.stop, samples), min(there.start, samples - 1) + 1)
        return Part(min(max(there.start, 0), samples - 1), stop, seen)

    def moment(self, sample: int) -> str:
        """Time of a sample as text; see `Timeline.moment`."""
        return self.timeline.moment(sample)


@dataclass(frozen=True, slots=True)
class Part:
    """Samples of a trace on which a requirement is judged.

    Attributes:
        first: index of the first one.
        stop: index after the last one.
        seen: time in which all signals of the requirement were seen; None if that is the whole recording.
    """

    first: int
    stop: int
    seen: TimeRange | None = None
