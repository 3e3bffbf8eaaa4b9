"""Requirements to watch, and running summaries of them: verdict, least robustness and where it occurs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from stlc.compile.pipeline import CompiledRequirement
from stlc.compile.semantics.tolerance import TOLERANCE, StatusInScope
from stlc.monitor.instants import live_bounds, rule_bounds, span_of
from stlc.monitor.online.history import Floats
from stlc.monitor.prefix_bounds import FAR
from stlc.monitor.values import Ends, Record

Flags = NDArray[np.bool_]


@final
@dataclass(frozen=True)
class Asked:
    """Requirement to watch.

    Attributes:
        rules: the requirement, and that whose robustness decides the verdict if it is another.
        begin: the first start.
        everywhere: whether every later sample is a start, too.
        horizon: length of a planning window in steps; None if unknown.
        ending: whether the end of the trace cuts windows.
        tolerance: a requirement is satisfied if its robustness is at least minus this value.
    """

    rules: Sequence[CompiledRequirement]
    begin: int
    everywhere: bool
    horizon: int | None
    ending: Ends = "open"
    tolerance: float = TOLERANCE

    @property
    def rule(self) -> CompiledRequirement:
        """The requirement."""
        return self.rules[0]

    @property
    def lag(self) -> int:
        """Samples after a start until its windows are complete."""
        if not self.everywhere:
            return 0
        return (self.horizon or 0) if self.rule.windowed else self.rule.reach

    def starts(self, first: int, samples: int) -> range:
        """Starts from `first` on in a trace of `samples` samples."""
        return range(first, samples if self.everywhere else min(self.begin + 1, samples))

    span = cached_property(lambda self: span_of(self.rule, self.horizon))
    """Samples before and after a start that its value may depend on; see `span_of`."""

    def settled(self, samples: int) -> int:
        """The first instant at which a sample after `samples` of them may change the value."""
        return max(samples - self.span.future, 0)

    def needs(self, start: int) -> int:
        """The first sample that instants from `start` on read."""
        return 0 if self.span.future == FAR else max(start - self.span.past, 0)

    def bounds(self, signals: Mapping[str, Floats], starts: range, *, ended: bool = False) -> Floats:
        """Least and greatest robustness of each of `rules` in turn, (instants, 2 or 4).

        The bounds are over all continuations; `ended`: the trace ends with the last sample. The samples of a
        signal, (samples, 1), include all that `starts` read.
        """
        bounds, record = rule_bounds if ended else live_bounds, Record.of(signals)
        found = (bounds(rule, record, starts, self.horizon, self.ending) for rule in self.rules)
        return np.concatenate([end for ends in found for end in ends], axis=1)

    def judged(self, bounds: Floats) -> JudgedInstants:
        """Verdicts from bounds on the robustness and on that which decides, (instants, 2 or 4)."""
        (low, high), (least, most) = bounds.T[:2], bounds.T[-2:]
        return JudgedInstants(
            low, high, TOLERANCE.satisfied(least, self.tolerance), TOLERANCE.violated(most, self.tolerance)
        )


class JudgedInstants(NamedTuple):
    """Bounds on the robustness and verdicts at consecutive instants, (instants,) each.

    The requirement certainly `holds` or `fails` if it does so for all samples that may follow.
    """

    low: Floats
    high: Floats
    holds: Flags
    fails: Flags


@final
@dataclass(frozen=True, slots=True)
class RequirementSummary:
    """Summary of a requirement at consecutive instants of one trace.

    Attributes:
        instants: number of counted instants.
        holds: number of instants at which the requirement is certainly satisfied.
        fails: number of instants at which the requirement is certainly violated.
        low_at: instant of `low`.
        high_at: instant of `high`.
        low: minimum over the instants of the least robustness over all continuations; +inf if there are no
            instants.
        high: minimum over the instants of the greatest robustness over all continuations.
        last: bounds on the robustness at the instant that was counted last; +inf if there are no instants.
        first: the first counted instant.
    """

    instants: int = 0
    holds: int = 0
    fails: int = 0
    low_at: int = 0
    high_at: int = 0
    low: float = math.inf
    high: float = math.inf
    last: tuple[float, float] = (math.inf, math.inf)
    first: int = 0

    def with_more(self, judged: JudgedInstants, count: int | None = None) -> RequirementSummary:
        """Return a copy with the first `count` instants (None: all), which follow those already counted."""
        low, high, holds, fails = (part[:count] for part in judged)
        if not len(low):
            return self
        least, low_at, most, high_at = self.low, self.low_at, self.high, self.high_at
        if (lowest := float(low[at := int(low.argmin())])) < least:
            least, low_at = lowest, self.next + at
        if (lowest := float(high[at := int(high.argmin())])) < most:
            most, high_at = lowest, self.next + at
        last = float(low[-1]), float(high[-1])
        known = int(np.count_nonzero(holds)), int(np.count_nonzero(fails))
        counts = self.instants + len(low), self.holds + known[0], self.fails + known[1]
        return RequirementSummary(*counts, low_at, high_at, least, most, last, self.first)

    @property
    def next(self) -> int:
        """The instant after the last counted one."""
        return self.first + self.instants

    @property
    def status(self) -> StatusInScope:
        """Violated if violated at any counted instant, satisfied if satisfied at all, else inconclusive."""
        return TOLERANCE.status(self.fails > 0, 0 < self.instants == self.holds)

    @property
    def robustness(self) -> float:
        """The least robustness over the counted instants.

        If it is not known exactly, `low` is returned for a satisfied requirement, `high` for a violated one,
        and NaN if the verdict is inconclusive.
        """
        if self.low == self.high or self.status == "satisfied":
            return self.low
        return self.high if self.status == "violated" else math.nan
