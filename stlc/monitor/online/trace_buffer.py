"""What is kept of a stream to explain a violation: its last samples, and causes that lie before them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import history, reach
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.monitor.explain.report import Cause, explain
from stlc.monitor.instants import rule_bounds, window_of
from stlc.monitor.judgement import Judgement, Verdict
from stlc.monitor.online.bounds import Floats
from stlc.monitor.online.history import SampleHistory
from stlc.monitor.online.streams import endless, looks_on
from stlc.monitor.prepared import Prepared
from stlc.monitor.signals import Signals
from stlc.monitor.values import Record

_MOST = 1 << 21
"""Numbers that are kept at least, and twice as many at most; causes are worked out before samples go."""


@dataclass(frozen=True, slots=True)
class Worst:
    """The start at which a requirement is violated most.

    Attributes:
        start: its sample.
        high: its greatest robustness over all continuations.
    """

    start: int
    high: float


@dataclass(slots=True)
class TraceBuffer:
    """The last samples, and the causes that were found before samples were forgotten.

    Attributes:
        compiled: the specification.
        t0: time of the first sample in seconds.
    """

    compiled: Compiled
    t0: float
    _kept: SampleHistory = field(default_factory=SampleHistory)
    _found: dict[str, tuple[Worst, Cause]] = field(default_factory=dict)
    _wide: int = 1

    def take(self, columns: Mapping[str, Floats], count: int) -> None:
        """Keep samples."""
        self._wide = len(columns)
        self._kept.take(columns, count)

    @property
    def full(self) -> bool:
        """Whether samples have to be forgotten."""
        return (self._kept.samples - self._kept.first) * self._wide > 2 * _MOST

    def forget(self) -> None:
        """Forget the older half of the samples; causes that lie there have to be `remember`ed before."""
        self._kept.forget(self._kept.samples - _MOST // self._wide)

    def remember(self, rule: CompiledRequirement, worst: Worst) -> None:
        """Work out why a requirement is violated while the samples that say it are there."""
        cause = self.cause(rule, worst)
        if cause is not None:
            self._found[rule.name] = worst, cause

    def cause(self, rule: CompiledRequirement, worst: Worst) -> Cause | None:
        """Why a requirement is violated; None where the samples that say it are gone."""
        known = self._found.get(rule.name)
        if known is not None and known[0] == worst:
            return known[1]
        excerpt = self._excerpt(rule, worst)
        if excerpt is None:
            return None
        first, start, env = excerpt
        record = Record.of(env, NUMPY)
        low, high = rule_bounds(rule, record, range(start, start + 1), self.compiled.grid.horizon, "open")
        if first and high[0, 0] != worst.high:
            return None
        dt = self.compiled.grid.dt
        step = None if dt is None else float(dt)
        signals = Signals(env, (), record.samples, NUMPY, dt=step, t0=self.t0 + first * (step or 0.0))
        fails = np.ones((1, 1), dtype=np.bool_)
        judgement = Judgement(rule, start, low, high, ~fails, fails, ())
        cause = explain(Verdict((judgement,), Prepared(self.compiled, (rule,), signals, record)), rule.name)
        if cause is None:
            return None
        sample = first + cause.sample
        time = float(sample) if step is None else self.t0 + sample * step
        return replace(cause, start=worst.start, sample=sample, time=time)

    def _excerpt(self, rule: CompiledRequirement, worst: Worst) -> tuple[int, int, dict[str, Floats]] | None:
        """The number of the first sample, that of the start from there on, and columns (samples, 1)."""
        kept = self._kept
        formula, horizon = rule.lowered, self.compiled.grid.horizon
        reads = _around(rule, formula, horizon)
        if reads is None and kept.first:
            formula = rule.formula
            reads = _around(rule, formula, horizon)
        if reads is None or _endless_always(rule, formula):
            if kept.first == 0:
                return 0, worst.start, kept.columns()
            if reads is None or self.compiled.grid.dt is None:
                return None
            start = max(kept.first + reads[0], worst.start)
            return (kept.first, start - kept.first, kept.columns()) if start < kept.samples else None
        first = max(worst.start - reads[0], 0)
        if first < kept.first or (first and self.compiled.grid.dt is None):
            return None
        return first, worst.start - first, kept.columns(first, worst.start + reads[1] + 1)


def _endless_always(rule: CompiledRequirement, formula: ir.Formula) -> bool:
    """Whether a requirement says that something bounded holds at all samples from one on."""
    return (
        isinstance(formula, ir.Temporal)
        and formula.op == "always"
        and formula.window.hi is None
        and not rule.windowed
        and not endless(formula.body)
    )


def _around(rule: CompiledRequirement, formula: ir.Formula, horizon: int | None) -> tuple[int, int] | None:
    """How many samples before and after a start say why it fails; None where no number does.

    What is explained is the requirement as it is written: where one part decides, others are told, too.
    """
    window = window_of(rule, horizon)
    if rule.absolute or (window is None and endless(formula) and not _endless_always(rule, formula)):
        return None
    return history(formula), max(reach(formula).future, window or 0) + looks_on(formula)
