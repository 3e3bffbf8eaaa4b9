"""Evaluation of a requirement anew after each sample, where there are no transducers (`kernel.py`).

The evaluator of recordings runs over the samples that the undecided instants read. It is used without a C
compiler, for `freeze`, for windows to the end of the trace inside of other windows, and for planning windows
whose end moves.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from stlc.compile.backends.schedule import PICKS, neutral
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.tolerance import Status
from stlc.diagnostics import usage
from stlc.monitor.instants import window_of
from stlc.monitor.online.history import ColumnHistory, Floats
from stlc.monitor.online.tally import Asked, Flags, JudgedInstants, RequirementSummary

MOST = 1 << 26
"""Greatest number of values at a time that only one instant reads."""

_FROZEN = 500
"""Overhead of one instant of a `freeze`, in values."""

_FINAL = 64
"""Instants with final values that are taken in together."""

_NARROW = 1 << 13
"""Samples that are evaluated anew after each new one; more of them when an eighth is new."""


@final
@dataclass(slots=True)
class Extremum:
    """Running extremum of `always` or `eventually` to the end of the trace, over instants with final values.

    Attributes:
        body: the operand, at instants to come.
        lo: first instant of the window, after that of the operator.
        choose: minimum or maximum.
        next: the first instant that is not taken in.
        known: bounds over the instants that are, as of `Asked.bounds`, (1, 2 or 4).
    """

    body: Asked
    lo: int
    choose: np.ufunc
    next: int
    known: Floats

    @staticmethod
    def of(asked: Asked) -> Extremum | None:
        """Return the extremum of a requirement; None unless it is such an operator over bounded windows."""
        node, rule = asked.rule.formula.unbounded, asked.rule
        moving = rule.absolute or asked.everywhere or window_of(rule, asked.horizon) is not None
        if moving or node is None or any(part.endless for part in node.operands):
            return None
        if node.op not in ("always", "eventually"):
            return None
        inner = []
        for each in asked.rules:
            (body,) = each.formula.operands
            inner.append(replace(each, formula=body, lowered=body, reach=body.reach.future))
        choose, lo = np.minimum if node.op == "always" else np.maximum, node.window.lo
        known = np.full((1, 2 * len(inner)), neutral(PICKS[node.op]))
        return Extremum(replace(asked, rules=inner, ending="open"), lo, choose, asked.begin + lo, known)

    @property
    def needs(self) -> int:
        """The first sample that later instants read."""
        return min(max(self.next - self.lo, 0), self.body.needs(self.next))

    def take(self, history: ColumnHistory) -> None:
        """Take in instants with final values, some at a time; the last one stays."""
        stop = self.body.settled(history.samples) - 1
        if stop < self.next + _FINAL:
            return
        found = self.body.bounds(history.columns(), range(self.next - history.first, stop - history.first))
        self.known = self.choose(self.choose.reduce(found, axis=0, keepdims=True), self.known)
        self.next = stop


@final
@dataclass(slots=True)
class Recomputed:
    """A requirement that is evaluated anew after each sample.

    Attributes:
        asked: the requirement.
        tally: as of `Streamed`.
        news: starts that the latest samples decided, in order, and their verdicts.
    """

    asked: Asked
    _history: ColumnHistory
    tally: RequirementSummary = field(init=False)
    news: dict[int, Status] = field(default_factory=dict)
    _final: Extremum | None = field(init=False)
    _looked: int = 0
    _decided: Flags = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))

    def __post_init__(self) -> None:
        asked = self.asked
        _require_bounded(asked)
        self.tally = RequirementSummary(low_at=asked.begin, high_at=asked.begin, first=asked.begin)
        self._final = Extremum.of(asked)

    @property
    def _over(self) -> bool:
        """True if the requirement is evaluated only once, and its verdict is final."""
        return not self.asked.everywhere and self.tally.instants > 0

    def take(self) -> None:
        """Take new samples: decide starts, and count those whose windows are complete."""
        self.news = {}
        samples = self._history.samples
        stored = samples - self._history.first
        if self._over or (stored > _NARROW and samples < self._looked + stored // 8):
            return
        self._looked, starts = samples, self.asked.starts(self.tally.next, samples)
        judged = self.judged(starts)
        known = judged.holds | judged.fails
        new = known.copy()
        new[: len(self._decided)] &= ~self._decided
        for i in np.flatnonzero(new).tolist():
            self.news[starts[i]] = "violated" if judged.fails[i] else "satisfied"
        settled = min(self.asked.settled(samples), samples - self.asked.lag)
        count = min(max(settled - starts.start, 0), len(starts))
        self.tally = self.tally.with_more(judged, count)
        self._decided = known[count:]
        if self._final is not None:
            self._final.take(self._history)

    @property
    def needs(self) -> int:
        """The first sample that is still read, by the verdicts of the latest sample, too."""
        if self._final is not None:
            return self._final.needs
        starts = [*self.news] if self._over else [self.tally.next, *self.news]
        return min(map(self.asked.needs, starts), default=self._history.samples)

    def judged(self, starts: range, *, ended: bool = False) -> JudgedInstants:
        """Return what `Streamed.judged` does."""
        asked, history, final = self.asked, self._history, self._final
        if not starts:
            return asked.judged(np.zeros((0, 2)))
        begin = (starts.start if final is None else final.next - final.lo) - history.first
        found = asked.bounds(history.columns(), range(begin, begin + len(starts)), ended=ended)
        return asked.judged(found if final is None else final.choose(found, final.known))


def _require_bounded(asked: Asked) -> None:
    """Check the work of one evaluation.

    Raises:
        UsageError: E313, every instant reads too many values in a `freeze`, which no other instant reads.
    """
    rule, many = asked.rule, 1
    if asked.everywhere or rule.formula.endless:
        many = _span(rule.formula) + (window_of(rule, asked.horizon) or 0)
    work, heaviest = _own(rule.formula, many)
    if work > MOST:
        what = f"every instant keeps values of its own, and {work:,} samples to look at"
        message = f"a stream cannot judge `{rule.name}`: {what}"
        advice = ("shorten its intervals", "`stlc check SPEC TRACE` judges a recording")
        raise usage(message, *advice, code="E313", span=heaviest.span or rule.span)


def _span(formula: ir.Formula) -> int:
    """Samples that a formula reads around an instant; `[a, inf)` counts as `a` samples."""
    return sum(formula.own_reach) + max(map(_span, formula.operands), default=0)


def _own(formula: ir.Formula, instants: int) -> tuple[int, ir.Formula]:
    """Values that only one of several instants reads, and the `freeze` that reads most of them."""
    if formula.own_numbers and formula.operands:  # a `freeze`
        (body,) = formula.operands
        return instants * (_FROZEN + _span(body) * sum(1 for _ in body.numbers())), formula
    inner, operator = instants, formula.windowed
    if operator is not None and operator.window.hi is not None:
        inner += operator.window.hi - operator.window.lo
    return max((_own(part, inner) for part in formula.operands), key=lambda own: own[0], default=(0, formula))
