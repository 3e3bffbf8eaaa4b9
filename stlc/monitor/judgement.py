"""What a monitor says: per requirement and over all, per trace and over all."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.pipeline import CompiledRequirement
from stlc.diagnostics import Diagnostic, UsageError
from stlc.monitor.prepared import Prepared
from stlc.registry import closest

Status: TypeAlias = Literal["satisfied", "violated", "inconclusive", "out of scope"]
Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Judgement:
    """One requirement on one or many traces.

    Attributes:
        rule: the requirement.
        start: the first judged sample; the others follow one by one.
        low: least robustness over all continuations of the traces, (instants, traces).
        high: greatest robustness; the array `low` itself where nothing is unknown.
        holds: certainly satisfied, (instants, traces).
        fails: certainly violated, (instants, traces).
        shape: of the signals before their time axis; () for a single trace.
        scope: which traces the assumptions allow, (traces,); None means all. Others count for nothing.
        told: `low` and `high` in the semantics that was asked for; None: the exact ones.
    """

    rule: CompiledRequirement
    start: int
    low: Floats = field(repr=False)
    high: Floats = field(repr=False)
    holds: Bools = field(repr=False)
    fails: Bools = field(repr=False)
    shape: tuple[int, ...]
    scope: Bools | None = field(default=None, repr=False)
    told: tuple[Floats, Floats] | None = field(default=None, repr=False)

    @property
    def margins(self) -> tuple[Floats, Floats]:
        """Least and greatest robustness in the semantics that was asked for, each (instants, traces)."""
        return (self.low, self.high) if self.told is None else self.told

    @property
    def name(self) -> str:
        """Of the requirement."""
        return self.rule.name

    @property
    def unit(self) -> str:
        """Of the robustness: that of what is compared; "" where there are several."""
        return self.rule.unit

    @property
    def statuses(self) -> list[Status]:
        """One for each trace."""
        inside = np.ones(self.holds.shape[1], dtype=bool) if self.scope is None else self.scope
        return [
            _status(bool(fails.any()), bool(holds.all())) if counts else "out of scope"
            for fails, holds, counts in zip(self.fails.T, self.holds.T, inside, strict=True)
        ]

    def counted(self, values: NDArray[Any]) -> NDArray[Any]:
        """Of values (…, traces) those of the traces that count."""
        return values if self.scope is None else values[..., self.scope]

    @property
    def status(self) -> Any:
        """`satisfied`, `violated` or `inconclusive`; an array of them for a batch."""
        return _shaped(np.array(self.statuses), self.shape)

    @property
    def overall(self) -> Status:
        """Over all traces: violated if one is, satisfied if all are."""
        holds = self.counted(self.holds)
        return _status(bool(self.counted(self.fails).any()), bool(holds.size and holds.all()))

    @property
    def satisfied(self) -> bool | None:
        """Over all traces: True, False, or None where that is not known."""
        return _known(self.overall)

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Both ends of the robustness over all continuations, the least over the judged instants."""
        low, high = self.margins
        return _shaped(low.min(axis=0), self.shape), _shaped(high.min(axis=0), self.shape)

    @property
    def robustness(self) -> Any:
        """The least over the judged instants; a float, or an array for a batch.

        Where a trace is too short to say: the known bound if the verdict follows from it, else NaN.
        """
        return _shaped(self.least, self.shape)

    @property
    def least(self) -> Floats:
        """`robustness` as an array (traces,)."""
        low, high = (end.min(axis=0) for end in self.margins)
        known = np.where(self.holds.all(axis=0), low, np.nan)
        known = np.where(self.fails.any(axis=0), high, known)
        return np.where(low == high, low, known)

    @property
    def share(self) -> float:
        """Share of the judged instants of all traces at which it certainly holds."""
        holds = self.counted(self.holds)
        return float(holds.mean()) if holds.size else 0.0

    @property
    def instants(self) -> int:
        """How many instants were judged in each trace."""
        return len(self.low)

    @property
    def worst(self) -> tuple[int, int]:
        """(trace, sample) of the least robustness; of a violation where there is one."""
        values = self.high if self.counted(self.fails).any() else self.low
        if self.scope is not None and self.scope.any():
            values = np.where(self.scope, values, np.inf)
        instant, trace = np.unravel_index(int(np.argmin(values)), values.shape)
        return int(trace), self.start + int(instant)


