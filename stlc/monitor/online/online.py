"""Online monitor: bounds on the robustness after each sample, verdicts once decided, in bounded memory."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias, final

import numpy as np

from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.diagnostics import Diagnostic, TraceError, UsageError
from stlc.monitor.explain.report import Cause
from stlc.monitor.instants import At, beyond, check_length, starts_of, widened
from stlc.monitor.judgement import Status, unknown_requirement
from stlc.monitor.online.bounds import RobustnessBounds, Tracker, TrackingOptions
from stlc.monitor.online.history import ColumnHistory, Floats
from stlc.monitor.online.paced import PacedTracker
from stlc.monitor.online.tally import Flags, JudgedInstants, RequirementSummary
from stlc.monitor.online.trace_buffer import TraceBuffer, Worst
from stlc.monitor.online.trackers import Trackers
from stlc.monitor.signals import Gap, Need, arrange, needs_of
from stlc.monitor.values import decisive
from stlc.trace import Trace

Sample: TypeAlias = Mapping[str, Any]
"""Signal -> number; a vector is a list of them."""

_BEYOND_FLOATS = 1 << 1023


@dataclass(frozen=True, slots=True)
class Decision:
    """A final verdict of one requirement at one instant.

    Attributes:
        requirement: name of the requirement.
        start: sample at which the requirement was evaluated.
        time: time of `start` in seconds; the sample number if the time step is unknown.
        status: satisfied or violated.
        low: least robustness over all continuations of the trace.
        high: greatest robustness over all continuations.
        sample: index of the sample that decided the verdict.
    """

    requirement: str
    start: int
    time: float
    status: Status
    low: float
    high: float
    sample: int


@dataclass(frozen=True, slots=True)
class How:
    """Options of an online monitor.

    Attributes:
        at: instants at which to evaluate the requirements: "all" for every sample, a number for that sample,
            or None for the instants that each requirement prescribes (`stlc.monitor.instants`).
        end: treatment of windows that extend beyond the end of the stream: "open" computes bounds, "strict"
            raises an error, "truncate" clips the windows.
        tolerance: a requirement is satisfied if its robustness is at least minus this value. If the tolerance
            is 0, the truth values of the predicates decide: then `<` and `<=` differ.
        t0: time of the first sample in seconds.
        reasons: whether to store the samples that `Online.cause` needs.
    """

    at: At = None
    end: Literal["open", "strict", "truncate"] = "open"
    tolerance: float = TOLERANCE
    t0: float = 0.0
    reasons: bool = False


@final
@dataclass(slots=True)
class Watched:
    """A requirement with its incremental evaluators (trackers) and its running verdict.

    Attributes:
        rule: the requirement.
        everywhere: whether the requirement is evaluated at every sample or only at one.
        values: evaluator of the robustness.
        truths: evaluator of the robustness that decides, if it is another one (`stlc.monitor.values`).
        tolerance: the tolerance, as in `How`.
        tally: summary of the instants whose verdict is final; these instants are called counted.
        cut: whether windows are clipped at the end of the trace.
        horizon: length of a planning window in steps; None if unknown.
        decided: whether an instant already has a verdict, (instants,). The first entry belongs to the first
            instant that is not counted.
    """

    rule: CompiledRequirement
    everywhere: bool
    values: Tracker
    truths: Tracker | None
    tolerance: float
    tally: RequirementSummary = field(default_factory=RequirementSummary)
    cut: bool = False
    horizon: int | None = None
    decided: Flags = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))

    @property
    def trackers(self) -> tuple[Tracker, ...]:
        """The evaluator of robustness and, if it is another, that of the robustness that decides."""
        return (self.values,) if self.truths is None else (self.values, self.truths)

    @property
    def over(self) -> bool:
        """True if the requirement is evaluated only once, and its verdict is final."""
        return not self.everywhere and self.tally.instants > 0

    @property
    def pending(self) -> range:
        """The received instants that are not yet part of the summary `tally`."""
        samples = self.values.samples
        return range(self.tally.next, samples if self.everywhere else min(self.tally.first + 1, samples))

    def grow(self, history: ColumnHistory) -> None:
        """Pass new samples to the evaluators."""
        if self.over or self.values.samples == history.samples:
            return
        signals = history.columns()
        for tracker in self.trackers:
            tracker.grow(signals, history.first, history.samples)

    def due(self, samples: int) -> bool:
        """True if the requirement is to be evaluated now that `samples` samples have been received."""
        return not self.over and (not isinstance(self.values, PacedTracker) or self.values.due(samples))

    def judged(self, starts: range) -> JudgedInstants:
        """Return bounds and verdicts at the instants `starts` while the trace continues."""
        if not starts:
            return self._judged(RobustnessBounds(np.zeros(0), np.zeros(0)))
        return self._judged(*(tracker.live(starts.start, starts.stop) for tracker in self.trackers))

    def ended(self, starts: range) -> JudgedInstants:
        """Return bounds and verdicts at the instants `starts` once the trace has ended."""
        return self._judged(*(self._ended(tracker, starts) for tracker in self.trackers))

    def _ended(self, tracker: Tracker, starts: range) -> RobustnessBounds:
        """Bounds once the trace has ended; where a window begins beyond its end, it may also go on."""
        found = tracker.ended(starts)
        if not self.cut:
            return found
        outside = beyond(self.rule, starts, self.values.samples, self.horizon)
        if not outside.any():
            return found
        return RobustnessBounds(*widened(outside, found, tracker.live(starts.start, starts.stop)))

    def _judged(self, bounds: RobustnessBounds, truths: RobustnessBounds | None = None) -> JudgedInstants:
        least, most = truths or bounds
        return JudgedInstants(*bounds, least >= -self.tolerance, most < -self.tolerance)

    def drop(self) -> int:
        """Free the memory of final instants; return the index of the first sample that is still needed."""
        return min(tracker.drop(min(self.tally.next, tracker.settled)) for tracker in self.trackers)


class Online:
    """Monitor of a stream of samples; made by `Monitor.online`.

    Memory is bounded by the windows of the requirements, not by the length of the stream. An unbounded future
    window takes constant memory, unless it is inside a bounded window. In that case all samples are stored,
    and the requirement is evaluated on all of them.
    """

    def __init__(
        self, compiled: Compiled, rules: Sequence[CompiledRequirement], how: How | None = None
    ) -> None:
        self.how = how or How()
        self.compiled = compiled
        self._needs = needs_of(compiled, [*rules, *compiled.assumptions])
        self._names = [need.column.name for need in self._needs]
        self.gaps: dict[str, Gap] = {}
        """Samples at which signals are unknown."""
        self._history = ColumnHistory()
        self._trackers = Trackers(compiled.grid.horizon)
        self._watched = [self._watch(rule) for rule in rules]
        self._scope = [self._watch(rule, once=True) for rule in compiled.assumptions]
        self._buffer = TraceBuffer(compiled, self.how.t0) if self.how.reasons else None

    def _watch(self, rule: CompiledRequirement, *, once: bool = False) -> Watched:
        horizon = self.compiled.grid.horizon
        begin = self.how.at if isinstance(self.how.at, int) and not once else 0
        once = once or rule.absolute or isinstance(self.how.at, int)
        everywhere = not once and (self.how.at == "all" or (rule.windowed and horizon is not None))
        if everywhere and not rule.windowed and rule.uses_end:
            message = f"`{rule.name}` runs to the end: at every start it would stay open until then"
            raise UsageError(Diagnostic("U101", message, help=("judge it once, without `--at all`",)))
        ending: Literal["open", "truncate"] = "truncate" if self.how.end == "truncate" else "open"
        options = TrackingOptions(ending, begin=begin)
        values, truths = self._trackers.of(rule, options, everywhere=everywhere), None
        if (deciding := decisive(rule, self.how.tolerance, self.compiled.signature)) is not rule:
            truths = self._trackers.of(deciding, options, everywhere=everywhere)
        tally = RequirementSummary(low_at=begin, high_at=begin, first=begin)
        cut = ending == "truncate"
        return Watched(rule, everywhere, values, truths, self.how.tolerance, tally, cut, horizon)

    def push(self, sample: Sample) -> tuple[Decision, ...]:
        """Add one sample; return the verdicts that this sample decides, in the order of the requirements.

        NaN is an unknown value.

        Raises:
            TraceError: E601, a signal is missing; E605, a value is not a single number.
        """
        values = [_number(sample, need) for need in self._needs]
        rows = np.array(values).reshape(-1, 1, 1)
        holes = [name for name, value in zip(self._names, values, strict=True) if math.isnan(value)]
        self._take(dict(zip(self._names, rows, strict=True)), 1, holes)
        found: list[Decision] = []
        for watched in self._watched:
            if watched.due(self.samples):
                watched.grow(self._history)
                found += self._decide(watched)
        self._settle(self._scope)
        return tuple(found)

    def feed(self, signals: Mapping[str, Any] | Trace) -> None:
        """Add many samples at once: arrays (time,) by signal name, or a trace or a part of it.

        Verdicts are counted, but not returned one by one.

        Raises:
            TraceError: the errors of `push`.
        """
        laid = arrange(signals, self._needs, plain=True)
        columns = {name: np.asarray(values).reshape(laid.samples, 1) for name, values in laid.env.items()}
        self._take(columns, laid.samples, [name for name in self._names if np.isnan(columns[name]).any()])
        self._settle((*self._watched, *self._scope))

    def _take(self, columns: dict[str, Floats], count: int, holes: Sequence[str]) -> None:
        """Store `count` samples: arrays (count, 1) by signal name; `holes` have unknown samples."""
        for name in holes:
            self.gaps[name] = self.gaps.get(name, Gap()).with_more(np.isnan(columns[name]), self.samples)
        columns = columns or {"": np.zeros((count, 1))}
        self._history.take(columns, count)
        if self._buffer is None:
            return
        self._buffer.take(columns, count)
        if self._buffer.full:
            found = [(watched.rule, self._worst(watched)) for watched in self._watched]
            self._buffer.forget([(rule, worst) for rule, worst in found if worst is not None])

    def _decide(self, watched: Watched) -> list[Decision]:
        """Return the verdicts that the latest sample decides, and count the final instants."""
        found: list[Decision] = []
        starts = watched.pending
        judged = watched.judged(starts)
        known = judged.holds | judged.fails
        if np.count_nonzero(known) > np.count_nonzero(watched.decided):
            new = known.copy()
            new[: len(watched.decided)] &= ~watched.decided
            for i in np.flatnonzero(new).tolist():
                status: Status = "violated" if judged.fails[i] else "satisfied"
                low, high, start = float(judged.low[i]), float(judged.high[i]), starts[i]
                decision = Decision(
                    watched.rule.name, start, self.time(start), status, low, high, self.samples - 1
                )
                found.append(decision)
        count = min(max(self._countable(watched) - starts.start, 0), len(known))
        watched.tally.add(judged, count)
        watched.decided = known[count:]
        return found

    def _countable(self, watched: Watched) -> int:
        """The first instant whose value may still change, or whose window is incomplete."""
        if not watched.everywhere:
            return watched.values.settled
        window = self.compiled.grid.horizon if watched.rule.windowed else watched.rule.reach
        return min(watched.values.settled, max(watched.values.samples - (window or 0), 0))

    def _settle(self, requirements: Sequence[Watched]) -> None:
        """Count the final instants of `requirements`, and drop the samples that no requirement needs."""
        for watched in requirements:
            if watched.due(self.samples):
                watched.grow(self._history)
                starts = watched.pending
                judged = watched.judged(range(starts.start, min(starts.stop, self._countable(watched))))
                watched.tally.add(judged, len(judged.low))
        alive = [watched for watched in (*self._watched, *self._scope) if not watched.over]
        self._history.forget(min((watched.drop() for watched in alive), default=self.samples))

    def time(self, sample: int) -> float:
        """Time of a sample in seconds; the sample number if the time step is unknown."""
        dt = self.compiled.grid.dt
        return float(sample) if dt is None else self.how.t0 + sample * float(dt)

    @property
    def requirements(self) -> tuple[str, ...]:
        """Names of the requirements, in order."""
        return tuple(watched.rule.name for watched in self._watched)

    def rule(self, name: str) -> CompiledRequirement:
        """Return the requirement `name`. Raises UsageError (U101) for an unknown name."""
        return self._find(name).rule

    def repeats(self, name: str) -> bool:
        """True if the requirement `name` is evaluated at every sample, False if it is evaluated once."""
        return self._find(name).everywhere

    @property
    def kept(self) -> int:
        """Number of samples that are stored in memory."""
        return self.samples - self._history.first

    @property
    def samples(self) -> int:
        """Number of samples received."""
        return self._history.samples

    def open_starts(self, name: str) -> list[tuple[int, float, float]]:
        """Return the bounds on the robustness of the requirement `name` that are not final yet.

        There is one triple (sample, least robustness, greatest robustness) for each such sample.
        """
        watched = self._find(name)
        watched.grow(self._history)
        starts = watched.pending
        bounds = watched.values.live(starts.start, starts.stop) if starts else ((), ())
        return [(start, float(a), float(b)) for start, a, b in zip(starts, *bounds, strict=True)]

    def standing(self, name: str) -> RequirementSummary:
        """Summary of the requirement `name` over all samples at which it has been evaluated up to now.

        Where the robustness may still change, the summary uses its lower and its upper bound.
        """
        return self._standing(self._find(name))

    def _standing(self, watched: Watched) -> RequirementSummary:
        watched.grow(self._history)
        return watched.tally.with_more(watched.judged(watched.pending))

    @property
    def in_scope(self) -> bool | None:
        """True if the assumptions hold at the first sample, False if they fail, None if that is undecided."""
        found = {self._standing(watched).status for watched in self._scope}
        if "violated" in found:
            return False
        return True if found <= {"satisfied"} else None

    def finish(self) -> dict[str, RequirementSummary]:
        """End the trace, and return the summary of each requirement by name.

        The summaries agree with the verdicts of `Monitor.check`.

        Raises:
            TraceError: E306, `end` is "strict" and the trace is too short; E605, there was no sample.
        """
        if not self.samples:
            raise TraceError(Diagnostic("E605", "there are no samples"))
        if self.how.end == "strict":
            findings = [
                check_length(each.rule, self.samples, self._starts(each), self.compiled.grid)
                for each in self._watched
            ]
            if refused := [finding for finding in findings if finding is not None]:
                raise TraceError(*refused)
        return {watched.rule.name: self._ended(watched) for watched in self._watched}

    def _starts(self, watched: Watched) -> range:
        return starts_of(watched.rule, self.samples, self.compiled.grid.horizon, self.how.at)

    def _ended(self, watched: Watched) -> RequirementSummary:
        """Summary of a requirement if the trace ends now."""
        watched.grow(self._history)
        starts = self._starts(watched)
        rest = range(min(watched.tally.next, starts.stop), starts.stop)
        return watched.tally.with_more(watched.ended(rest)) if rest else watched.tally

    def _worst(self, watched: Watched) -> Worst | None:
        """Worst violation of a requirement if the trace ended now; None if it would not be violated."""
        if not self.samples or (isinstance(self.how.at, int) and self.how.at >= self.samples):
            return None
        tally = self._ended(watched)
        return Worst(tally.high_at, tally.high) if tally.fails else None

    def cause(self, name: str) -> Cause | None:
        """Return the cause of the worst violation of a requirement up to now.

        None is returned if the monitor was made without option `reasons`, if the requirement is not violated,
        or if the samples that show the cause were dropped. The monitor stores the latest two to four million
        numbers. Before it drops samples, it finds and stores the causes of the worst violations that these
        samples show.
        """
        watched = self._find(name)
        if self._buffer is None or (worst := self._worst(watched)) is None:
            return None
        return self._buffer.cause(watched.rule, worst)

    def _find(self, name: str) -> Watched:
        for watched in self._watched:
            if watched.rule.name == name:
                return watched
        raise unknown_requirement(name, list(self.requirements))


def _number(sample: Sample, need: Need) -> float:
    """Return the value of a signal in a sample; `q[0]` is the first component of a vector `q`."""
    value = sample.get(need.column.name)
    if isinstance(value, float):
        return value
    if isinstance(value, int):
        return float(value) if abs(value) < _BEYOND_FLOATS else math.inf
    names = (need.column.name, need.column.name.partition("[")[0])
    given = {name: [sample[name]] for name in names if name in sample}
    laid = arrange(given or {name: [0.0] for name in sample}, [need], plain=True)
    if laid.samples != 1 or laid.shape:
        message = f"`{need.column.name}` is one number of a sample, and several are given"
        raise TraceError(Diagnostic("E605", message, need.span, note=(f"needed by: {', '.join(need.by)}",)))
    return float(laid.env[need.column.name][0, 0])
