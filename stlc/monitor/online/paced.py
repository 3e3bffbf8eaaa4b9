"""Evaluation of requirements with wide windows in a stream, at a bounded cost per sample.

Every evaluation recomputes the instants whose value may still change. Requirements with narrow windows are
evaluated after every sample. Those with wide windows are evaluated only after every n-th sample, so that the
cost per sample is bounded. A window longer than the stream is shortened to a few times the number of samples.
It is lengthened as the stream grows. Memory thus grows with the number of samples, not with the width of the
windows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Reach, reach
from stlc.compile.ir.traverse import map_children, nodes, operands
from stlc.compile.pipeline import CompiledRequirement
from stlc.monitor.online.bounds import RobustnessBounds, Tracker
from stlc.monitor.online.history import Floats
from stlc.monitor.online.streams import unbounded
from stlc.monitor.prefix_bounds import FAR, own_span

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


def span(formula: ir.Formula) -> Reach:
    """Return the lookback and the lookahead of a formula in samples; `[a, inf)` counts as `a` samples."""
    below = [Reach(0, 0), *map(span, operands(formula))]
    own = own_span(formula)
    return Reach(own.past + max(each.past for each in below), own.future + max(e.future for e in below))


@dataclass(frozen=True, slots=True)
class PacedWork:
    """Work of one evaluation of a formula, counted in rows.

    A row is the value of one subformula at one instant.

    Attributes:
        rows: number of all rows.
        own: number of rows that only one evaluated instant uses, such as those inside a `freeze`.
        heaviest: the subformula to which most of the rows in `own` belong.
    """

    rows: int = 0
    own: int = 0
    heaviest: ir.Formula | None = None

    def __add__(self, other: PacedWork) -> PacedWork:
        heaviest = self.heaviest if self.own >= other.own else other.heaviest
        return PacedWork(self.rows + other.rows, self.own + other.own, heaviest)


def work(formula: ir.Formula, instants: int, samples: int = 0) -> PacedWork:
    """Return the work of one evaluation of a formula at several instants.

    `samples` is the width that is assumed for an unbounded window.
    """
    if isinstance(formula, ir.Freeze):
        spanned = sum(span(formula.body)) + (samples if unbounded(formula.body) else 0)
        own = instants * (_FROZEN + spanned + work(formula.body, 1, samples).rows)
        return PacedWork(own, own, formula)
    rows, instants = 0, 1 if isinstance(formula, ir.AtStart) else instants
    if isinstance(formula, ir.Windowed):
        window = formula.window
        skipped = window.lo if len(operands(formula)) == 1 else 0  # `until` reads its left side from now on
        instants += samples if window.hi is None else window.hi - skipped
        rows = instants
    return sum((work(part, instants, samples) for part in operands(formula)), PacedWork(rows))


def cut(formula: ir.Formula, samples: int) -> ir.Formula:
    """Return a copy of the formula with shorter windows, which has the same value on short streams.

    A short stream has at most `samples` samples. Far after its last sample, nothing is known, and each
    sub-formula has the same value at all instants. A future window needs only one of these instants. A past
    window need not reach back beyond the first sample.

    If past windows are narrow, future windows are shortened. Otherwise, if future windows are narrow, past
    windows are shortened. If both are wide, the formula is returned unchanged.
    """
    past, future = span(formula)
    if past > _NARROW and future > _NARROW:
        return formula
    slack = samples + sum(1 for _ in nodes(formula))
    most = Reach(FAR, slack + past) if past <= _NARROW else Reach(slack + future, FAR)

    def shorter(part: ir.Formula) -> ir.Formula:
        if isinstance(part, (ir.Freeze, ir.AtStart)):
            return part
        if isinstance(part, ir.Windowed):
            longest, window = most.past if part.back else most.future, part.window
            hi = None if window.hi is None else min(window.hi, longest)
            part = replace(part, window=ir.Window(min(window.lo, longest), hi))
        elif isinstance(part, ir.Shift):
            part = replace(part, steps=max(min(part.steps, most.future), -most.past))
        return map_children(part, formulas=shorter)

    return shorter(formula)


@dataclass(slots=True)
class PacedTracker:
    """Incremental evaluator of a requirement that is evaluated only after every n-th sample.

    Attributes:
        rule: the requirement.
        make: returns an evaluator of `rule`, or of a copy of it with shorter windows.
        everywhere: whether the requirement is evaluated at every instant or only at the first one.
        stores_all: whether the evaluator stores and reads all samples.
        window: number of samples from each instant to the end of its planning window; None if the instants
            have no planning windows of their own.
        samples: number of samples received at the last evaluation.
    """

    rule: CompiledRequirement
    make: Callable[[CompiledRequirement], Tracker]
    everywhere: bool
    stores_all: bool
    window: int | None = None
    samples: int = 0
    _inner: Tracker = field(init=False)
    _formula: ir.Formula = field(init=False)
    _most: int | None = 0
    _pace: int = 1

    def effort(self, formula: ir.Formula, spanned: int) -> PacedWork:
        """Return the work of one evaluation on `spanned` samples; `formula` may have shorter windows."""
        many = self.everywhere or unbounded(formula)
        found = work(formula, spanned if many else 1, spanned if self.stores_all else 0)
        own = (self.window or 0) * (spanned if self.everywhere else 1)
        return found + PacedWork(own, own, formula) if self.window is not None else found

    def due(self, samples: int) -> bool:
        """True if the requirement is to be evaluated now that `samples` samples have been received."""
        return samples - self.samples >= self._pace

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Add new samples, evaluate, and choose after how many samples to evaluate next."""
        if self._most is not None and samples > self._most:
            most = max(samples, _SHORT) * _GROWN
            self._formula = cut(self.rule.formula, most)
            whole = self._formula == self.rule.formula
            self._most = None if whole else most
            shorter = replace(self.rule, formula=self._formula, reach=reach(self._formula).future)
            self._inner = self.make(self.rule if whole else shorter)
        self._inner.grow(signals, first, samples)
        self.samples = samples
        whole_span = sum(span(self.rule.formula)) + (self.window or 0)
        spanned = samples if self.stores_all else min(self._most or samples, whole_span)
        rows = self.effort(self._formula, spanned).rows
        self._pace = max(min(rows // WIDE, min(samples, spanned) // _LATE), 1)

    @property
    def settled(self) -> int:
        return self._inner.settled

    def live(self, start: int, stop: int) -> RobustnessBounds:
        return self._inner.live(start, stop)

    def ended(self, starts: range) -> RobustnessBounds:
        return self._inner.ended(starts)

    def drop(self, start: int) -> int:
        """While windows are shortened, all samples are needed, since windows may be lengthened later."""
        needed = self._inner.drop(start)
        return needed if self._most is None else 0