@dataclass(frozen=True, slots=True)
class Verdict:
    """All requirements of a specification on one or many traces.

    Attributes:
        requirements: one judgement each, in the order of the specification.
        subject: what was judged.
    """

    requirements: tuple[Judgement, ...]
    subject: Prepared = field(repr=False)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the signals before their time axis; () for a single trace."""
        return self.subject.signals.shape

    def __getitem__(self, name: str) -> Judgement:
        """The judgement of one requirement. Raises UsageError (U101) for an unknown name."""
        for judgement in self.requirements:
            if judgement.name == name:
                return judgement
        raise unknown_requirement(name, [judgement.name for judgement in self.requirements])

    def __iter__(self) -> Iterator[Judgement]:
        return iter(self.requirements)

    @property
    def traces(self) -> int:
        """How many traces were judged."""
        return self.subject.signals.batch

    @property
    def statuses(self) -> list[Status]:
        """One for each trace: violated if a requirement is, satisfied if all are."""
        rows = [judgement.statuses for judgement in self.requirements]
        return [
            "out of scope"
            if "out of scope" in column
            else _status("violated" in column, {*column} <= {"satisfied"})
            for column in zip(*rows, strict=True)
        ]

    @property
    def status(self) -> Any:
        """`satisfied`, `violated` or `inconclusive`; an array of them for a batch."""
        return _shaped(np.array(self.statuses), self.shape)

    def within(self, scope: Bools) -> Verdict:
        """The same where only the traces that the assumptions allow count, (traces,)."""
        if scope.all():
            return self
        return replace(self, requirements=tuple(replace(j, scope=scope) for j in self.requirements))

    @property
    def in_scope(self) -> int:
        """How many traces the assumptions allow."""
        scope = self.requirements[0].scope
        return self.traces if scope is None else int(scope.sum())

    @property
    def overall(self) -> Status:
        """Over all traces and requirements."""
        found = {judgement.overall for judgement in self.requirements}
        return _status("violated" in found, found <= {"satisfied"})

    @property
    def satisfied(self) -> bool | None:
        """Over all traces and requirements: True, False, or None where that is not known."""
        return _known(self.overall)

    @property
    def robustness(self) -> Any:
        """The least `weight * robustness / scale` over the requirements; a float, or an array for a batch."""
        rows = [j.least[None] * (j.rule.weight / j.rule.scale) for j in self.requirements]
        return _shaped(self.subject.record.semantics.join(rows, "min", NUMPY)[0], self.shape)

    @property
    def share(self) -> float:
        """Share of the instants of all traces at which all requirements certainly hold.

        Requirements that are judged once hold, or not, at every instant.
        """
        most = self._most_instants
        return self._mean(np.logical_and.reduce([self._spread(j, j.holds, most) for j in self.requirements]))

    @property
    def failed_share(self) -> float:
        """Share of the instants of all traces at which a requirement is certainly violated."""
        most = self._most_instants
        return self._mean(np.logical_or.reduce([self._spread(j, j.fails, most) for j in self.requirements]))

    @property
    def _most_instants(self) -> int:
        """Of the requirement that has most of them."""
        return max(judgement.instants for judgement in self.requirements)

    def _mean(self, truth: Bools) -> float:
        counted = self.requirements[0].counted(truth)
        return float(counted.mean()) if counted.size else 0.0

    def _spread(self, judgement: Judgement, truth: Bools, most: int) -> Bools:
        """At as many instants as the requirement that has most of them: (instants, traces)."""
        if judgement.instants == most:
            return truth
        once = truth.all(axis=0) if truth is judgement.holds else truth.any(axis=0)
        return np.broadcast_to(once, (most, self.traces))

    @property
    def satisfied_traces(self) -> int:
        """How many traces satisfy every requirement at all its instants."""
        return self.statuses.count("satisfied")


def unknown_requirement(name: str, names: list[str]) -> UsageError:
    """U101: no requirement is called `name`."""
    near = closest(name, names)
    help_ = (f"did you mean `{near}`?",) if near else ()
    note = (f"requirements: {', '.join(names)}",)
    return UsageError(Diagnostic("U101", f"there is no requirement `{name}`", help=help_, note=note))


def _status(violated: bool, satisfied: bool) -> Status:
    return "violated" if violated else "satisfied" if satisfied else "inconclusive"


def _together(statuses: tuple[Status, ...]) -> Status:
    """Of all requirements on one trace."""
    if "out of scope" in statuses:
        return "out of scope"
    return _status("violated" in statuses, {*statuses} <= {"satisfied"})


def _known(status: Status) -> bool | None:
    return None if status == "inconclusive" else status == "satisfied"


def _shaped(values: NDArray[Any], shape: tuple[int, ...]) -> Any:
    return values.reshape(shape) if shape else values.reshape(()).item()
