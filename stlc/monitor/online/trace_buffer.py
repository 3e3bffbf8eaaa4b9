"""Buffer of the latest samples of a stream, from which causes of violations are found.

The cause of a violation is found and stored before the samples that show it are dropped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.pipeline import Compiled, CompiledRequirement
from stlc.monitor.explain.report import Cause, cause_of
from stlc.monitor.instants import rule_bounds, span_of
from stlc.monitor.judgement import RequirementVerdict
from stlc.monitor.online.history import ColumnHistory, Floats
from stlc.monitor.online.tally import RequirementSummary
from stlc.monitor.prefix_bounds import FAR
from stlc.monitor.prepared import Part, Prepared
from stlc.monitor.signals import Signals
from stlc.monitor.values import Ends, Record

_MOST = 1 << 21
"""Fewest numbers stored, at most twice as many; causes are computed before samples are dropped."""


@dataclass(slots=True)
class TraceBuffer:
    """Buffer of the latest samples of a stream, and of causes of violations.

    `t0` is the time of the first sample in seconds, `ends` the treatment of windows beyond the end; for
    `tolerance` see `RequirementVerdict`.
    """

    compiled: Compiled
    t0: float
    ends: Ends
    tolerance: float
    _history: ColumnHistory = field(default_factory=ColumnHistory)
    _found: dict[str, dict[tuple[int, float], Cause]] = field(default_factory=dict)
    _width: int = 1

    def take(self, columns: Mapping[str, Floats]) -> None:
        """Store samples: arrays (count, 1) by signal name."""
        self._width = len(columns)
        self._history.take(columns)

    @property
    def full(self) -> bool:
        """True if the buffer is full, so that `forget` must be called."""
        return (self._history.samples - self._history.first) * self._width > 2 * _MOST

    def forget(self) -> None:
        """Drop the older half of the samples; the causes that they show have been found before."""
        self._history.forget(self._history.samples - _MOST // self._width)

    def cause(self, rule: CompiledRequirement, worst: RequirementSummary) -> Cause | None:
        """Return the cause of the worst violation of the requirement `rule`, at the instant `worst.high_at`.

        None if the samples that show the violation were dropped before the cause was found.
        """
        key = worst.high_at, worst.high
        if known := self._found.get(rule.name, {}).get(key):
            return known
        excerpt = self._excerpt(rule, worst.high_at)
        if excerpt is None:
            return None
        first, start, env = excerpt
        record, grid = Record.of(env), self.compiled.grid
        low, high = rule_bounds(rule, record, range(start, start + 1), grid.horizon, self.ends)
        if first and high[0, 0] != worst.high:
            return None
        step = None if grid.dt is None else float(grid.dt)
        signals = Signals(env, (), record.samples, NUMPY, dt=step, t0=self.t0 + first * (step or 0.0))
        fails = np.ones((1, 1), dtype=np.bool_)
        subject, part = Prepared(self.compiled, (rule,), signals, record), Part(0, record.samples)
        judged = (rule, start, low, high, ~fails, fails, (), part, subject.timeline, self.tolerance)
        cause = cause_of(RequirementVerdict(*judged, ends=self.ends, subject=subject))
        if cause is None:
            return None
        sample = first + cause.sample
        time = float(sample) if step is None else self.t0 + sample * step
        violated = first + cause.violated
        found = replace(cause, start=worst.high_at, sample=sample, time=time, violated=violated, first=first)
        self._found[rule.name] = {key: found}
        return found

    def _excerpt(self, rule: CompiledRequirement, at: int) -> tuple[int, int, dict[str, Floats]] | None:
        """Return (first sample, instant to explain, signals) of an excerpt that explains a violation at `at`.

        The instant is counted from the first sample. None if needed samples were dropped.
        """
        history, top = self._history, rule.lowered
        whole = replace(rule, formula=top, reach=top.reach.future)
        past, future = span_of(whole, self.compiled.grid.horizon)
        if future < FAR:
            start, first, stop = at, max(at - past, 0), at + future + 1
        elif not history.first:
            return 0, at, history.columns()
        elif isinstance(top, ir.Temporal) and top.op == "always" and not top.body.endless:
            first, stop = history.first, history.samples
            start = max(at, first + past)
        else:
            return None
        if first < history.first or start >= history.samples or (first and self.compiled.grid.dt is None):
            return None
        return first, start - first, history.columns(first, stop)
