"""Verdicts on traces: for one requirement or for all, per trace or over all traces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir.discretize import Horizon
from stlc.compile.pipeline import CompiledRequirement
from stlc.compile.semantics.semantics import Semantics, semantics_of
from stlc.compile.semantics.tolerance import TOLERANCE, End, Status
from stlc.diagnostics import Diagnostic, usage
from stlc.jsontext import Num
from stlc.monitor.facts.extent import samples_read
from stlc.monitor.facts.fact import Fact
from stlc.monitor.prepared import Floats, Part, Prepared, Timeline
from stlc.monitor.signals import Gap
from stlc.monitor.values import Ends
from stlc.provenance import sha256
from stlc.source import Source
from stlc.tabular import frame, html_table, plot
from stlc.trace.recording import Clock
from stlc.trace.resample import TimeRange

if TYPE_CHECKING:
    from stlc.monitor.explain.report import Cause
    from stlc.monitor.uncertain import Uncertainty

Bools: TypeAlias = NDArray[np.bool_]
Ints: TypeAlias = NDArray[np.int64]
R = TypeVar("R", bound=Any)

MOST = 500
"""Greatest number of violated requirements explained at once; each takes half a millisecond."""


@dataclass(frozen=True, slots=True)
class Counts:
    """Summary of the instants of a requirement that are told in one row, as those of a stream.

    Attributes:
        instants: number of instants.
        held: number of instants at which the requirement certainly holds, (traces,).
        failed: number of instants at which it is certainly violated, (traces,).
        low_at: sample of the least lower bound, (traces,).
        high_at: sample of the least upper bound, (traces,).
    """

    instants: int
    held: Ints
    failed: Ints
    low_at: Ints
    high_at: Ints


@dataclass(frozen=True, slots=True)
class WorstStart:
    """Trace and start of the least robustness, and the time of its cause, in seconds."""

    trace: int
    start: Num
    time: Num


@dataclass(frozen=True, slots=True)
class Robustness:
    """Least robustness over instants, of all traces: its minimum, mean and bounds; None without a trace."""

    min: Num | None
    mean: Num | None
    low: Num | None
    high: Num | None
    unit: str
    argmin: WorstStart


@dataclass(frozen=True, slots=True)
class JudgedPart:
    """Part of a recording that a requirement could read, in seconds from its first sample, of a duration."""

    first: Num
    last: Num
    of: Num


@dataclass(frozen=True)
class RequirementVerdict:
    """Verdict and robustness of one requirement on one or many traces.

    Attributes:
        rule: the requirement.
        start: the first sample at which the requirement is evaluated, that of the first row of `low`.
        low: least robustness over all continuations of the traces, (instants, traces).
        high: greatest robustness; the same array as `low` if nothing is unknown.
        holds: whether the requirement is certainly satisfied, (instants, traces).
        fails: whether the requirement is certainly violated, (instants, traces).
        shape: axes of the signals before their time axis; () for a single trace.
        part: the samples on which the requirement is judged.
        timeline: times of the samples.
        tolerance: a requirement is satisfied if its robustness is at least minus this value.
        ends: treatment of windows that extend beyond the end of the traces.
        scope: True for traces that satisfy the assumptions, (traces,); None if all do. The others do not
            affect verdicts over all traces.
        reported: `low` and `high` in the requested semantics (definition of min and max); None: the exact.
        counts: the instants, if the arrays have one row for all of them; None if a row is an instant.
        facts: facts about the requirement that a told verdict has.
        violated_at: time in seconds from which the requirement is certainly violated, whatever follows; None
            if it is not violated, or if the time was not looked for.
        subject: the evaluated signals; None in a told verdict.
    """

    JSON: ClassVar = (
        "name doc=rule.doc tags robustness=figures cause verdict=overall starts=instants "
        "satisfied_share=share violated_traces judged facts id?=rule.typed.id"
    )

    NAMES: ClassVar = {"Cause": "stlc.monitor.explain.report"}

    rule: CompiledRequirement
    start: int
    low: Floats
    high: Floats
    holds: Bools
    fails: Bools
    shape: tuple[int, ...]
    part: Part
    timeline: Timeline
    tolerance: float = TOLERANCE
    ends: Ends = "open"
    scope: Bools | None = None
    reported: tuple[Floats, Floats] | None = None
    counts: Counts | None = None
    facts: tuple[Fact, ...] = ()
    violated_at: float | None = None
    subject: Prepared | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        return f"RequirementVerdict({self.name}: {self.overall} · {self.brief})"

    @property
    def amount(self) -> str:
        """Least robustness with its unit; bounds, if it is inconclusive."""
        found = self.figures
        if found.min is None:
            return "no trace in scope"
        text = (
            f"{found.min:.4g}" if self.overall != "inconclusive" else f"[{found.low:.4g}, {found.high:.4g}]"
        )
        return f"{text} {found.unit}".rstrip()

    @property
    def brief(self) -> str:
        """Least robustness, and where it is: `-0.3 m at t = 4 s`."""
        where = self.where
        return self.amount + (f" {'' if where.startswith('from') else 'at '}{where}" if where else "")

    @property
    def margins(self) -> tuple[Floats, Floats]:
        """Least and greatest robustness in the requested semantics, each (instants, traces)."""
        return (self.low, self.high) if self.reported is None else self.reported

    @property
    def name(self) -> str:
        """Name of the requirement."""
        return self.rule.name

    @property
    def tags(self) -> list[str]:
        """Tags of the requirement."""
        return sorted(self.rule.tags)

    @property
    def unit(self) -> str:
        """Unit of the robustness: the unit of all predicates, or "" if they have different units."""
        return self.rule.unit

    @property
    def statuses(self) -> list[Status]:
        """Status of each trace; `out of scope` if the trace violates the assumptions."""
        inside = np.ones(self.holds.shape[1], dtype=bool) if self.scope is None else self.scope
        return [
            TOLERANCE.status(bool(fails.any()), bool(holds.all())) if counts else "out of scope"
            for fails, holds, counts in zip(self.fails.T, self.holds.T, inside, strict=True)
        ]

    def counted(self, values: NDArray[Any]) -> NDArray[Any]:
        """Select the traces that satisfy the assumptions (`scope`) from `values` (…, traces)."""
        return values if self.scope is None else values[..., self.scope]

    @property
    def status(self) -> Any:
        """`satisfied`, `violated`, `inconclusive` or `out of scope`; an array of these for several traces."""
        return _shaped(np.array(self.statuses), self.shape)

    @property
    def overall(self) -> Status:
        """Status over traces in scope: violated if any is, satisfied if all are, else inconclusive."""
        holds = self.counted(self.holds)
        return TOLERANCE.status(bool(self.counted(self.fails).any()), bool(holds.size and holds.all()))

    @property
    def satisfied(self) -> bool | None:
        """True if all traces satisfy the requirement, False if any violates it, None if that is unknown."""
        return _known(self.overall)

    @property
    def violated_traces(self) -> int:
        """Number of traces that violate the requirement."""
        return self.statuses.count("violated")

    @property
    def unjudged(self) -> bool:
        """True if the requirement is satisfied, but was not fully judged."""
        return self.overall == "satisfied" and any(fact.unjudged for fact in self.facts)

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Bounds on `robustness` over all continuations of the trace: floats, or arrays for a batch."""
        low, high = self.margins
        return _shaped(low.min(axis=0), self.shape), _shaped(high.min(axis=0), self.shape)

    @property
    def robustness(self) -> Any:
        """The least robustness over the evaluated instants: a float, or an array for a batch of traces.

        If a trace is too short for an exact value, it is the lower bound if the requirement is satisfied, the
        upper bound if it is violated, else NaN.
        """
        return _shaped(self.least, self.shape)

    @property
    def least(self) -> Floats:
        """Array (traces,) of the values that `robustness` returns."""
        low, high = (end.min(axis=0) for end in self.margins)
        known = np.where(self.holds.all(axis=0), low, np.nan)
        return np.where(low == high, low, np.where(self.fails.any(axis=0), high, known))

    @property
    def figures(self) -> Robustness:
        """Robustness over the traces in scope."""
        low, high, least = (self.counted(end) for end in (*self.margins, self.least))
        trace, sample = self.worst
        start, cause, known = self.timeline.time(sample), self.cause, bool(least.size)
        with np.errstate(invalid="ignore"):  # +inf and -inf have no mean, and a sum of values could overflow
            mean = float((least / least.size).sum()) if known else None
        least_low, least_high = (float(values.min()) if known else None for values in (low, high))
        unit, time = (
            self.unit or ("" if cause is None else cause.unit),
            start if cause is None else cause.time,
        )
        where = WorstStart(trace, start, time)
        return Robustness(float(least.min()) if known else None, mean, least_low, least_high, unit, where)

    @property
    def share(self) -> Num:
        """Share of the evaluated instants of all traces at which the requirement certainly holds."""
        held = self.counted(self.held)
        return float(held.sum() / (held.size * self.instants)) if held.size and self.instants else 0.0

    @property
    def instants(self) -> int:
        """Number of evaluated instants per trace."""
        return len(self.low) if self.counts is None else self.counts.instants

    @property
    def held(self) -> Ints:
        """Number of instants at which the requirement certainly holds, (traces,)."""
        return self.holds.sum(axis=0) if self.counts is None else self.counts.held

    @property
    def failed(self) -> Ints:
        """Number of instants at which the requirement is certainly violated, (traces,)."""
        return self.fails.sum(axis=0) if self.counts is None else self.counts.failed

    @property
    def worst(self) -> tuple[int, int]:
        """Trace and sample of the violation with the least `high`; without one, those of the least `low`."""
        violated = bool(self.counted(self.fails).any())
        values = self._violating if violated else self.low
        if self.scope is not None and self.scope.any():
            values = np.where(self.scope, values, np.inf)
        instant, trace = (int(each) for each in np.unravel_index(int(np.argmin(values)), values.shape))
        if self.counts is None:
            return trace, self.start + instant
        return trace, int((self.counts.high_at if violated else self.counts.low_at)[trace])

    @property
    def _violating(self) -> Floats:
        return np.where(self.fails, self.high, np.inf)

    @cached_property
    def cause(self) -> Cause | None:
        """Cause of the worst violation; None if there is none, or if no single sample shows it."""
        return None if self.subject is None or self.overall != "violated" else self.subject.why(self)

    @property
    def when(self) -> str:
        """Time of the worst violation, or of the least robustness; "" if the requirement is judged once."""
        if (cause := self.cause) is not None:
            return beside(cause.moment, cause.started if self.instants > 1 else cause.moment)
        return f"from {self.timeline.moment(self.worst[1])}" if self.instants > 1 else ""

    @property
    def where(self) -> str:
        """Trace, of several, and time of the worst violation, or of the least robustness."""
        trace = f"trace {self.worst[0]}" if len(self.low.T) > 1 else ""
        return ", ".join(filter(None, (trace, self.when)))

    @property
    def parts_read(self) -> tuple[TimeRange, ...]:
        """Times in seconds at which the requirement could read the recording; empty for all of it."""
        first, time = self.part.first, self.timeline.time
        starts = range(self.start - first, self.start - first + self.instants)
        found = samples_read(self.rule.formula, starts, self.part.stop - first)
        if not found:
            return () if self.part.seen is None else (self.part.seen,)
        return tuple(TimeRange(time(first + each.start), time(first + each.stop - 1)) for each in found)

    @property
    def judged(self) -> JudgedPart | None:
        """The part of the recording that the requirement could read; None for all of it."""
        parts, whole = self.parts_read, self.timeline.duration
        if not parts:
            return None
        first = whole.first
        return JudgedPart(parts[0].first - first, parts[-1].last - first, whole.last - first)

    def told(self, facts: Iterable[Fact], *, cause: bool) -> RequirementVerdict:
        """Return the verdict without signals and instants, but with facts and, if asked for, its cause."""
        low, high = (None, None) if self.reported is None else self.reported
        at = (self.start + end.argmin(axis=0) for end in (self.low, self._violating))
        made = replace(
            self,
            low=_lowest(self.low),
            high=_lowest(self.high),
            holds=np.asarray(self.holds.all(axis=0, keepdims=True)),
            fails=np.asarray(self.fails.any(axis=0, keepdims=True)),
            reported=None if low is None or high is None else (_lowest(low), _lowest(high)),
            counts=self.counts or Counts(self.instants, self.held, self.failed, *at),
            facts=tuple(facts),
            subject=None,
        )
        found = self.cause if cause else None
        return made.knowing(None if found is None else found.told())

    def knowing(self, cause: Cause | None) -> RequirementVerdict:
        """Return the same verdict, of which the cause is known."""
        self.__dict__["cause"] = cause
        return self


