"""What is kept of a stream to explain a violation: the samples around the worst start of a requirement."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stlc.compile import ir
from stlc.compile.ops_numpy import NUMPY
from stlc.compile.pipeline import Compiled, Rule
from stlc.monitor.asked import Floats
from stlc.monitor.explain import Cause, explain
from stlc.monitor.instants import rule_bounds, window_of
from stlc.monitor.judgement import Judgement, Verdict
from stlc.monitor.prepared import Prepared
from stlc.monitor.signals import Signals
from stlc.monitor.streams import endless, looks_on
from stlc.monitor.values import Record, history

_MOST = 1_000_000
"""Samples around a start that are kept at most: what reads more is not explained."""


@dataclass(frozen=True, slots=True)
class Excerpt:
    """Consecutive samples, and where in them a requirement is judged.

    Attributes:
        first: number of the first sample.
        start: number of the sample from which on the excerpt says why the requirement is violated.
        env: columns (samples, 1).
        begin: the sample at which it was judged, where that is an earlier one.
    """

    first: int
    start: int
    env: Mapping[str, Floats]
    begin: int | None = None


@dataclass(slots=True)
class Recall:
    """The last samples, and excerpts of those around violated starts.

    Attributes:
        compiled: the specification.
        rules: the requirements that are judged.
        t0: time of the first sample in seconds.
    """

    compiled: Compiled
    rules: Sequence[Rule]
    t0: float
    samples: int = 0
    _reads: dict[str, tuple[int, int]] = field(default_factory=dict)
    _span: int = 0
    _pieces: deque[tuple[int, Mapping[str, Floats]]] = field(default_factory=deque)
    _excerpts: dict[str, Excerpt] = field(default_factory=dict)
    _worst: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for rule in self.rules:
            reads = _around(rule, self.compiled.grid.horizon)
            if reads is not None and sum(reads) < _MOST:
                self._reads[rule.name] = reads
        self._span = max((back + ahead + 2 for back, ahead in self._reads.values()), default=0)

    def take(self, columns: Mapping[str, Floats], count: int) -> None:
        """Keep samples, as long as a start may still be explained by them."""
        self._pieces.append((self.samples, columns))
        self.samples += count
        while len(self._pieces) > 1 and self._pieces[1][0] <= self.samples - count - self._span:
            self._pieces.popleft()

    def note(self, rule: Rule, start: int) -> None:
        """Keep what says why a requirement is violated at a start that was just counted."""
        if rule.name not in self._reads or endless_always(rule):
            return
        back, ahead = self._reads[rule.name]
        first = max(start - back, 0)
        if first >= self._pieces[0][0]:
            self._excerpts[rule.name] = Excerpt(first, start, self._cut(first, start + ahead + 1))

    def note_last(self, rule: Rule, begin: int, high: float) -> None:
        """The same for what has to hold to the end of the stream, where it fails by more than ever before."""
        known = self._worst.get(rule.name, math.inf)
        if rule.name not in self._reads or high >= known or not endless_always(rule):
            return
        first = self._pieces[0][0]
        start = max(first + self._reads[rule.name][0] if first else 0, begin)
        self._worst[rule.name] = high
        self._excerpts[rule.name] = Excerpt(first, start, self._cut(first, self.samples), begin)

    def cause(self, rule: Rule) -> Cause | None:
        """Why a requirement is violated; None where the samples that say it were not kept."""
        found = self._excerpts.get(rule.name)
        dt = self.compiled.grid.dt
        if found is None or (dt is None and found.first):
            return None
        record, start = Record(found.env, NUMPY), found.start - found.first
        horizon = self.compiled.grid.horizon
        if start >= record.samples:
            return None
        low, high = rule_bounds(rule, record, range(start, start + 1), horizon, "open")
        if endless_always(rule) and high[0, 0] >= 0:
            return None
        step = None if dt is None else float(dt)
        t0 = self.t0 + found.first * (step or 0.0)
        signals = Signals(found.env, (), record.samples, NUMPY, dt=step, t0=t0)
        fails = np.ones((1, 1), dtype=np.bool_)
        judgement = Judgement(rule, start, low, high, ~fails, fails, ())
        cause = explain(Verdict((judgement,), Prepared(self.compiled, (rule,), signals, record)), rule.name)
        if cause is None:
            return None
        sample = found.first + cause.sample
        begun = found.start if found.begin is None else found.begin
        time = float(sample) if step is None else self.t0 + sample * step
        return replace(cause, start=begun, sample=sample, time=time)

    def _cut(self, first: int, stop: int) -> dict[str, Floats]:
        """Columns from one sample to another one, as far as they are there."""
        names = self._pieces[0][1]
        parts = [
            (max(first - begin, 0), stop - begin, columns)
            for begin, columns in self._pieces
            if begin < stop and begin + len(next(iter(columns.values()))) > first
        ]
        return {
            name: np.concatenate([columns[name][low:high] for low, high, columns in parts]) for name in names
        }


def endless_always(rule: Rule) -> bool:
    """Whether a requirement says that something bounded holds at all samples from one on."""
    formula = rule.formula
    return (
        isinstance(formula, ir.Over)
        and formula.op == "always"
        and formula.window.hi is None
        and not rule.windowed
        and not endless(formula.body)
    )


def _around(rule: Rule, horizon: int | None) -> tuple[int, int] | None:
    """How many samples before and after a start say why it fails; None where no number does."""
    formula = rule.formula
    window = window_of(rule, horizon)
    if rule.absolute or (window is None and endless(formula) and not endless_always(rule)):
        return None
    return history(formula), max(rule.reach, window or 0) + looks_on(formula)
