"""Verdicts on traces: for one requirement or for all, per trace or over all traces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.compile.semantics.semantics import Semantics
from stlc.diagnostics import Diagnostic, UsageError
from stlc.monitor.signals import Gap, Signals
from stlc.monitor.values import Record
from stlc.registry import closest

Status: TypeAlias = Literal["satisfied", "violated", "inconclusive", "out of scope"]
Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]


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
        return float(sample) if self.dt is None else self.signals.t0 + sample * self.dt

    def moment(self, sample: int) -> str:
        """Time of a sample as text: `t = 4.6 s`, or `sample 46` if the time step is unknown."""
        return f"sample {sample}" if self.dt is None else f"t = {self.time(sample):.10g} s"


@dataclass(frozen=True, slots=True)
class Judgement:
    """Verdict and robustness of one requirement on one or many traces.

    Attributes:
        rule: the requirement.
        start: the first sample at which the requirement is evaluated. Row i of `low` belongs to sample
            `start` + i.
        low: least robustness over all continuations of the traces, (instants, traces).
        high: greatest robustness; the same array as `low` if nothing is unknown.
        holds: whether the requirement is certainly satisfied, (instants, traces).
        fails: whether the requirement is certainly violated, (instants, traces).
        shape: axes of the signals before their time axis; () for a single trace.
        scope: True for traces that satisfy the assumptions, (traces,); None if all traces do. Traces that
            violate the assumptions do not affect verdicts over all traces.
        reported: `low` and `high` in the semantics (definition of min and max) that the caller requested;
            None if the caller requested the exact semantics.
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

    @property
    def margins(self) -> tuple[Floats, Floats]:
        """Least and greatest robustness, each (instants, traces).

        They are computed in the semantics (definition of min and max) that the caller requested.
        """
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
        """Status over all traces that satisfy the assumptions.

        It is violated if any trace violates the requirement, satisfied if all satisfy it, else inconclusive.
        """
        holds = self.counted(self.holds)
        return _status(bool(self.counted(self.fails).any()), bool(holds.size and holds.all()))

    @property
    def satisfied(self) -> bool | None:
        """True if all traces satisfy the requirement, False if any violates it, None if that is unknown."""
        return _known(self.overall)

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Lower and upper bound on the least robustness over the evaluated instants.

        The bounds hold for all continuations of the trace. They are floats, or arrays for a batch of traces.
        """
        low, high = self.margins
        return _shaped(low.min(axis=0), self.shape), _shaped(high.min(axis=0), self.shape)

    @property
    def robustness(self) -> Any:
        """The least robustness over the evaluated instants: a float, or an array for a batch of traces.

        If a trace is too short for an exact value, the lower bound is returned for a satisfied requirement,
        the upper bound for a violated one, and NaN if the verdict is inconclusive.
        """
        return _shaped(self.least, self.shape)

    @property
    def least(self) -> Floats:
        """Array (traces,) of the values that `robustness` returns."""
        low, high = (end.min(axis=0) for end in self.margins)
        known = np.where(self.holds.all(axis=0), low, np.nan)
        known = np.where(self.fails.any(axis=0), high, known)
        return np.where(low == high, low, known)

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
        """Return (trace, sample): the index of the trace, and the sample at which its robustness is least.

        If the requirement is violated, the upper bounds on the robustness (`high`) are compared. Otherwise
        the lower bounds (`low`) are compared.
        """
        values = self.high if self.counted(self.fails).any() else self.low
        if self.scope is not None and self.scope.any():
            values = np.where(self.scope, values, np.inf)
        instant, trace = np.unravel_index(int(np.argmin(values)), values.shape)
        return int(trace), self.start + int(instant)


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdicts of all requirements of a specification on one or many traces.

    Attributes:
        requirements: one judgement per requirement, in the order of the specification.
        subject: the evaluated signals and the compiled requirements.
    """

    requirements: tuple[Judgement, ...]
    subject: Prepared = field(repr=False)

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
        """Status of each trace: `violated`, `satisfied`, `inconclusive` or `out of scope`.

        A trace that violates the assumptions is out of scope. Any other trace is violated if it violates any
        requirement, satisfied if it satisfies all of them, and else inconclusive.
        """
        rows = [judgement.statuses for judgement in self.requirements]
        return [
            "out of scope"
            if "out of scope" in column
            else _status("violated" in column, {*column} <= {"satisfied"})
            for column in zip(*rows, strict=True)
        ]

    @property
    def status(self) -> Any:
        """`satisfied`, `violated`, `inconclusive` or `out of scope`; an array of these for several traces."""
        return _shaped(np.array(self.statuses), self.shape)

    def within(self, scope: Bools) -> Verdict:
        """Return a copy of the verdict that counts only the traces that satisfy the assumptions.

        The array `scope`, (traces,), is True for these traces.
        """
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
        """Status over all requirements and all traces that satisfy the assumptions.

        It is violated if any requirement is violated, satisfied if all are satisfied, else inconclusive.
        """
        found = {judgement.overall for judgement in self.requirements}
        return _status("violated" in found, found <= {"satisfied"})

    @property
    def satisfied(self) -> bool | None:
        """True if all traces satisfy all requirements, False if any requirement is violated, else None."""
        return _known(self.overall)

    @property
    def robustness(self) -> Any:
        """The least `weight * robustness / scale` of all requirements: a float, or an array for a batch."""
        rows = [j.least[None] * (j.rule.weight / j.rule.scale) for j in self.requirements]
        return _shaped(self.subject.record.semantics.join(rows, "min", NUMPY)[0], self.shape)

    @property
    def share(self) -> float:
        """Share of the instants of all traces at which all requirements certainly hold.

        If a requirement is evaluated only once, its verdict counts at every instant.
        """
        most = self._most_instants
        return self._mean(np.logical_and.reduce([self._spread(j, j.holds, most) for j in self.requirements]))

    @property
    def failed_share(self) -> float:
        """Share of the instants of all traces at which at least one requirement is certainly violated."""
        most = self._most_instants
        return self._mean(np.logical_or.reduce([self._spread(j, j.fails, most) for j in self.requirements]))

    @property
    def _most_instants(self) -> int:
        """Greatest number of instants at which any of the requirements is evaluated."""
        return max(judgement.instants for judgement in self.requirements)

    def _mean(self, truth: Bools) -> float:
        counted = self.requirements[0].counted(truth)
        return float(counted.mean()) if counted.size else 0.0

    def _spread(self, judgement: Judgement, truth: Bools, most: int) -> Bools:
        """Return the truth values of a judgement at `most` instants, (most, traces).

        `truth` is `judgement.holds` or `judgement.fails`. If the judgement has `most` instants, `truth` is
        returned unchanged. Otherwise one truth value per trace is repeated `most` times. For `holds`, this
        value is True if the requirement holds at all of its own instants. For `fails`, this value is True if
        the requirement fails at any of them.
        """
        if judgement.instants == most:
            return truth
        once = truth.all(axis=0) if truth is judgement.holds else truth.any(axis=0)
        return np.broadcast_to(once, (most, self.traces))

    @property
    def satisfied_traces(self) -> int:
        """Number of traces that satisfy every requirement at all its instants."""
        return self.statuses.count("satisfied")


def beside(moment: str, start: str) -> str:
    """Return the text of an instant, followed by the start of its window if that is different.

    Example: `t = 4.6 s (window from 2 s)`.
    """
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
