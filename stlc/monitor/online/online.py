"""Online monitor: bounds on the robustness after each sample, verdicts once decided, in bounded memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, Literal, TypeAlias

import numpy as np

from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.compile.semantics.tolerance import TOLERANCE, Status, StatusInScope
from stlc.diagnostics import TraceError, usage
from stlc.jsontext import Count, Num
from stlc.monitor.explain.report import Cause
from stlc.monitor.instants import At, asked_at, check_length, starts_of
from stlc.monitor.judgement import require_known
from stlc.monitor.online.history import ColumnHistory, Floats
from stlc.monitor.online.kernel import Streamed, StreamKernel, streamed_rule
from stlc.monitor.online.recompute import Recomputed
from stlc.monitor.online.tally import Asked, RequirementSummary
from stlc.monitor.online.trace_buffer import TraceBuffer
from stlc.monitor.signals import Gap, arrange, needs_of
from stlc.monitor.values import Ends, decisive
from stlc.trace import Trace

Sample: TypeAlias = Mapping[str, Any]
"""Signal -> number; a vector is a list of them."""

_ROWS = frozenset((list, tuple))
_TRUTHS: tuple[Status, ...] = ("violated", "violated", "satisfied")
"""Verdict by the number of a truth in `streams.c`; 0 is none."""


@dataclass(frozen=True, slots=True)
class Decision:
    """A final verdict of one requirement at one instant.

    Attributes:
        requirement: name of the requirement.
        start: sample at which the requirement was evaluated.
        time: time of `start` in seconds; the sample number if the time step is unknown.
        status: satisfied or violated; `Online.bounds` gives bounds on the robustness.
        sample: index of the sample that decided the verdict.
    """

    requirement: str
    start: int
    time: float
    status: Status
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


@dataclass(frozen=True, slots=True)
class Margin:
    """Robustness margin of a requirement at the latest sample, and its verdict up to there.

    Attributes:
        status: verdict over all starts until now.
        low: least robustness over all continuations; where the requirement is evaluated at every sample, the
            minimum over the windows that contain the latest one.
        high: greatest robustness over all continuations, or its minimum over the same windows.
        violated: number of starts until now at which the requirement is certainly violated.
    """

    status: StatusInScope
    low: Num
    high: Num
    violated: Count


Watched: TypeAlias = Streamed | Recomputed
"""A requirement and its running verdict.

