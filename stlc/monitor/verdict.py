"""Monitor of recorded signals against a specification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from stlc.compile.backends.array.namespace import Array
from stlc.compile.ir.discretize import Grid, lacks
from stlc.compile.pipeline import Compiled, CompiledRequirement, compile_resolved, resolve_for
from stlc.compile.schedule.schedule import Boundary
from stlc.compile.semantics.semantics import TOLERANCE, Semantics, semantics_of
from stlc.diagnostics import Diagnostic, SpecError, TraceError, UsageError
from stlc.files import read_source
from stlc.grammar import ast
from stlc.grammar.parse.parser import parse
from stlc.monitor.grid import Times, given_times, named_times, recorded_times, system_of
from stlc.monitor.instants import (
    At,
    check_length,
    rule_bounds,
    rule_known,
    rule_signal,
    rules_at,
    starts_of,
)
from stlc.monitor.judgement import Bools, Judgement, Prepared, Status, Verdict, unknown_requirement
from stlc.monitor.signals import Given, Need, arrange, needs_of, reading_of
from stlc.monitor.uncertain import Uncertainties, outer, uncertain_record
from stlc.monitor.values import Ends, Record, by_truth
from stlc.source import Source
from stlc.trace import Trace, load_trace

if TYPE_CHECKING:
    from stlc.monitor.online.online import How, Online

__all__ = ["Judgement", "Monitor", "Status", "Verdict"]

Subject: TypeAlias = Given | Trace | Path | str
"""Signals by name, a trace, or the path of one."""

Seconds: TypeAlias = float | Fraction

_SUFFIXES = (".stl", ".stlc")


class Monitor:
    """Exact monitor of recorded signals, which evaluates each requirement of a specification.

    Args:
        spec: a specification, its text, or the path of its file.
        dt: time step of the signals in seconds. By default, it is taken from the trace or from the system.
        horizon: horizon `T` of the planning window in seconds. By default, it is taken from the system or
            from the trace.
        system: path or name of a system file; the specification is then checked against it. Without it, the
            system that the specification names supplies a missing `dt` or `T`.
        overrides: name of a constant -> its value, as text.

    Signals are NumPy arrays or torch tensors by name, (time,) or (…, time). A vector is one array (…, time,
    k), or one signal per component, such as `q[0]`. Results for NumPy arrays are float64. Results for torch
    tensors keep dtype, device and gradients. Torch is not used otherwise.

    Raises:
        SpecError: the specification is invalid; E311, `dt` or `T` is needed and unknown.
    """

    def __init__(
        self,
        spec: ast.Spec | str | Path,
        dt: Seconds | None = None,
        horizon: Seconds | None = None,
        system: str | Path | None = None,
        overrides: Mapping[str, str] | None = None,
    ) -> None:
        self.spec = spec if isinstance(spec, ast.Spec) else parse(_source(spec))
        self._given = given_times(dt, horizon)
        self._overrides = dict(overrides or {})
        self._system, self._interface = Times(), None
        if system is not None:
            self._system, self._interface = system_of(str(system), self.spec, self._overrides)
        self._resolved = resolve_for(self.spec, self._interface, self._overrides, "check")
        self._compiled: dict[Grid, Compiled] = {}
        self._needs: dict[tuple[Grid, tuple[str, ...], bool], tuple[Need, ...]] = {}
        known = Times(self._given.dt, self._given.horizon).or_else(self._system)
        if not self._lacks(known):  # else the first trace may give the time step
            self._compile(known)

    @property
    def requirements(self) -> tuple[str, ...]:
        """Names of the requirements, in order."""
        return tuple(item.name for item in self.spec.items if isinstance(item, ast.Require))

    @property
    def compiled(self) -> Compiled:
        """The specification, compiled for the known time step and horizon."""
        return self._ready(Times())

    @property
    def horizon(self) -> float:
        """Seconds of signal that a verdict at time 0 needs; a window `[a, inf)` counts as `a` seconds."""
        return float(self.compiled.reach * (self.compiled.grid.dt or 0))

    # ----------------------------------------------------------------- evaluation

    def check(
        self,
        signals: Subject,
        *,
        at: At = None,
        end: Literal["open", "strict", "truncate"] = "open",
        tolerance: float = TOLERANCE,
        require: Sequence[str] = (),
        semantics: str | Semantics = "exact",
        uncertain: Uncertainties | None = None,
    ) -> Verdict:
        """Evaluate every requirement at the instants that it prescribes (`stlc.monitor.instants`).

        Args:
            signals: signals by name, or a trace, or the path of a trace file.
            at: a sample number, or "all" for every sample with a complete window; None: each requirement's
                own instants.
            end: treatment of a trace that is too short: "open" computes bounds over all its continuations and
                may be inconclusive, "strict" raises an error, "truncate" clips the windows.
            tolerance: a requirement is satisfied if its robustness is at least minus this value. If the
                tolerance is 0, the truth values of the predicates decide: then `<` and `<=` differ.
            require: names of the requirements to evaluate; empty: all.
            semantics: semantics of the reported robustness, or its name; verdicts and causes are always
                exact.
            uncertain: greatest errors of signals. Robustness and verdicts are then bounds over all samples
                within these errors; causes are those of the samples as they are.

        Raises:
            TraceError: signals are missing (E601), infinite (E604), or do not fit together (E605); with `end`
                "strict", the trace is too short (E306).
            UsageError: U101, an unknown requirement or semantics, a sample number beyond the trace, or an
                uncertainty that does not fit (`stlc.monitor.uncertain`).
        """
        reported = semantics_of(semantics)
        if uncertain and not reported.exact:
            raise UsageError(Diagnostic("U101", "uncertain signals have bounds in exact semantics only"))
        ready = self._prepare(signals, require, plain=True)
        judged = _with_errors(ready, uncertain) if uncertain else ready
        samples = ready.signals.samples
        starts = [starts_of(rule, samples, ready.horizon, at) for rule in ready.rules]
        if end == "strict":
            checked = zip(ready.rules, starts, strict=True)
            findings = [check_length(rule, samples, its, ready.compiled.grid) for rule, its in checked]
            if any(findings):
                raise TraceError(*filter(None, findings))
        judgements = [
            _judge(rule, judged, its, "truncate" if end == "truncate" else "open", tolerance)
            for rule, its in zip(ready.rules, starts, strict=True)
        ]
        if not reported.exact:
            ready = ready.under(reported)
            judgements = [_reported(judgement, ready, end) for judgement in judgements]
        return Verdict(tuple(judgements), ready).within(_scope(judged, tolerance))

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
            signals: signals by name, or a trace, or the path of a trace file; arrays are (time,) or (…,
                time).
            end: "strict" gives NaN where a window is incomplete, "truncate" clips windows.
            at: sample at which to evaluate; None: at every sample.
            smoothing: scale k of the log-sum-exp semantics. If given, this semantics is used.
            semantics: definition of min and max, or its name in `stlc.compile.semantics.semantics.SEMANTICS`.

        Returns:
            An array of the shape of the signals; with `at`, of that shape without the time axis.
        """
        return _least(self._prepare(signals, ()).under(semantics_of(semantics, smoothing)), end, at)

    def requirement_robustness(
        self,
        signals: Subject,
        *,
        end: Literal["strict", "truncate"] = "strict",
        at: int | None = None,
        semantics: str | Semantics = "exact",
    ) -> dict[str, Array]:
        """Robustness of each requirement by name, without weight and scale.

        The method `robustness` explains the arguments.
        """
        ready = self._prepare(signals, ()).under(semantics_of(semantics))
        shaped = ready.signals.like_given if at is None else ready.signals.at_one
        rows = _rows(ready, end, at)
        return {rule.name: shaped(row) for rule, row in zip(ready.rules, rows, strict=True)}

    def bounds(self, signals: Subject, *, at: int | None = None) -> tuple[Array, Array]:
        """Least and greatest robustness of the specification over all continuations of the signals.

        A predicate that reads a missing sample is unknown. The arrays have the shape of the signals. If `at`
        is given, the specification is evaluated at this sample only, and the arrays have no time axis.
        """
        ready = self._prepare(signals, ())
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

        Raises:
            UsageError: U101, an unknown requirement, or a specification without requirements.
        """
        from stlc.monitor.online.online import Online

        recorded = given_times(dt, None) if like is None else recorded_times(like, self._given)
        compiled = self._ready(recorded)
        return Online(compiled, _chosen(compiled, require), how)

    # ------------------------------------------------------------------- compiling

    def _prepare(self, subject: Subject, require: Sequence[str], *, plain: bool = False) -> Prepared:
        given = load_trace(subject, reading_of(self.spec)) if isinstance(subject, (str, Path)) else subject
        recorded = recorded_times(given, self._given) if isinstance(given, Trace) else Times()
        compiled = self._ready(recorded)
        rules = _chosen(compiled, require)
        key = (compiled.grid, tuple(rule.name for rule in rules), plain)
        if key not in self._needs:
            self._needs[key] = needs_of(compiled, [*rules, *compiled.assumptions] if plain else rules)
        signals = arrange(given, self._needs[key], plain=plain)
        return Prepared(compiled, rules, signals, Record.of(signals.env, signals.ops))

    def _ready(self, recorded: Times) -> Compiled:
        """Return the specification compiled for the time step and horizon that are known.

        The time step is that of the trace (`recorded`), else the argument `dt` of the monitor, else that of
        the system. The horizon is the argument `horizon` of the monitor, else that of the system, else that
        of the trace. If either is still unknown, it is taken from the system that the specification names.
        """
        step = recorded.or_else(Times(self._given.dt)).or_else(Times(self._system.dt))
        whole = Times(None, self._given.horizon).or_else(self._system).or_else(recorded)
        known = Times(step.dt, whole.horizon, step.trace)
        if not self._lacks(known):
            return self._compile(known)
        named = named_times(self.spec, self._overrides)
        if named is not None:
            return self._compile(known.or_else(named))
        try:
            return self._compile(known)
        except SpecError as error:
            raise SpecError(*(self._who_knows(finding) for finding in error.diagnostics)) from None

    def _lacks(self, times: Times) -> bool:
        """True if the specification needs a time step or horizon that is unknown in `times`."""
        grid, spec = times.grid(), self._resolved
        return any(lacks(grid, each.formula) for each in (*spec.requirements, *spec.assumptions))

    def _who_knows(self, finding: Diagnostic) -> Diagnostic:
        """Add to E311 (unknown `dt` or `T`) the note that the system file in the specification is missing."""
        if finding.code != "E311" or self.spec.system is None:
            return finding
        return finding.with_note(f"the specification names `{self.spec.system}`, but there is no such file")

    def _compile(self, times: Times) -> Compiled:
        grid = times.grid()
        if grid not in self._compiled:
            self._compiled[grid] = compile_resolved(self._resolved, grid, "check")
        return self._compiled[grid]


def _source(spec: str | Path) -> Source:
    """Return the source file at a path, or the text itself if `spec` does not look like a path."""
    if isinstance(spec, Path) or (spec.endswith(_SUFFIXES) and "\n" not in spec):
        return read_source(spec)
    return Source("<text>", spec)


def _chosen(compiled: Compiled, names: Sequence[str]) -> tuple[CompiledRequirement, ...]:
    """Requirements called `names`; all if there are no names. Raises UsageError (U101) if there are none."""
    if not compiled.requirements:
        raise UsageError(Diagnostic("U101", f"`{compiled.name}` has no requirement to judge"))
    known = [rule.name for rule in compiled.requirements]
    for name in names:
        if name not in known:
            raise unknown_requirement(name, known)
    return tuple(rule for rule in compiled.requirements if not names or rule.name in names)


def _rows(ready: Prepared, end: Boundary, at: int | None) -> list[Array]:
    """Robustness of every requirement, (samples, batch), or (1, batch) at the one sample `at`."""
    if at is None:
        return [rule_signal(rule, ready.record, ready.horizon, end) for rule in ready.rules]
    return rules_at(ready.rules, ready.record, at, ready.horizon, end)


def _least(ready: Prepared, end: Boundary, at: int | None) -> Array:
    """The least `weight * robustness / scale` over the requirements, in the shape of the signals."""
    weighed = [
        row if rule.weight == rule.scale else row * (rule.weight / rule.scale)
        for rule, row in zip(ready.rules, _rows(ready, end, at), strict=True)
    ]
    whole = ready.record.semantics.join(weighed, "min", ready.signals.ops)
    return ready.signals.like_given(whole) if at is None else ready.signals.at_one(whole)


def _scope(ready: Prepared, tolerance: float) -> Bools:
    """Return for each trace whether it counts: False if it certainly violates an assumption, (traces,)."""
    scope = np.ones(ready.signals.batch, dtype=bool)
    for rule in ready.compiled.assumptions:
        scope &= ~_judge(rule, ready, range(1), "open", tolerance).fails[0]
    return scope


def _with_errors(ready: Prepared, uncertain: Uncertainties) -> Prepared:
    compiled = ready.compiled
    rules = (*ready.rules, *compiled.assumptions)
    return replace(ready, record=uncertain_record(ready.record, uncertain, compiled, rules))


def _judge(
    rule: CompiledRequirement, ready: Prepared, starts: range, ends: Ends, tolerance: float
) -> Judgement:
    low, high = outer(*rule_bounds(rule, ready.record, starts, ready.horizon, ends))
    if tolerance > 0:
        holds = low >= -tolerance
        fails = high < -tolerance
    else:
        plain = replace(rule, formula=by_truth(rule.formula))
        least, most = outer(*rule_bounds(plain, ready.record, starts, ready.horizon, ends))
        holds, fails = least > 0, most < 0
    return Judgement(rule, starts.start, low, high, holds, fails, ready.signals.shape)


def first_violation(judgement: Judgement, subject: Prepared, tolerance: float = TOLERANCE) -> int:
    """Return the sample from which a violated requirement is certainly violated, whatever follows.

    An online monitor reports the violation at this sample. It is found by bisection, since a prefix that
    certainly violates a requirement does so however it goes on. If the end of the trace decides, the last
    sample is returned.

    Args:
        judgement: a judgement that is `violated`.
        subject: the evaluated signals, `Verdict.subject`.
        tolerance: the tolerance of the judgement.
    """
    low, high = judgement.start + 1, subject.record.samples
    while low < high:
        middle = (low + high) // 2
        cut = replace(subject, record=subject.record.cut(middle))
        starts = range(judgement.start, min(judgement.start + judgement.instants, middle))
        fails = _judge(judgement.rule, cut, starts, "open", tolerance).fails
        if judgement.counted(fails).any():
            high = middle
        else:
            low = middle + 1
    return high - 1


def _reported(judgement: Judgement, ready: Prepared, end: Literal["open", "strict", "truncate"]) -> Judgement:
    """Return a copy of the judgement whose `reported` bounds are in the semantics that `ready` selects.

    In some semantics, minimum and maximum are means, and bounds over unknown samples are not valid. In this
    case only the sign of the exact bounds is reported: the lower bound is 0 or -inf, the upper bound 0 or
    +inf.
    """
    starts = range(judgement.start, judgement.start + judgement.instants)
    ends: Ends = "truncate" if end == "truncate" else "open"
    low, high = rule_bounds(judgement.rule, ready.record, starts, ready.horizon, ends)
    if low is not high and not ready.record.semantics.bounded:
        known = rule_known(judgement.rule, ready.signals.samples, starts, ready.horizon)[:, None]
        low = np.where(known, low, np.where(judgement.low > 0.0, 0.0, -np.inf))
        high = np.where(known, high, np.where(judgement.high < 0.0, 0.0, np.inf))
    return replace(judgement, reported=(low, high))