def _lowest(values: Floats) -> Floats:
    return np.asarray(values.min(axis=0, keepdims=True))


@dataclass(frozen=True, slots=True)
class UnknownSamples:
    """Number of unknown samples of a signal, and the times of the first and the last one in seconds."""

    samples: int
    first: float
    last: float


@dataclass(frozen=True, slots=True)
class About:
    """The recording and the specification of a verdict.

    Attributes:
        trace: name of the recording, with that of the object in it.
        file: name of its file.
        track: name of the object in the file; "" if it holds one.
        source: text of the specification.
        spec_name: name of the specification.
        samples: number of samples.
        shape: axes of the signals before their time axis; () for a single trace.
        dt: time step in seconds; None if unknown.
        steps: horizon `T` in steps; None if unknown.
        clocks: clocks of the recording, and how each was found.
        seeds: seed of the world of each trace, (traces,), if it is recorded.
        warnings: warnings of the compiler, and about the file.
        resampled: whether values between the samples are known.
    """

    trace: str
    file: str
    track: str
    source: Source
    spec_name: str
    samples: int
    shape: tuple[int, ...]
    dt: Num | None
    steps: int | None
    clocks: tuple[Clock, ...] = ()
    seeds: NDArray[Any] | None = None
    warnings: tuple[Diagnostic, ...] = ()
    resampled: bool = False

    @property
    def traces(self) -> int:
        """Number of traces."""
        return int(np.prod(self.shape, dtype=np.int64))


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file that a verdict rests on."""

    path: str
    sha256: str
    bytes: int


@dataclass(frozen=True, slots=True)
class Evidence:
    """Basis of a verdict: the version, the files, and the options, name -> values."""

    stlc: str
    trace: InputFile
    inputs: tuple[InputFile, ...]
    options: Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class Verdict:
    """Verdicts of all requirements of a specification on one or many traces.

    Attributes:
        requirements: one verdict per requirement, in the order of the specification.
        about: the recording and the specification.
        end: treatment of a trace that is too short.
        uncertain: signal -> greatest error of its samples.
        lint: codes of the warnings that the lint rules have of the specification, if they were asked for.
        evidence: hashes of the inputs and the options, if they were asked for.
        notes: what was taken that was not asked for, such as the constants of the recording.
        streamed: whether the samples were judged as they came, so that the shares of instants are bounds.
        judged_on: the evaluated signals and the compiled requirements; None in a verdict that was told.
    """

    JSON: ClassVar = (
        "trace=about.trace spec=about.source.name spec_sha256 dt=about.dt horizon unknown end uncertain? "
        "traces samples=about.samples in_scope verdict=scoped robustness=least satisfied_traces "
        "satisfied_share=share requirements clocks=about.clocks facts=remarks "
        "lint=lint_codes evidence?"
    )

    NAMES: ClassVar = {"Uncertainty": "stlc.monitor.uncertain"}

    requirements: tuple[RequirementVerdict, ...]
    about: About
    end: End = "open"
    uncertain: Mapping[str, Uncertainty] = field(default_factory=dict)
    lint: tuple[str, ...] = ()
    evidence: Evidence | None = None
    notes: tuple[str, ...] = ()
    streamed: bool = False
    judged_on: Prepared | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        status = self.scoped
        chosen = [each for each in self if each.overall == status] or list(self.requirements)
        worst = worst_of(chosen)
        count = f"{len(chosen)} of {len(self.requirements)}" if status != "satisfied" else f"{len(chosen)}"
        traces = f" on {self.traces:,} traces" if self.traces > 1 else ""
        return f"Verdict({status}: {count}{traces} · {worst.name} {worst.brief})"

    def _repr_html_(self) -> str:
        rows = [
            (row.name, row.overall, row.amount, row.where, "" if row.cause is None else row.cause.because)
            for row in self
        ]
        header = ("requirement", "verdict", "robustness", "where", "why")
        bad = [row.overall == "violated" for row in self]
        return html_table(f"{self.about.spec_name} on {self.about.trace}: {self.scoped}", header, rows, bad)

    plot = plot

    def to_frame(self) -> Any:
        """Return a data frame of pandas or polars with a row for each requirement and trace.

        `unit` is that of the robustness. It is missing for a requirement that compares truth values, or
        quantities of different units: its robustness is then a number whose sign tells the verdict.

        Raises MissingError (R301) if neither package is installed.
        """
        rows = [
            (row.name, trace, status, float(least), row.unit or None, float(held) / row.instants)
            for row in self
            for trace, (status, least, held) in enumerate(zip(row.statuses, row.least, row.held, strict=True))
        ]
        names = ("requirement", "trace", "verdict", "robustness", "unit", "share")
        return frame(dict(zip(names, map(list, zip(*rows, strict=True)), strict=True)))

    @property
    def subject(self) -> Prepared:
        """The evaluated signals and the compiled requirements, which a told verdict does not have."""
        assert self.judged_on is not None, "a verdict that was told has no signals"
        return self.judged_on

    @cached_property
    def facts(self) -> tuple[Fact, ...]:
        """Facts that the verdict rests on, such as what was read."""
        return self.subject.facts(self)

    @cached_property
    def gaps(self) -> dict[str, Gap]:
        """Unknown samples of each signal that the requirements read, by name."""
        return self.subject.signals.gaps

    @property
    def causes(self) -> dict[str, Cause]:
        """Causes of the first `MOST` violations, by requirement."""
        found = {each.name: each.cause for each in self.violated[:MOST]}
        return {name: cause for name, cause in found.items() if cause is not None}

    @property
    def worst(self) -> RequirementVerdict:
        """The verdict with the least weighted lower bound on its robustness."""
        return worst_of(self)

    @property
    def violated(self) -> list[RequirementVerdict]:
        """The verdicts on the requirements that are violated."""
        return [each for each in self.requirements if each.overall == "violated"]

    def facts_on(self, requirement: str) -> tuple[Fact, ...]:
        """Facts about a requirement, without places and without warnings; "" for those on the recording."""
        chosen = (f for f in self.facts if f.requirement == requirement and f.severity == "fact")
        return tuple(replace(fact, finding=replace(fact.finding, span=None)) for fact in chosen)

    @property
    def remarks(self) -> tuple[Fact, ...]:
        """Facts about the recording."""
        return self.facts_on("")

    @property
    def warnings(self) -> tuple[Diagnostic, ...]:
        """Warnings of the compiler, about the file, and about the recording."""
        return (*self.about.warnings, *(f.finding for f in self.facts if f.severity == "warning"))

    def told(self, *, reasons: bool = True) -> Verdict:
        """Return the verdict without the signals, but with what it says: shares, gaps, causes and facts.

        It is small, and can be sent to another process. Causes and facts are left out unless `reasons`.
        """
        if self.judged_on is None:
            return self
        found = self if reasons else self.knowing(facts=())
        explained = {each.name for each in found.violated[:MOST]} if reasons else ()
        rows = [each.told(found.facts_on(each.name), cause=each.name in explained) for each in found]
        known = ("facts", "gaps", "share", "failed_share", "robustness")
        given = {name: getattr(found, name) for name in known}
        return replace(self, requirements=tuple(rows), judged_on=None).knowing(**given)

    def knowing(self, **found: object) -> Verdict:
        """Return the same verdict, of which some members need not be computed."""
        self.__dict__.update(found)
        return self

    def but(self, **changes: Any) -> Verdict:
        """Return a copy of a told verdict with other members."""
        return replace(self, **changes).knowing(**{**self.__dict__, **changes})

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the signals before their time axis; () for a single trace."""
        return self.about.shape

    @property
    def spec_sha256(self) -> str:
        """Hash of the text of the specification."""
        return sha256(self.about.source.text)

    @property
    def horizon(self) -> Horizon | None:
        """Horizon `T`; None if unknown."""
        steps = self.about.steps
        return None if steps is None else Horizon(steps * (self.about.dt or 0.0), steps)

    @property
    def unknown(self) -> dict[str, UnknownSamples]:
        """Unknown samples of each signal, in time."""
        time = self.requirements[0].timeline.time
        return {n: UnknownSamples(g.samples, time(g.first), time(g.last)) for n, g in self.gaps.items()}

    def __getitem__(self, name: str) -> RequirementVerdict:
        """Return the verdict on the requirement `name`. Raises UsageError (U101) for an unknown name."""
        return chosen(self.requirements, [name])[0]

    def __iter__(self) -> Iterator[RequirementVerdict]:
        return iter(self.requirements)

    @property
    def traces(self) -> int:
        """Number of traces."""
        return self.about.traces

    @property
    def statuses(self) -> list[Status]:
        """Status of each trace: `violated` if it violates any requirement, `satisfied` if it satisfies all.

        Else it is `inconclusive`; `out of scope` if it violates the assumptions.
        """
        rows = zip(*(each.statuses for each in self.requirements), strict=True)
        return [
            "out of scope"
            if "out of scope" in found
            else TOLERANCE.status("violated" in found, found <= {"satisfied"})
            for found in map(set, rows)
        ]

    @property
    def status(self) -> Any:
        """`satisfied`, `violated`, `inconclusive` or `out of scope`; an array of these for several traces."""
        return _shaped(np.array(self.statuses), self.shape)

    def within(self, scope: Bools) -> Verdict:
        """Return a verdict that counts only traces in `scope`, (traces,), which satisfy the assumptions."""
        if scope.all():
            return self
        return replace(self, requirements=tuple(replace(j, scope=scope) for j in self.requirements))

    @property
    def lint_codes(self) -> list[str]:
        """Codes of what the lint rules say, each once."""
        return sorted(set(self.lint))

    @property
    def scope(self) -> Bools:
        """Traces that satisfy the assumptions, (traces,)."""
        scope = self.requirements[0].scope
        return np.ones(self.traces, dtype=np.bool_) if scope is None else scope

    @property
    def in_scope(self) -> int:
        """Number of traces that satisfy the assumptions."""
        return int(self.scope.sum())

    @property
    def factors(self) -> dict[str, float]:
        """Factor of the robustness of each requirement in that of all, weight / scale."""
        return {each.name: each.rule.factor for each in self}

    @property
    def overall(self) -> Status:
        """Status over traces in scope: violated if a requirement is, satisfied if all, else inconclusive."""
        found = {each.overall for each in self.requirements}
        return TOLERANCE.status("violated" in found, found <= {"satisfied"})

    @property
    def scoped(self) -> Status:
        """Status over traces in scope; `out of scope` if there are none."""
        return self.overall if self.in_scope else "out of scope"

    @property
    def satisfied(self) -> bool | None:
        """True if all traces satisfy all requirements, False if any requirement is violated, else None."""
        return _known(self.overall)

    @cached_property
    def robustness(self) -> Any:
        """The least `weight * robustness / scale` of all requirements: a float, or an array for a batch."""
        return overall_robustness(self.requirements, self.shape, self.subject.record.semantics)

    @property
    def least(self) -> Num | None:
        """The least `robustness` of the traces in scope; None if there are none."""
        found = self.requirements[0].counted(np.ravel(self.robustness))
        return float(found.min()) if found.size else None

    @cached_property
    def share(self) -> Num:
        """Share of instants at which all requirements certainly hold; one evaluated once counts at each."""
        return self._share([each.holds for each in self.requirements], np.all)

    @cached_property
    def failed_share(self) -> float:
        """Share of the instants of all traces at which at least one requirement is certainly violated."""
        return self._share([each.fails for each in self.requirements], np.any)

    def _share(self, truths: Sequence[Bools], join: Callable[..., Bools]) -> float:
        """Share of the instants at which all, or any, of `truths`, each (instants, traces), are true.

        Fewer truth values than the others have are joined to one per trace, which counts at every instant.
        """
        most = max(map(len, truths))
        spread = [
            truth if len(truth) == most else np.broadcast_to(join(truth, axis=0), (most, self.traces))
            for truth in truths
        ]
        counted = self.requirements[0].counted(join(spread, axis=0))
        return float(counted.mean()) if counted.size else 0.0

    @property
    def satisfied_traces(self) -> int:
        """Number of traces that satisfy every requirement at all its instants."""
        return self.statuses.count("satisfied")