A start is an instant at which the requirement is evaluated. It is counted in `tally` when its value is
final and its windows are complete.
"""


class Online:
    """Monitor of a stream of samples; made by `Monitor.online`.

    Memory and the time per sample are bounded by the windows of the requirements, not by the length of the
    stream. Without a C compiler, for `freeze`, and for a window to the end of the trace inside of another
    window, the requirement is evaluated anew after each sample; in the last case all samples are stored.
    """

    def __init__(
        self, compiled: Compiled, rules: Sequence[CompiledRequirement], how: How | None = None
    ) -> None:
        how = how or How()
        self.how = replace(how, at=asked_at(how.at, how.end, how.tolerance))
        self._ends: Ends = "truncate" if self.how.end == "truncate" else "open"
        self.compiled = compiled
        self._needs = needs_of(compiled, [*rules, *compiled.assumptions])
        self.signals = tuple(need.column.name for need in self._needs)
        """Names of the signals, in the order of a row."""
        self.asked = [self._ask(rule) for rule in rules]
        """The requirements, and where they are evaluated."""
        self._history = ColumnHistory()
        asked = self.asked + [self._ask(rule, once=True) for rule in compiled.assumptions]
        self._kernel, watched = self._watch(asked)
        self._watched = {rule.name: each for rule, each in zip(rules, watched, strict=False)}
        self._scope = watched[len(rules) :]
        self.requirements = tuple(self._watched)
        """Names of the requirements, in order."""
        self._streamed = [name for name, each in self._watched.items() if isinstance(each, Streamed)]
        self._step = None if compiled.grid.dt is None else float(compiled.grid.dt)
        self._recomputed = [each for each in watched if isinstance(each, Recomputed)]
        self._gaps: dict[str, Gap] = {}
        buffer = TraceBuffer(compiled, self.how.t0, self._ends, self.how.tolerance)
        self._buffer = buffer if self.how.reasons else None
        self._plain = self._kernel is not None and not self._recomputed and self._buffer is None

    def _ask(self, rule: CompiledRequirement, *, once: bool = False) -> Asked:
        horizon = self.compiled.grid.horizon
        begin = self.how.at if isinstance(self.how.at, int) and not once else 0
        once = once or rule.absolute or isinstance(self.how.at, int)
        everywhere = not once and (self.how.at == "all" or (rule.windowed and horizon is not None))
        if everywhere and not rule.windowed and rule.uses_end:
            message = f"`{rule.name}` runs to the end: at every start it would stay open until then"
            raise usage(message, "judge it once, without `--at all`")
        deciding = decisive(rule, self.how.tolerance, self.compiled.signature)
        rules = (rule,) if deciding is rule else (rule, deciding)
        return Asked(rules, begin, everywhere, horizon, self._ends, self.how.tolerance)

    def _watch(self, asked: Sequence[Asked]) -> tuple[StreamKernel | None, list[Watched]]:
        """Kernel of all requirements that have transducers, and what watches each requirement."""
        rules = [streamed_rule(each, self.signals) for each in asked]
        streamed = [each for each, rule in zip(asked, rules, strict=True) if rule]
        kernel = StreamKernel.of(streamed, [*filter(None, rules)], self.signals) if streamed else None
        numbers = count()
        return kernel, [
            Streamed(each, kernel, next(numbers)) if kernel and rule else Recomputed(each, self._history)
            for each, rule in zip(asked, rules, strict=True)
        ]

    def push(self, sample: Sequence[float] | Sample) -> int:
        """Add one sample; return the number of starts that it decides (`verdicts`).

        A sample is one number per signal, in the order of `signals`, or a mapping from names to numbers. NaN
        is an unknown value.

        Raises:
            TraceError: E601, a signal is missing; E605, the sample is not one number per signal.
        """
        try:
            row: Any = sample
            if type(sample) not in _ROWS and isinstance(sample, Mapping):
                row = [sample[name] for name in self.signals]
            return self._kernel.push(row) if self._plain else self.push_block([row])[0]  # type: ignore[union-attr]
        except (KeyError, TypeError, ValueError, OverflowError):
            pass
        if not isinstance(sample, Mapping):
            raise self._no_row() from None
        rows = self.rows({name: [value] for name, value in sample.items()})
        if len(rows) != 1:
            raise self._no_row()
        return self.push_block(rows)[0]

    def _no_row(self) -> TraceError:
        message = f"a sample is one number for each of {', '.join(self.signals)}"
        return TraceError.of("E605", message)

    def push_block(self, rows: Floats | Sequence[Any], *, pause: bool = False) -> tuple[int, int]:
        """Add samples, (count, signals); with `pause`, up to the first that decides a start.

        Returns:
            The number of starts that are decided, and the number of samples taken.

        Raises:
            TraceError: E605, the array has another shape, or holds other things than numbers.
        """
        try:
            given = np.asarray(rows)
        except ValueError:  # rows of several lengths
            raise self._no_row() from None
        if given.dtype.kind not in "fiub" or given.shape[1:] != (len(self.signals),):
            raise self._no_row()
        rows = given.astype(np.float64, copy=False)
        if pause and (self._recomputed or self._kernel is None):
            rows = rows[:1]
        decided, taken = 0, len(rows)
        if self._kernel is not None:
            decided, taken = self._kernel.push_block(rows, pause=pause)
        columns = {name: rows[:taken, i : i + 1] for i, name in enumerate(self.signals)}
        columns = columns or {"": np.zeros((taken, 1))}
        if self._recomputed:
            if self._kernel is None:
                for name in self.signals:
                    unknown = np.isnan(columns[name])
                    self._gaps[name] = self._gaps.get(name, Gap()).with_more(unknown, self._history.samples)
            self._history.take(columns)
            for each in self._recomputed:
                each.take()
                decided += len(each.news)
            self._history.forget(min(each.needs for each in self._recomputed))
        if self._buffer is not None:
            self._buffer.take(columns)
            if self._buffer.full:
                for name in self.requirements:
                    self.cause(name)
                self._buffer.forget()
        return decided, taken

    def feed(self, signals: Mapping[str, Any] | Trace) -> int:
        """Add many samples at once: arrays (time,) by signal name, or a trace or a part of it.

        Returns the number of starts that they decide.

        Raises:
            TraceError: the errors of `push`.
        """
        return self.push_block(self.rows(signals))[0]

    def rows(self, signals: Mapping[str, Any] | Trace) -> Floats:
        """Return many samples as rows, (count, signals). Raises the errors of `push`."""
        laid = arrange(signals, self._needs, plain=True)
        columns = [np.asarray(laid.env[name]).reshape(-1) for name in self.signals]
        return np.stack(columns, axis=1) if columns else np.zeros((laid.samples, 0))

    def verdicts(self) -> tuple[Decision, ...]:
        """Verdicts that the latest sample decided, in the order of the requirements."""
        names, news = self._streamed, [] if self._kernel is None else self._kernel.news()
        found = [(names[rule], start, _TRUTHS[truth]) for rule, start, truth in news if rule < len(names)]
        for name, watched in self._watched.items() if self._recomputed else ():
            if isinstance(watched, Recomputed):
                found += [(name, start, status) for start, status in watched.news.items()]
        if self._recomputed:
            found.sort(key=lambda each: self.requirements.index(each[0]))
        sample = self.samples - 1
        return tuple(Decision(name, start, self.time(start), status, sample) for name, start, status in found)

    @property
    def gaps(self) -> dict[str, Gap]:
        """Samples at which signals are unknown."""
        if self._kernel is None:
            found = self._gaps
        else:
            found = {name: self._kernel.gap(i) for i, name in enumerate(self.signals)}
        return {name: gap for name, gap in found.items() if gap.samples}

    def time(self, sample: int) -> float:
        """Time of a sample in seconds; the sample number if the time step is unknown."""
        return float(sample) if self._step is None else self.how.t0 + sample * self._step

    def requirement(self, name: str) -> Asked:
        """Return the requirement `name`, and where it is evaluated. Raises UsageError (U101) without one."""
        return self._find(name).asked

    @property
    def samples(self) -> int:
        """Number of samples received."""
        return self._history.samples if self._kernel is None else self._kernel.samples

    def open_starts(self, name: str) -> list[tuple[int, float, float]]:
        """Starts of the requirement `name` that are not final: (start, least, greatest robustness)."""
        watched = self._find(name)
        starts = watched.asked.starts(watched.tally.next, self.samples)
        judged = watched.judged(starts)
        return list(zip(starts, judged.low.tolist(), judged.high.tolist(), strict=True))

    def bounds(self, name: str, start: int) -> tuple[float, float]:
        """Least and greatest robustness of the requirement `name` at a start, over all continuations.

        The value at the start is not final yet, or the latest sample decided its verdict, or it is the
        latest that became final. The bounds are computed by this call.

        Raises UsageError (U101) for another start.
        """
        watched = self._find(name)
        tally = watched.tally
        if tally.instants and start == tally.next - 1:
            return tally.last
        told = isinstance(watched, Recomputed) and start in watched.news
        if not told and start not in watched.asked.starts(tally.next, self.samples):
            raise usage(f"`{name}` is not open at sample {start}")
        judged = watched.judged(range(start, start + 1))
        return float(judged.low[0]), float(judged.high[0])

    def margin(self, name: str) -> Margin:
        """Robustness margin of the requirement `name` at the latest sample; +inf before the first start."""
        watched = self._find(name)
        tally = watched.tally
        judged = watched.judged(watched.asked.starts(tally.next, self.samples))
        until, ends = tally.with_more(judged), zip(tally.last, (judged.low, judged.high), strict=True)
        low, high = (float(end.min(initial=last)) for last, end in ends)  # a NaN stays
        return Margin(until.status, low, high, until.fails)

    def standing(self, name: str) -> RequirementSummary:
        """Summary of the requirement `name` over all samples at which it has been evaluated up to now.

        Where the robustness may still change, the summary uses its lower and its upper bound.
        """
        return self._standing(self._find(name))

    def _standing(self, watched: Watched) -> RequirementSummary:
        tally = watched.tally
        starts = watched.asked.starts(tally.next, self.samples)
        return tally.with_more(watched.judged(starts))

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
            raise TraceError.of("E605", "there are no samples")
        if self.how.end == "strict":
            grid = self.compiled.grid
            watched = self._watched.values()
            found = (check_length(w.asked.rule, self.samples, self._starts(w), grid) for w in watched)
            if refused := [*filter(None, found)]:
                raise TraceError(*refused)
        return {name: self._ended(watched) for name, watched in self._watched.items()}

    def _starts(self, watched: Watched) -> range:
        return starts_of(watched.asked.rule, self.samples, self.compiled.grid.horizon, self.how.at)

    def _ended(self, watched: Watched) -> RequirementSummary:
        """Summary of a requirement if the trace ends now."""
        starts, tally = self._starts(watched), watched.tally
        rest = range(min(tally.next, starts.stop), starts.stop)
        return tally.with_more(watched.judged(rest, ended=True))

    def cause(self, name: str) -> Cause | None:
        """Return the cause of the worst violation of a requirement up to now.

        None is returned if the monitor was made without option `reasons`, if the requirement is not violated,
        or if the samples that show the cause were dropped. The monitor stores the latest two to four million
        numbers. Before it drops samples, it finds and stores the causes of the worst violations that these
        samples show.
        """
        watched, at = self._find(name), self.how.at
        if self._buffer is None or self.samples <= (at if isinstance(at, int) else 0):
            return None
        worst = self._ended(watched)
        return self._buffer.cause(watched.asked.rule, worst) if worst.fails else None

    def _find(self, name: str) -> Watched:
        require_known([name], self.requirements)
        return self._watched[name]
