"""Buffer of the latest samples of a stream, from which causes of violations are found.

The cause of a violation is found and stored before the samples that show it are dropped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import history as lookback
from stlc.compile.ir.support import reach
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.monitor.explain.report import Cause, explain
from stlc.monitor.instants import rule_bounds, window_of
from stlc.monitor.judgement import Judgement, Prepared, Verdict
from stlc.monitor.online.bounds import Floats
from stlc.monitor.online.history import ColumnHistory
from stlc.monitor.online.streams import endless, looks_on
from stlc.monitor.signals import Signals
from stlc.monitor.values import Record

_MOST = 1 << 21
"""Fewest numbers stored, at most twice as many; causes are computed before samples are dropped."""


@dataclass(frozen=True, slots=True)
class Worst:
    """Worst violation of a requirement.

    Attributes:
        start: sample at which the requirement was evaluated.
        high: greatest robustness at `start` over all continuations of the trace.
    """

    start: int
    high: float


@dataclass(slots=True)
class TraceBuffer:
    """Buffer of the latest samples of a stream, and of causes of violations.

    The causes are found before the samples that show them are dropped.

    Attributes:
        compiled: the specification.
        t0: time of the first sample in seconds.
    """

    compiled: Compiled
    t0: float
    _history: ColumnHistory = field(default_factory=ColumnHistory)
    _found: dict[str, tuple[Worst, Cause]] = field(default_factory=dict)
    _width: int = 1

    def take(self, columns: Mapping[str, Floats], count: int) -> None:
        """Store `count` samples: arrays (count, 1) by signal name."""
        self._width = len(columns)
        self._history.take(columns, count)

    @property
    def full(self) -> bool:
        """True if the buffer is full, so that `forget` must be called."""
        return (self._history.samples - self._history.first) * self._width > 2 * _MOST

    def forget(self) -> None:
        """Drop the older half of the samples.

        To keep the cause of a violation that these samples show, call `remember` first.
        """
        self._history.forget(self._history.samples - _MOST // self._width)

    def remember(self, rule: CompiledRequirement, worst: Worst) -> None:
        """Find and store the cause of the violation `worst`.

        The samples that show the violation can then be dropped.
        """
        cause = self.cause(rule, worst)
        if cause is not None:
            self._found[rule.name] = worst, cause

    def cause(self, rule: CompiledRequirement, worst: Worst) -> Cause | None:
        """Return the cause of the violation `worst` of the requirement `rule`.

        None if the samples that show the violation were dropped before `remember` was called.
        """
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
        """Return an excerpt of the buffer that suffices to explain the violation `worst` of `rule`.

        Returns:
            Three values: the index in the trace of the first sample of the excerpt; the index in the excerpt
            of the instant at which to explain the violation; and the signals, name -> array (samples, 1).
            None if needed samples were dropped.
        """
        history = self._history
        formula, horizon = rule.lowered, self.compiled.grid.horizon
        reads = _around(rule, formula, horizon)
        if reads is None and history.first:
            formula = rule.formula
            reads = _around(rule, formula, horizon)
        if reads is None or _endless_always(rule, formula):
            if history.first == 0:
                return 0, worst.start, history.columns()
            if reads is None or self.compiled.grid.dt is None:
                return None
            start = max(history.first + reads[0], worst.start)
            return (
                (history.first, start - history.first, history.columns()) if start < history.samples else None
            )
        first = max(worst.start - reads[0], 0)
        if first < history.first or (first and self.compiled.grid.dt is None):
            return None
        return first, worst.start - first, history.columns(first, worst.start + reads[1] + 1)


def _endless_always(rule: CompiledRequirement, formula: ir.Formula) -> bool:
    """True if `formula` is an `always` over an unbounded window, and its body has only bounded windows.

    `formula` is the formula of the requirement `rule`. The result is False if the requirement is evaluated
    for every planning window.
    """
    return (
        isinstance(formula, ir.Temporal)
        and formula.op == "always"
        and formula.window.hi is None
        and not rule.windowed
        and not endless(formula.body)
    )


def _around(rule: CompiledRequirement, formula: ir.Formula, horizon: int | None) -> tuple[int, int] | None:
    """Return how many samples before and after an instant determine the value of `formula` there.

    `formula` is the formula of the requirement `rule`. `horizon` is the length of a planning window in steps.
    None is returned if either number is unbounded.
    """
    window = window_of(rule, horizon)
    if rule.absolute or (window is None and endless(formula) and not _endless_always(rule, formula)):
        return None
    return lookback(formula), max(reach(formula).future, window or 0) + looks_on(formula)
