"""Verdicts on traces: for one requirement or for all, per trace or over all traces."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir.support import columns
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.compile.semantics.semantics import Semantics
from stlc.compile.semantics.tolerance import TOLERANCE, weighed
from stlc.diagnostics import Diagnostic, TraceError, UsageError
from stlc.monitor.facts.fact import Fact
from stlc.monitor.signals import Gap, Signals
from stlc.monitor.values import Record
from stlc.registry import closest
from stlc.trace.resample import TimeRange

Status: TypeAlias = Literal["satisfied", "violated", "inconclusive", "out of scope"]
Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]

_ROUNDING = 1e-6
"""Share of a step by which times may be off the grid."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """Signals and compiled requirements, ready for evaluation.

    Attributes:
        compiled: the specification, compiled for the time step of the signals.
        rules: the requirements to evaluate.
        signals: the signals with their shape and times.
        record: the same signals as arrays (time, batch), and the array library (NumPy or torch).
    """

    compiled: Compiled
    rules: tuple[CompiledRequirement, ...]
    signals: Signals
    record: Record

    @property
    def horizon(self) -> int | None:
        """Horizon `T` of the planning window in steps; None if unknown."""
        return self.compiled.grid.horizon

    @property
    def dt(self) -> float | None:
        """Time step in seconds; None if unknown."""
        return None if self.compiled.grid.dt is None else float(self.compiled.grid.dt)

    @property
    def gaps(self) -> dict[str, Gap]:
        """Unknown samples of each signal that the requirements read, by name."""
        return self.signals.gaps

    def under(self, semantics: Semantics) -> Prepared:
        """Return a copy that is evaluated in the given `semantics` (definition of minimum and maximum)."""
        return replace(self, record=replace(self.record, semantics=semantics))

    def time(self, sample: int) -> float:
        """Time of a sample in seconds; the sample number if the time step is unknown."""
        if self.signals.times is not None and 0 <= sample < len(self.signals.times):
            return float(self.signals.times[sample])
        return float(sample) if self.dt is None else self.signals.t0 + sample * self.dt

    @property
    def whole(self) -> TimeRange | None:
        """Time in which any signal was seen, if signals were seen at different times."""
        spans = self.signals.spans.values()
        if self.signals.dt is None or not spans or not self.signals.samples:
            return None
        first = min(span.first for span in spans)
        return TimeRange(first, max(max(span.last for span in spans), first))

    @property
    def duration(self) -> TimeRange:
        """Time of the recording, from its first to its last sample."""
        return self.whole or TimeRange(self.time(0), self.time(self.record.samples - 1))

    def seen(self, rule: CompiledRequirement) -> TimeRange | None:
        """Time in which all signals of a requirement were seen (E602 without one); None if it is `whole`."""
        whole = found = self.whole
        if whole is None or found is None or rule.absolute:
            return None
        spans = {name: span for name, span in self.signals.spans.items() if name in columns(rule.formula)}
        for span in spans.values():
            found = found.within(span)
        if found.last < found.first:
            told = [
                f"`{name}` is "
                + (f"seen from {x.first:.6g} s to {x.last:.6g} s" if x.first <= x.last else "never seen")
                for name, x in spans.items()
            ]
            message = f"the signals of `{rule.name}` in `{self.signals.name}` have no time in common"
            raise TraceError(Diagnostic("E602", message, rule.span, note=("; ".join(told),)))
        return None if found == whole else found

    def part(self, rule: CompiledRequirement) -> Part:
        """Return the samples on which a requirement is judged: those at which its signals were seen."""
        seen, samples, dt = self.seen(rule), self.signals.samples, self.signals.dt
        if seen is None or dt is None:
            return Part(0, self.record.samples)
        first = math.ceil((seen.first - self.signals.t0) / dt - _ROUNDING)
        stop = math.floor((seen.last - self.signals.t0) / dt + _ROUNDING) + 1
        stop = max(min(stop, samples), min(first, samples - 1) + 1)
        return Part(min(max(first, 0), samples - 1), stop, seen)

    def moment(self, sample: int) -> str:
        """Time of a sample as text: `t = 4.6 s`, or `sample 46` if the time step is unknown."""
        return f"sample {sample}" if self.dt is None else f"t = {self.time(sample):.10g} s"


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


@dataclass(frozen=True, slots=True)
class Judgement:
    """Verdict and robustness of one requirement on one or many traces.

    Attributes:
        rule: the requirement.
        start: the first sample at which the requirement is evaluated, that of the first row of `low`.
        low: least robustness over all continuations of the traces, (instants, traces).
        high: greatest robustness; the same array as `low` if nothing is unknown.
        holds: whether the requirement is certainly satisfied, (instants, traces).
        fails: whether the requirement is certainly violated, (instants, traces).
        shape: axes of the signals before their time axis; () for a single trace.
        scope: True for traces that satisfy the assumptions, (traces,); None if all do. The others do not
            affect verdicts over all traces.
        reported: `low` and `high` in the requested semantics (definition of min and max); None: the exact.
        part: the samples on which the requirement is judged; None for all.
        tolerance: a requirement is satisfied if its robustness is at least minus this value.
    """

    rule: CompiledRequirement
    start: int
    low: Floats = field(repr=False)
    high: Floats = field(repr=False)
    holds: Bools = field(repr=False)
    fails: Bools = field(repr=False)
    shape: tuple[int, ...]
    scope: Bools | None = field(default=None, repr=False)
    reported: tuple[Floats, Floats] | None = field(default=None, repr=False)
    part: Part | None = None
    tolerance: float = TOLERANCE

    @property
    def margins(self) -> tuple[Floats, Floats]:
        """Least and greatest robustness in the requested semantics, each (instants, traces)."""
        return (self.low, self.high) if self.reported is None else self.reported

    @property
    def name(self) -> str:
        """Name of the requirement."""
        return self.rule.name

    @property
    def unit(self) -> str:
        """Unit of the robustness: the unit of all predicates, or "" if they have different units."""
        return self.rule.unit

    @property
    def statuses(self) -> list[Status]:
        """Status of each trace; `out of scope` if the trace violates the assumptions."""
        inside = np.ones(self.holds.shape[1], dtype=bool) if self.scope is None else self.scope
        return [
            _status(bool(fails.any()), bool(holds.all())) if counts else "out of scope"
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
        return _status(bool(self.counted(self.fails).any()), bool(holds.size and holds.all()))

    @property
    def satisfied(self) -> bool | None:
        """True if all traces satisfy the requirement, False if any violates it, None if that is unknown."""
        return _known(self.overall)

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
    def share(self) -> float:
        """Share of the evaluated instants of all traces at which the requirement certainly holds."""
        holds = self.counted(self.holds)
        return float(holds.mean()) if holds.size else 0.0

    @property
    def instants(self) -> int:
        """Number of evaluated instants per trace."""
        return len(self.low)

    @property
    def worst(self) -> tuple[int, int]:
        """Trace and sample with the least `high` if the requirement is violated, else the least `low`."""
        values = self.high if self.counted(self.fails).any() else self.low
        if self.scope is not None and self.scope.any():
            values = np.where(self.scope, values, np.inf)
        instant, trace = np.unravel_index(int(np.argmin(values)), values.shape)
        return int(trace), self.start + int(instant)


def _no_facts(_: Verdict) -> tuple[Fact, ...]:
    return ()


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdicts of all requirements of a specification on one or many traces.

    Attributes:
        requirements: one judgement per requirement, in the order of the specification.
        subject: the evaluated signals and the compiled requirements.
        rules: function that finds the facts.
    """

    requirements: tuple[Judgement, ...]
    subject: Prepared = field(repr=False)
    rules: Callable[[Verdict], tuple[Fact, ...]] = field(default=_no_facts, repr=False, compare=False)

    @property
    def facts(self) -> tuple[Fact, ...]:
        """Facts that the verdict rests on, such as what was read; they are looked for on each call."""
        return self.rules(self)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the signals before their time axis; () for a single trace."""
        return self.subject.signals.shape

    def __getitem__(self, name: str) -> Judgement:
        """Return the judgement of the requirement `name`. Raises UsageError (U101) for an unknown name."""
        for judgement in self.requirements:
            if judgement.name == name:
                return judgement
        raise unknown_requirement(name, [judgement.name for judgement in self.requirements])

    def __iter__(self) -> Iterator[Judgement]:
        return iter(self.requirements)

    @property
    def traces(self) -> int:
        """Number of traces."""
        return self.subject.signals.batch

    @property
    def statuses(self) -> list[Status]:
        """Status of each trace: `violated` if it violates any requirement, `satisfied` if it satisfies all.

        Else it is `inconclusive`; `out of scope` if it violates the assumptions.
        """
        rows = zip(*(judgement.statuses for judgement in self.requirements), strict=True)
        return [
            "out of scope"
            if "out of scope" in found
            else _status("violated" in found, found <= {"satisfied"})
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
    def in_scope(self) -> int:
        """Number of traces that satisfy the assumptions."""
        scope = self.requirements[0].scope
        return self.traces if scope is None else int(scope.sum())

    @property
    def overall(self) -> Status:
        """Status over traces in scope: violated if a requirement is, satisfied if all, else inconclusive."""
        found = {judgement.overall for judgement in self.requirements}
        return _status("violated" in found, found <= {"satisfied"})

    @property
    def satisfied(self) -> bool | None:
        """True if all traces satisfy all requirements, False if any requirement is violated, else None."""
        return _known(self.overall)

    @property
    def robustness(self) -> Any:
        """The least `weight * robustness / scale` of all requirements: a float, or an array for a batch."""
        rows = [weighed(j.least[None], j.rule.factor, NUMPY) for j in self.requirements]
        return _shaped(self.subject.record.semantics.join(rows, "min", NUMPY)[0], self.shape)

    @property
    def share(self) -> float:
        """Share of instants at which all requirements certainly hold; one evaluated once counts at each."""
        return self._share([judgement.holds for judgement in self.requirements], np.all)

    @property
    def failed_share(self) -> float:
        """Share of the instants of all traces at which at least one requirement is certainly violated."""
        return self._share([judgement.fails for judgement in self.requirements], np.any)

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


def beside(moment: str, start: str) -> str:
    """Text of an instant, and of the start of its window if that differs: `t = 4 s (window from 2 s)`."""
    return moment if moment == start else f"{moment} (window from {start.removeprefix('t = ')})"


def unknown_requirement(name: str, names: list[str]) -> UsageError:
    """Return the error U101: no requirement is called `name`."""
    near = closest(name, names)
    help_ = (f"did you mean `{near}`?",) if near else ()
    note = (f"requirements: {', '.join(names)}",)
    return UsageError(Diagnostic("U101", f"there is no requirement `{name}`", help=help_, note=note))


def _status(violated: bool, satisfied: bool) -> Status:
    return "violated" if violated else "satisfied" if satisfied else "inconclusive"


def _known(status: Status) -> bool | None:
    return None if status == "inconclusive" else status == "satisfied"


def _shaped(values: NDArray[Any], shape: tuple[int, ...]) -> Any:
    return values.reshape(shape) if shape else values.reshape(()).item()
