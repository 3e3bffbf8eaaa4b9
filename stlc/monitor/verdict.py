"""Monitor of recorded signals against a specification."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from stlc.compile.backends.array.graph import SignalPlan, signal_plan
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.schedule import Boundary
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.holes import partial
from stlc.compile.ir.support import Reach
from stlc.compile.namespace import Array
from stlc.compile.pipeline import Compiled, CompiledRequirement, compile_resolved, resolve_for
from stlc.compile.semantics.semantics import Exact, Semantics, semantics_of
from stlc.compile.semantics.tolerance import TOLERANCE, End
from stlc.diagnostics import SpecError, TraceError, usage
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.monitor.explain.report import cause_of
from stlc.monitor.facts.rules import facts_of
from stlc.monitor.given import UNNAMED, Given, is_frame, trace_of_table
from stlc.monitor.given import plain as plain_signals
from stlc.monitor.grid import Times, agreed_times, given_times, named_times, require_windows, system_of
from stlc.monitor.instants import (
    At,
    asked_at,
    check_length,
    live_bounds,
    rule_at,
    rule_bounds,
    rule_known,
    rule_signal,
    span_of,
    starts_of,
    window_of,
)
from stlc.monitor.judgement import About, RequirementVerdict, Verdict, chosen
from stlc.monitor.prepared import Part, Prepared
from stlc.monitor.signals import WHOLE, Excerpt, Need, arrange, needs_of, plain_columns, reading_of
from stlc.monitor.uncertain import Uncertainties, outer, outer_of, uncertain_record
from stlc.monitor.values import Ends, Record, decisive
from stlc.source import Source
from stlc.trace import Reading, Trace

if TYPE_CHECKING:
    from stlc.monitor.online.online import How, Online

Subject: TypeAlias = Given | Trace | Path | str
"""Signals by name, a data frame, a trace, or the path of one."""

Seconds: TypeAlias = float | Fraction

_SUFFIXES = (".stl", ".stlc")


class Monitor:
    """Exact monitor of recorded signals, which evaluates each requirement of a specification.

    Args:
        spec: a specification, its text, or the path of its file.
        dt: time step of the signals in seconds. By default, it is taken from the trace or from the system.
        horizon: horizon `T` of the planning window in seconds. By default, it is taken from the system or
            from the trace.
        system: path, name or text of a system file; the specification is then checked against it. Without
            it, the system that the specification names supplies a missing `dt` or `T`.
        overrides: name of a constant -> its value, as text.

    Signals are NumPy arrays or torch tensors by name, (time,) or (…, time). A vector is one array (…, time,
    k), or one signal per component, such as `q[0]`. Results for NumPy arrays are float64. Results for torch
    tensors keep dtype, device and gradients. Torch is not used otherwise.

    Raises:
        SpecError: the specification is invalid; E311, `dt` or `T` is needed and unknown.
    """

    def __init__(
        self,
        spec: Spec | str | Path,
        dt: Seconds | None = None,
        horizon: Seconds | None = None,
        system: str | Path | Source | None = None,
        overrides: Mapping[str, str] | None = None,
    ) -> None:
        if isinstance(spec, Path) or (
            isinstance(spec, str) and spec.endswith(_SUFFIXES) and "\n" not in spec
        ):
            spec = Spec.parse(File(spec).read())
        self.spec = Spec.parse(Source("<text>", spec)) if isinstance(spec, str) else spec
        self._given = given_times(dt, horizon)
        self._overrides = dict(overrides or {})
        self._system, self._interface = Times(), None
        if system is not None:
            found = system if isinstance(system, Source) else str(system)
            self._system, self._interface = system_of(found, self.spec, self._overrides)
        self.resolved = resolve_for(self.spec, self._interface, self._overrides, "check")
        self._compiled: dict[Grid, Compiled] = {}
        self._readings: dict[tuple[str, ...], Reading] = {}
        self._selected: dict[tuple[Times, tuple[str, ...], bool], _Selection] = {}
        known = self._given.or_else(self._system)
        if not self._lacks(known):  # else the first trace may give the time step
            self._compile(known)

    @property
    def requirements(self) -> tuple[str, ...]:
        """Names of the requirements, in order."""
        return tuple(self.spec.requirements)

    def reads(self, require: Sequence[str] = ()) -> frozenset[str]:
        """Signals that assumptions and the named requirements (empty: all) read; components as `q[0]`."""
        rules = chosen(self.resolved.requirements, require)
        formulas = (each.formula for each in (*rules, *self.resolved.assumptions))
        return frozenset[str]().union(*(each.columns for each in formulas))

    @property
    def compiled(self) -> Compiled:
        """The specification, compiled for the known time step and horizon."""
        return self._ready(Times())

    @property
    def horizon(self) -> float:
        """Seconds of signal that a verdict at time 0 needs; a window `[a, inf)` counts as `a` seconds."""
        return float(self.compiled.reach * (self.compiled.grid.dt or 0))

    def check(
        self,
        signals: Subject,
        *,
        at: At = None,
        end: End = "open",
        tolerance: float = TOLERANCE,
        require: Sequence[str] = (),
        semantics: str | Semantics = "exact",
        uncertain: Uncertainties | None = None,
        strict: bool = False,
    ) -> Verdict:
        """Evaluate every requirement at the instants that it prescribes (`stlc.monitor.instants`).

        Args:
            signals: signals by name, a data frame of pandas or polars, a trace, or the path of a trace file.
                Under the key `time` or `t` there may be times, unless a requirement reads it as a signal.
            at: a sample number; "all" for every sample with a complete window; None: those prescribed.
            end: treatment of a trace that is too short: "open" computes bounds over all its continuations and
                may be inconclusive, "strict" raises an error, "truncate" clips the windows.
            tolerance: a requirement is satisfied if its robustness is at least minus this value. If it is 0,
                the truth values of the predicates decide: then `<` and `<=` differ.
            require: names of the requirements to evaluate; empty: all.
            semantics: that of the reported robustness, or its name; verdicts and causes are always exact.
            strict: whether times at which some signals of a requirement were not seen yet, or no more, are
                unknown. Otherwise it is judged while all were seen (`Judgement.part`).
            uncertain: greatest errors of signals. Robustness and verdicts are then bounds over all samples
                within these errors; causes are those of the samples as they are.

        Raises:
            TraceError: signals are missing (E601), infinite (E604), or do not fit together (E605); with `end`
                "strict", the trace is too short (E306).
            UsageError: U101, an unknown requirement or semantics, a sample number beyond the trace, or an
                uncertainty that does not fit (`stlc.monitor.uncertain`).
        """
        at = asked_at(at, end, tolerance)
        reported = semantics_of(semantics)
        if uncertain and not reported.exact:
            raise usage("uncertain signals have bounds in exact semantics only")
        ready = self._prepare(signals, require, plain=True)
        judged = _under(ready, uncertain or {})
        where = []
        for rule in ready.rules:
            part = Part(0, ready.record.samples) if strict else ready.part(rule)
            where.append((rule, part, _starts(rule, part, ready, at)))
        if end == "strict":
            grid = ready.compiled.grid
            findings = [check_length(rule, part.stop - part.first, its, grid) for rule, part, its in where]
            if any(findings):
                raise TraceError(*filter(None, findings))
        ends: Ends = "truncate" if end == "truncate" else "open"
        judgements = [_judge(rule, judged, its, ends, tolerance, part) for rule, part, its in where]
        if not reported.exact:
            ready = ready.under(reported)
            judgements = [_reported(judgement, ready, ends) for judgement in judgements]
        judgements = [replace(judgement, subject=ready) for judgement in judgements]
        found = Verdict(tuple(judgements), _about(ready), end, uncertain or {}, judged_on=ready)
        scope = np.ones(judged.signals.batch, dtype=bool)  # traces that may satisfy the assumptions
        for rule in judged.compiled.assumptions:
            scope &= ~_judge(rule, judged, range(1), "open", tolerance, judged.part(rule)).fails[0]
        return found.within(scope)

    def robustness(
        self,
        signals: Subject,
        *,
        end: Literal["strict", "truncate"] = "strict",
        at: int | None = None,
        smoothing: float | None = None,
        semantics: str | Semantics = "exact",
    ) -> Array:
        """Robustness of the specification: the least `weight * robustness / scale` of all requirements.

        Args:
            signals: signals by name, a trace, or the path of a trace file; arrays are (time,) or (…, time).
            end: "strict" gives NaN where a window is incomplete, "truncate" clips windows.
            at: sample at which to evaluate; None: at every sample.
            smoothing: scale k of the log-sum-exp semantics. If given, this semantics is used.
            semantics: definition of min and max, or its name in `stlc.compile.semantics.semantics.SEMANTICS`.

        Returns:
            An array of the shape of the signals; with `at`, of that shape without the time axis.
        """
        _require_end(end)
        chosen, known = semantics_of(semantics, smoothing), self._selected.get(_ALL)
        if known is not None and type(signals) is dict and chosen.exact:
            found = known.least(signals, end, at)
            if found is not None:
                return found
        return _least(self._prepare(signals, at=at, semantics=chosen), end, at)

    def requirement_robustness(
        self,
        signals: Subject,
        *,
        end: Literal["strict", "truncate"] = "strict",
        at: int | None = None,
        semantics: str | Semantics = "exact",
    ) -> dict[str, Array]:
        """Robustness of each requirement by name, without weight and scale; arguments as of `robustness`."""
        _require_end(end)
        ready = self._prepare(signals, at=at, semantics=semantics_of(semantics))
        return robustness_signals(ready, end, at)

    def bounds(self, signals: Subject, *, at: int | None = None) -> tuple[Array, Array]:
        """Least and greatest `robustness` over all continuations of the signals, in the same shape."""
        ready = self._prepare(signals, at=at)
        return _least(ready, "lower", at), _least(ready, "upper", at)

    def online(
        self,
        how: How | None = None,
        *,
        require: Sequence[str] = (),
        like: Trace | None = None,
        dt: Seconds | None = None,
    ) -> Online:
        """Return a monitor that takes samples one by one, and gives bounds and decided verdicts after each.

        Args:
            how: instants at which to evaluate, treatment of the end of the stream, and tolerance.
            require: names of the requirements to evaluate; empty: all.
            like: a trace, or the first piece of one, that gives `dt` and `T`.
            dt: time step in seconds, if neither `like` nor this monitor gives it.

        Raises UsageError (U101) for an unknown requirement, or a specification without requirements.
        """
        from stlc.monitor.online.online import Online

        if like is None:
            recorded = given_times(dt, None)
        else:
            recorded = agreed_times(like.name, like.dt, like.meta.horizon, self._given)
        compiled = self._ready(recorded)
        return Online(compiled, _chosen(compiled, require), how)

    def _prepare(
        self,
        subject: Subject,
        require: Sequence[str] = (),
        *,
        plain: bool = False,
        at: int | None = None,
        semantics: Semantics | None = None,
    ) -> Prepared:
        given, recorded = self._read(subject, require)
        key = (recorded, tuple(require), plain)
        if key not in self._selected:
            compiled = self._ready(recorded)
            rules, horizon = _chosen(compiled, require), compiled.grid.horizon
            needs = needs_of(compiled, [*rules, *compiled.assumptions] if plain else rules)
            spans = (span_of(rule, horizon) for rule in rules)
            reach = Reach(*map(max, zip(*spans, strict=True)))
            factors = tuple(rule.factor for rule in rules)
            self._selected[key] = _Selection(compiled, rules, needs, factors, reach)
        selected = self._selected[key]
        if isinstance(given, Trace):
            require_windows(given, selected.rules)
        signals = arrange(given, selected.needs, plain=plain, excerpt=selected.excerpt(at))
        record = Record.of(signals.env, signals.ops, signals.cells, semantics)
        return Prepared(selected.compiled, selected.rules, signals, record, cause_of, facts_of)

    def _read(self, given: Subject, names: Sequence[str]) -> tuple[Given | Trace, Times]:
        """Return the signals that requirements read (`names` empty: all), and times given with them."""
        recorded = _UNKNOWN
        if not isinstance(given, Trace):
            if (key := tuple(names)) not in self._readings:
                self._readings[key] = reading_of(self.spec, read=self.reads(names))
            reading = self._readings[key]
            if isinstance(given, (str, Path)):
                given = Trace.load(given, reading)
            elif is_frame(given):
                step = None if self._given.dt is None else float(self._given.dt)
                given = trace_of_table(given, replace(reading, dt=step))
            else:
                given, found = plain_signals(given, reading)
                if found is not None:
                    recorded = agreed_times(UNNAMED, found, None, self._given)
        if isinstance(given, Trace):
            recorded = agreed_times(given.name, given.dt, given.meta.horizon, self._given)
        return given, recorded

    def _ready(self, recorded: Times) -> Compiled:
        """Return the specification compiled for the time step and horizon that are known.

        The time step is that of the trace (`recorded`), else the one given to the monitor, else that of the
        system. The horizon is the one given, else that of the system, else that of the trace. What is still
        unknown is taken from the system that the specification names.
        """
        step = recorded.or_else(Times(self._given.dt)).or_else(Times(self._system.dt))
        whole = Times(None, self._given.horizon).or_else(self._system).or_else(recorded)
        known = Times(step.dt, whole.horizon, step.trace)
        if known.grid() in self._compiled or not self._lacks(known):
            return self._compile(known)
        named = named_times(self.spec, self._overrides)
        if named is not None:
            return self._compile(known.or_else(named))
        try:
            return self._compile(known)
        except SpecError as error:
            if self.spec.system is None:
                raise
            note = f"the specification names `{self.spec.system}`, but there is no such file"
            told = (each.with_note(note) if each.code == "E311" else each for each in error.diagnostics)
            raise SpecError(*told) from None

    def _lacks(self, times: Times) -> bool:
        """True if the specification needs a time step or horizon that is unknown in `times`."""
        grid, spec = times.grid(), self.resolved
        return any(grid.lacks(each.formula) for each in (*spec.requirements, *spec.assumptions))

    def _compile(self, times: Times) -> Compiled:
        grid = times.grid()
        if grid not in self._compiled:
            self._compiled[grid] = compile_resolved(self.resolved, grid, "check")
        return self._compiled[grid]


_UNKNOWN, _EXACT = Times(), Exact()
_ALL = (_UNKNOWN, (), False)
"""Key of the selection of all requirements, for signals without times."""


@dataclass(frozen=True, slots=True, eq=False)
class _Selection:
    """Requirements that are evaluated together.

    Attributes:
        compiled: the specification.
        rules: the requirements.
        needs: signals that they read.
        factors: factor of each in the overall robustness.
        reach: samples before and after an instant that their values there may depend on.
    """

    compiled: Compiled
    rules: tuple[CompiledRequirement, ...]
    needs: tuple[Need, ...]
    factors: tuple[float, ...]
    reach: Reach

    def excerpt(self, at: int | None) -> Excerpt:
        """Samples that values at sample `at` may depend on; all for None."""
        if at is None or at < 0:
            return WHOLE
        return Excerpt(max(at - self.reach.past, 0), at, at + self.reach.future + 1)

    def least(self, given: Given, end: Boundary, at: int | None) -> Array | None:
        """Robustness of the requirements on signals that need no conversion; see `Monitor.robustness`.

        None is returned where `Prepared` must be evaluated: signals have unknown values, or there is no plan.
        """
        excerpt = self.excerpt(at)
        env = None if (at or 0) < 0 else plain_columns(given, self.needs, excerpt)
        if env is None:
            return None
        samples = len(next(iter(env.values())))
        plan = _plan(self, samples, end, None if at is None else excerpt.at - excerpt.first)
        if plan is None:
            return None
        whole = TOLERANCE.overall(plan.values(env), self.factors, NUMPY, _EXACT)
        if at is not None:
            return np.float64(whole[0, 0])
        return whole.reshape(-1) if whole.base is None else whole.flatten()  # see `Signals.like_given`


@lru_cache(maxsize=512)
def _plan(selected: _Selection, samples: int, end: Boundary, at: int | None) -> SignalPlan | None:
    """Plan of the robustness at every sample or at one; None where values are not those of the formulas."""
    rules, horizon = selected.rules, selected.compiled.grid.horizon
    if any(rule.absolute or window_of(rule, horizon) is not None or partial(rule.formula) for rule in rules):
        return None
    instants = range(samples) if at is None else range(at, at + 1)
    return signal_plan(tuple(rule.formula for rule in rules), samples, instants, end)


def _require_end(end: str) -> None:
    if end not in ("strict", "truncate"):
        raise usage(f"the `end` of a value is strict or truncate, not {end!r}")


def _chosen(compiled: Compiled, names: Sequence[str]) -> tuple[CompiledRequirement, ...]:
    """Requirements called `names`; all if there are no names. Raises UsageError (U101) if there are none."""
    if not compiled.requirements:
        raise usage(f"`{compiled.name}` has no requirement to judge")
    return chosen(compiled.requirements, names)


def robustness_signals(ready: Prepared, end: Boundary = "strict", at: int | None = None) -> dict[str, Array]:
    """Robustness of each requirement by name, at every sample or at one, in the shape of the signals."""
    shaped = ready.signals.like_given if at is None else ready.signals.at_one
    rows = zip(ready.rules, _rows(ready, end, at), strict=True)
    return {rule.name: shaped(row) for rule, row in rows}


def _rows(ready: Prepared, end: Boundary, at: int | None) -> list[Array]:
    """Robustness of every requirement, (samples, batch), or (1, batch) at the one sample `at`."""
    rows, horizon = [], ready.horizon
    for rule in ready.rules:  # a formula may need a record of its own
        record = record_of(rule, ready, Part(0, ready.record.samples))
        if at is None:
            row = rule_signal(rule, record, horizon, end)
        else:
            row = rule_at(rule, record, at - ready.signals.first, horizon, end)
        rows.append(outer_of(row, end))
    return rows


def _least(ready: Prepared, end: Boundary, at: int | None) -> Array:
    """The least `weight * robustness / scale` over the requirements, in the shape of the signals."""
    ops = ready.signals.ops
    factors = (rule.factor for rule in ready.rules)
    whole = TOLERANCE.overall(_rows(ready, end, at), factors, ops, ready.record.semantics)
    return ready.signals.like_given(whole) if at is None else ready.signals.at_one(whole)


def _starts(rule: CompiledRequirement, part: Part, ready: Prepared, at: At) -> range:
    """Instants at which a requirement is evaluated, counted from the first sample of its part."""
    samples = part.stop - part.first
    if not isinstance(at, int):
        return starts_of(rule, samples, ready.horizon, at)
    if not part.first or at >= ready.signals.samples:
        return starts_of(rule, ready.signals.samples, ready.horizon, at)
    if not part.first <= at < part.stop:
        ends = f"{ready.moment(part.first)} to {ready.moment(part.stop - 1).removeprefix('t = ')}"
        message = f"`{rule.name}` has no value at {ready.moment(at)}: its signals were seen from {ends}"
        raise usage(message)
    return starts_of(rule, samples, ready.horizon, at - part.first)


def record_of(rule: CompiledRequirement, ready: Prepared, part: Part) -> Record:
    """Samples of a part of a trace, of which every recorded one counts for the requirement."""
    record = ready.record.of_cells(rule.formula, loose=window_of(rule, ready.horizon) is not None)
    return record if part.stop - part.first == record.samples else record.part(part.first, part.stop)


def _about(ready: Prepared) -> About:
    signals, trace, compiled = ready.signals, ready.signals.trace, ready.compiled
    given = About(
        *(signals.name, "", "", compiled.spec.source, compiled.name),
        *(ready.record.samples, signals.shape, ready.dt, ready.horizon),
        warnings=compiled.warnings,
        resampled=ready.record.cells is not None,
    )
    if trace is None:
        return given
    more = (*trace.remarks, *compiled.warnings)
    file, track, seeds = trace.file, trace.track, trace.extras.get("seed")
    return replace(given, file=file, track=track, clocks=trace.clocks, seeds=seeds, warnings=more)


def _judge(
    rule: CompiledRequirement, ready: Prepared, starts: range, ends: Ends, tolerance: float, part: Part
) -> RequirementVerdict:
    low, high = outer(*rule_bounds(rule, record_of(rule, ready, part), starts, ready.horizon, ends))
    least, most, deciding = low, high, decisive(rule, tolerance, ready.compiled.signature)
    if deciding is not rule:
        record = record_of(deciding, ready, part)
        least, most = outer(*rule_bounds(deciding, record, starts, ready.horizon, ends))
    holds, fails = TOLERANCE.satisfied(least, tolerance), TOLERANCE.violated(most, tolerance)
    start = part.first + starts.start
    where = (ready.signals.shape, part, ready.timeline, tolerance, ends)
    return RequirementVerdict(rule, start, low, high, holds, fails, *where, subject=ready)


def _under(ready: Prepared, uncertain: Uncertainties) -> Prepared:
    """The signals with the greatest errors of their samples."""
    if not uncertain:
        return ready
    rules = (*ready.rules, *ready.compiled.assumptions)
    return replace(ready, record=uncertain_record(ready.record, uncertain, ready.compiled, rules))


def first_violation(judgement: RequirementVerdict, uncertain: Uncertainties | None = None) -> int:
    """Return the sample from which a violated requirement is certainly violated, whatever follows.

    An online monitor reports the violation at this sample; if the end of the trace decides, it is the last.
    It is found by bisection, since a prefix that certainly violates a requirement does so however it goes on.
    """
    assert judgement.subject is not None
    subject, part = _under(judgement.subject, uncertain or {}), judgement.part
    start, first = judgement.start, part.first
    rule = decisive(judgement.rule, judgement.tolerance, subject.compiled.signature)

    def violated(stop: int) -> bool:
        starts = range(start - first, min(start + judgement.instants, stop) - first)
        record = record_of(rule, subject, replace(part, stop=stop))
        most = outer(*live_bounds(rule, record, starts, subject.horizon, judgement.ends))[1]
        return bool(judgement.counted(TOLERANCE.violated(most, judgement.tolerance)).any())

    return bisect_left(range(part.stop), True, lo=start + 1, key=violated) - 1


def timed(verdict: Verdict) -> Verdict:
    """Return the verdict with the times from which requirements are certainly violated; see `violated_at`."""
    found, cells = {}, verdict.subject.record.cells
    for each in verdict.violated:
        first = first_violation(each, verdict.uncertain)
        found[each.name] = each.timeline.time(first) if cells is None else cells.last(first)
    return replace(
        verdict,
        requirements=tuple(replace(each, violated_at=found.get(each.name)) for each in verdict),
    )


def _reported(judgement: RequirementVerdict, ready: Prepared, ends: Ends) -> RequirementVerdict:
    """Return the judgement with `reported` bounds in the semantics of `ready`.

    If minimum and maximum are means, bounds over unknown samples are not valid. Then only the sign of the
    exact bounds is reported: the lower bound is 0 or -inf, the upper bound 0 or +inf.
    """
    rule, part = judgement.rule, judgement.part
    begin = judgement.start - part.first
    starts = range(begin, begin + judgement.instants)
    low, high = rule_bounds(rule, record_of(rule, ready, part), starts, ready.horizon, ends)
    if low is not high and not ready.record.semantics.bounded:
        known = rule_known(rule, part.stop - part.first, starts, ready.horizon)[:, None]
        low = np.where(known, low, np.where(judgement.low > 0.0, 0.0, -np.inf))
        high = np.where(known, high, np.where(judgement.high < 0.0, 0.0, np.inf))
    return replace(judgement, reported=(low, high))
