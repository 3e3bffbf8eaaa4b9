"""Evaluation of requirements with wide windows in a stream, at a bounded cost per sample.

Unsettled instants are recomputed at every evaluation: with narrow windows after every sample, with wide ones
after so many samples that the cost per sample stays bounded. A window that is wider than the stream is long
reads nothing beyond the samples so far, so it is cut to a few times their number, and lengthened as the
stream grows: memory follows the samples taken in, not the width of the windows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Reach, farthest, reach
from stlc.compile.ir.traverse import map_children, nodes, operands
from stlc.compile.pipeline import CompiledRequirement
from stlc.monitor.online.bounds import Bounds, Floats, Tracker
from stlc.monitor.online.streams import endless

WIDE = 1 << 13
"""Rows of windows that are evaluated after every sample."""

MOST = 1 << 26
"""Greatest number of rows evaluated at once because every instant has windows of its own."""

_LATE = 8
"""Inverse of the greatest delay of a verdict, as a share of the samples that the requirement spans."""

_GROWN = 2
"""Factor by which cut windows are lengthened at a time."""

_SHORT = 1 << 9
"""Initial length of cut windows in samples."""

_NARROW = 1 << 12
"""Greatest span in samples of windows of one direction where those of the other are cut."""

_FROZEN = 500
"""Overhead of one instant of a `freeze`, in rows, without its body."""


# ---------------------------------------------------------------------------- measures


def span(formula: ir.Formula) -> Reach:
    """Lookback and lookahead of the bounded windows of a formula, in samples."""
    inner = [span(part) for part in operands(formula)]
    past, future = (
        max((each.past for each in inner), default=0),
        max((each.future for each in inner), default=0),
    )
    match formula:
        case ir.Temporal(window=window) | ir.Until(window=window):
            return Reach(past, future + _width(window))
        case ir.PastTemporal(window=window) | ir.Since(window=window):
            return Reach(past + _width(window), future)
        case ir.Shift(steps=steps):
            return Reach(past + max(-steps, 0), future + max(steps, 0))
        case ir.Predicate(num=num):
            return farthest(num)
        case ir.Freeze(bindings=bindings):
            reads = [farthest(num) for _, num in bindings]
            return Reach(past + max(r.past for r in reads), future + max(r.future for r in reads))
    return Reach(past, future)


def _width(window: ir.Window) -> int:
    return window.lo if window.hi is None else window.hi


@dataclass(frozen=True, slots=True)
class PacedWork:
    """Number of rows computed for one evaluation of a formula.

    Attributes:
        rows: all of them.
        own: those not shared between instants: of a `freeze`.
        heaviest: the formula that needs most of these.
    """

    rows: int = 0
    own: int = 0
    heaviest: ir.Formula | None = None

    def and_(self, other: PacedWork) -> PacedWork:
        """The sum of both."""
        heaviest = self.heaviest if self.own >= other.own else other.heaviest
        return PacedWork(self.rows + other.rows, self.own + other.own, heaviest)


def work(formula: ir.Formula, instants: int, samples: int = 0) -> PacedWork:
    """The work of evaluating a formula at several instants.

    Args:
        formula: to evaluate.
        instants: how many.
        samples: width of an unbounded window.
    """
    match formula:
        case ir.Freeze(body=body):
            looks = sum(span(body)) + (samples if _endless(body) else 0)
            own = instants * (_FROZEN + looks + work(body, 1, samples).rows)
            return PacedWork(own, own, formula)
        case ir.AtStart():
            instants = 1
        case ir.Temporal(window=window) | ir.PastTemporal(window=window):
            instants += samples if window.hi is None else window.hi - window.lo
        case ir.Until(window=window) | ir.Since(window=window):
            instants += samples if window.hi is None else window.hi
    windows = isinstance(formula, (ir.Temporal, ir.PastTemporal, ir.Until, ir.Since))
    found = PacedWork(instants if windows else 0)
    for part in operands(formula):
        found = found.and_(work(part, instants, samples))
    return found


def _endless(formula: ir.Formula) -> bool:
    windows = (getattr(node, "window", None) for node in nodes(formula))
    return any(window is not None and window.hi is None for window in windows)


# ------------------------------------------------------------------------------ cutting


def cut(formula: ir.Formula, samples: int) -> ir.Formula:
    """A formula of equal value as long as a stream has no more than `samples` samples.

    Beyond the last sample only bounded past windows and shifts still read known values; further on, all
    instants are alike. Future windows are cut where past ones are narrow, else past windows where future ones
    are narrow; if both are wide, the formula is unchanged.
    """
    past, future = span(formula)
    slack = sum(1 for _ in nodes(formula))
    if past <= _NARROW:
        return _cut(formula, (samples + past + slack, None))
    if future <= _NARROW:
        return _cut(formula, (None, samples + future + slack))
    return formula


_Most: TypeAlias = tuple[int | None, int | None]
"""The longest window of the future, and of the past."""


def _cut(formula: ir.Formula, most: _Most) -> ir.Formula:
    ahead, back = most
    match formula:
        case ir.Freeze() | ir.AtStart():
            return formula
        case ir.Temporal(window=window) | ir.Until(window=window):
            formula = replace(formula, window=_shorter(window, ahead))
        case ir.PastTemporal(window=window) | ir.Since(window=window):
            formula = replace(formula, window=_shorter(window, back))
        case ir.Shift(steps=steps):
            if steps > 0 and ahead is not None:
                steps = min(steps, ahead)
            if steps < 0 and back is not None:
                steps = max(steps, -back)
            formula = replace(formula, steps=steps)
    return map_children(formula, formulas=lambda part: _cut(part, most))


def _shorter(window: ir.Window, most: int | None) -> ir.Window:
    if most is None:
        return window
    return ir.Window(min(window.lo, most), None if window.hi is None else min(window.hi, most))


# ------------------------------------------------------------------------------- pacing


class Asking(Protocol):
    """Evaluation options of a requirement; see `PacedTracker`."""

    everywhere: bool
    all_kept: bool
    window: int | None


def effort(formula: ir.Formula, looks: int, asking: Asking) -> PacedWork:
    """The work of evaluating once a requirement that spans so many samples."""
    many = asking.everywhere or endless(formula) or any(map(_unbounded, nodes(formula)))
    found = work(formula, looks if many else 1, looks if asking.all_kept else 0)
    if asking.window is None:
        return found
    own = asking.window * (looks if asking.everywhere else 1)
    return found.and_(PacedWork(own, own, formula))


def _unbounded(node: ir.Formula) -> bool:
    return isinstance(node, (ir.PastTemporal, ir.Since)) and node.window.hi is None


Make: TypeAlias = Callable[[CompiledRequirement], Tracker]


@dataclass(slots=True)
class PacedTracker:
    """Tracker of a requirement that is evaluated only after some of the samples.

    Attributes:
        rule: the requirement.
        make: its tracker, or that of the requirement with shorter windows.
        everywhere: it is evaluated at every instant, and not only at the first one.
        all_kept: all samples are stored for it, and all of them read.
        window: number of samples from each instant to the end of its record, where that is fixed.
        samples: number of samples taken in.
    """

    rule: CompiledRequirement
    make: Make
    everywhere: bool
    all_kept: bool
    window: int | None = None
    samples: int = 0
    _inner: Tracker | None = None
    _most: int | None = 0
    _pace: int = 1

    def due(self, samples: int) -> bool:
        """True if it is due for evaluation after so many samples."""
        return samples - self.samples >= self._pace

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Take in new samples."""
        if self._most is not None and samples > self._most:
            self._lengthen(samples)
        assert self._inner is not None
        self._inner.grow(signals, first, samples)
        self.samples = samples
        self._pace = self._paced(samples)

    def _lengthen(self, samples: int) -> None:
        most = max(samples, _SHORT) * _GROWN
        formula = cut(self.rule.formula, most)
        if formula == self.rule.formula:
            self._most, self._inner = None, self.make(self.rule)
        else:
            shorter = replace(self.rule, formula=formula, reach=reach(formula).future)
            self._most, self._inner = most, self.make(shorter)

    def _paced(self, samples: int) -> int:
        whole = sum(span(self.rule.formula)) + (self.window or 0)
        looks = samples if self.all_kept else min(self._most or samples, whole)
        formula = self.rule.formula if self._most is None else cut(self.rule.formula, self._most)
        rows = effort(formula, looks, self).rows
        return max(min(rows // WIDE, min(samples, looks) // _LATE), 1)

    @property
    def settled(self) -> int:
        """The first instant whose value may still change."""
        assert self._inner is not None
        return self._inner.settled

    def live(self, start: int, stop: int) -> Bounds:
        """Bounds over all continuations."""
        assert self._inner is not None
        return self._inner.live(start, stop)

    def ended(self, starts: range) -> Bounds:
        """Bounds at the end of the trace."""
        assert self._inner is not None
        return self._inner.ended(starts)

    def drop(self, start: int) -> int:
        """Forget instants before `start`; all samples are needed while windows are cut."""
        assert self._inner is not None
        needed = self._inner.drop(start)
        return needed if self._most is None else 0