def worst_of(found: Iterable[RequirementVerdict]) -> RequirementVerdict:
    """Return the verdict with the least weighted lower bound on its robustness by traces in scope."""
    return min(found, key=lambda each: float(each.counted(each.low).min(initial=np.inf)) * each.rule.factor)


def overall_robustness(
    found: Sequence[RequirementVerdict], shape: tuple[int, ...], semantics: Semantics | None = None
) -> Any:
    """Return the least `weight * robustness / scale` of requirements: a float, or an array of a shape."""
    rows, factors = [each.least[None] for each in found], (each.rule.factor for each in found)
    return _shaped(TOLERANCE.overall(rows, factors, NUMPY, semantics or semantics_of())[0], shape)


def beside(moment: str, start: str) -> str:
    """Text of an instant, and of the start of its window if that differs: `t = 4 s (window from 2 s)`."""
    return moment if moment == start else f"{moment} (window from {start.removeprefix('t = ')})"


def chosen(rules: Sequence[R], names: Sequence[str]) -> tuple[R, ...]:
    """Return the requirements, or verdicts on them, that are called `names`; all if there are no names.

    Raises UsageError (U101) if there is no requirement of a name.
    """
    require_known(names, [rule.name for rule in rules])
    return tuple(rule for rule in rules if not names or rule.name in names)


def require_known(names: Sequence[str], known: Sequence[str]) -> None:
    """Raise UsageError (U101) if one of `names` is not that of a requirement; `known` are their names.

    A single text is refused, too: its letters would be the names.
    """
    if isinstance(names, str):
        raise usage("requirements are a list of names", f'["{names}"]')
    for name in names:
        if name not in known:
            note = (f"requirements: {', '.join(known)}",)
            raise usage(f"there is no requirement `{name}`", note=note).near(name, known)


def _known(status: Status) -> bool | None:
    return None if status == "inconclusive" else status == "satisfied"


def _shaped(values: NDArray[Any], shape: tuple[int, ...]) -> Any:
    return values.reshape(shape) if shape else values.reshape(()).item()
