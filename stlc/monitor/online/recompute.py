"""Evaluation of a requirement anew after each sample, where there are no transducers (`kernel.py`).

The evaluator of recordings runs over the samples that the undecided instants read. It is used without a C
compiler, for `freeze`, for windows to the end of the trace inside of other windows, and for planning windows
whose end moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import endless, farthest, history, reach, uses_end
from stlc.compile.ir.traverse import map_children, numbers, operands
from stlc.compile.pipeline import CompiledRequirement
from stlc.diagnostics import Diagnostic, UsageError
from stlc.monitor.instants import cut_bounds, growing_bounds, rule_bounds, window_of
from stlc.monitor.online.history import Floats
from stlc.monitor.prefix_bounds import own_span, prefix_bound, with_seen
from stlc.monitor.values import Ends, Record

MOST = 1 << 26
"""Greatest number of values at a time that only one instant reads."""

_FROZEN = 500
"""Overhead of one instant of a `freeze`, in values."""

_NARROW = 1 << 13
"""Samples that are evaluated anew after each new one; more of them when an eighth is new."""


@dataclass(slots=True)
class RecomputeTracker:
    """Bounds on a requirement at instants of a growing trace, from all samples that it reads.

    Attributes:
        rule: the requirement.
        horizon: length of a planning window in steps; None if unknown.
        ending: whether the end of the trace cuts windows.
        samples: number of samples received.
    """

    rule: CompiledRequirement
    horizon: int | None
    ending: Ends
    samples: int = 0
    window: int | None = field(init=False)
    _first: int = 0
    _signals: Mapping[str, Floats] = field(default_factory=dict)
    _bounds: tuple[ir.Formula, ir.Formula] = field(init=False)

    def __post_init__(self) -> None:
        self.window, cut = window_of(self.rule, self.horizon), self.ending == "truncate"
        formula = self.rule.formula
        self._bounds = formula, formula
        if self.window is None or cut:
            self._bounds = prefix_bound(formula, "lower", cut=cut), prefix_bound(formula, "upper", cut=cut)

    @property
    def settled(self) -> int:
        """The first instant at which a later sample may change the value."""
        if self.window is None and endless(self.rule.formula):
            return 0
        ahead = self.rule.reach if self.window is None else self.window
        later = max((farthest(num).future for num in numbers(self.rule.formula)), default=0)
        return max(self.samples - ahead - later, 0)

    def needs(self, start: int) -> int:
        """The first sample that instants from `start` on read."""
        lasting = self.rule.absolute or (self.window is None and endless(self.rule.formula))
        return 0 if lasting else max(start - history(self.rule.formula), 0)

    def due(self, samples: int) -> bool:
        """True if the requirement is to be evaluated now that `samples` samples were received."""
        return samples - self._first <= _NARROW or samples >= self.samples + (samples - self._first) // 8

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Take the samples from `first` on, (stored, traces) each; there are `samples` now."""
        self._signals, self._first, self.samples = signals, first, samples

    def live(self, starts: range) -> tuple[Floats, Floats]:
        """Least and greatest robustness over all continuations, (instants, traces) each."""
        middle = starts.start if self.ending == "open" else min(max(self.settled, starts.start), starts.stop)
        known, rest, parts = range(starts.start, middle), range(middle, starts.stop), []
        if known:
            record = Record.of(self._signals, NUMPY)
            parts.append(cut_bounds(self.rule, record, self._shifted(known), self.horizon, "truncate"))
        if rest:
            record = Record.of(with_seen(self._signals), NUMPY)
            parts.append(growing_bounds(*self._bounds, record, self._shifted(rest), self.window))
        low, high = (np.concatenate(ends) for ends in zip(*parts, strict=True))
        return low, high

    def ended(self, starts: range) -> tuple[Floats, Floats]:
        """Bounds if the trace ends with the last sample, (instants, traces) each."""
        record = Record.of(self._signals, NUMPY)
        low, high = rule_bounds(self.rule, record, self._shifted(starts), self.horizon, self.ending)
        return np.asarray(low), np.asarray(high)

    def _shifted(self, starts: range) -> range:
        return range(starts.start - self._first, starts.stop - self._first)


def require_bounded(rule: CompiledRequirement, window: int | None, *, everywhere: bool) -> None:
    """Check the work of one evaluation; `window` is the length of a planning window whose end moves.

    Raises:
        UsageError: E313, every instant reads too many values in a `freeze`, which no other instant reads.
    """
    many = _span(rule.formula) + (window or 0) if everywhere or endless(rule.formula) else 1
    work, heaviest = _own(rule.formula, many)
    if work > MOST:
        what = f"every instant keeps values of its own, and {work:,} samples to look at"
        message = f"a stream cannot judge `{rule.name}`: {what}"
        advice = ("shorten its intervals", "`stlc check SPEC TRACE` judges a recording")
        raise UsageError(Diagnostic("E313", message, heaviest.span or rule.span, help=advice))


def _span(formula: ir.Formula) -> int:
    """Samples that a formula reads around an instant; `[a, inf)` counts as `a` samples."""
    return sum(own_span(formula)) + max(map(_span, operands(formula)), default=0)


def _own(formula: ir.Formula, instants: int) -> tuple[int, ir.Formula]:
    """Values that only one of several instants reads, and the `freeze` that reads most of them."""
    if isinstance(formula, ir.Freeze):
        return instants * (_FROZEN + _span(formula.body) * sum(1 for _ in numbers(formula.body))), formula
    window = formula.window if isinstance(formula, ir.Windowed) else ir.Window(0, 0)
    inner = instants + (window.hi or 0) - window.lo if window.hi is not None else instants
    return max(
        (_own(part, inner) for part in operands(formula)), key=lambda own: own[0], default=(0, formula)
    )


def without_end(formula: ir.Formula, window: int) -> ir.Formula | None:
    """Return the formula with bounded windows in place of its windows up to `end`.

    `end` is the end of the planning window, `window` samples after each instant. None is returned where the
    bounded formula would have another value: `end` occurs inside another temporal operator or in `sweep`
    (motion between samples), or a bounded window extends beyond `end`.
    """

    def ended(part: ir.Formula) -> ir.Formula:
        if isinstance(part, ir.BoolOp):
            return map_children(part, formulas=ended)
        if isinstance(part, (ir.Temporal, ir.Until)) and part.window.hi is None and part.window.lo <= window:
            return replace(part, window=ir.Window(part.window.lo, window))
        return part

    moved = ended(formula)
    return None if uses_end(moved) or reach(moved).future > window else moved
