"""Why a formula fails at an instant: the least tree of sub-formulas, instants and signals that explains it.

A conjunction fails because of one part, a disjunction because of all; `always` fails at one instant,
`eventually` at every one, of which the closest is shown. Where there is a choice, the part that decides the
robustness is taken, so that the values at the leaf are those behind the number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from stlc.compile import ir, typed
from stlc.compile.defined import defined
from stlc.compile.graph import evaluate_parts
from stlc.compile.horizon import columns, parts
from stlc.compile.interface import Grid
from stlc.compile.lower import lower
from stlc.compile.samples import columns_of
from stlc.compile.thaw import thaw
from stlc.compile.walk import from_now, on_clock
from stlc.monitor.values import Record, bounds, granted, history
from stlc.source import Span

Floats = NDArray[np.float64]

_MOST_LATER = 64
"""How many instants after the last sample are looked at where past operators still know something there."""


@dataclass(frozen=True, slots=True)
class Blame:
    """A sub-formula that is not as it should be.

    Attributes:
        formula: as typed.
        holds: what it is: true or false (it should be the other).
        sample: where.
        rho: its robustness there, by whose sign it `holds`.
        until: for an operator that fails at every instant of a window: the last one.
        signals: names of the signals that it reads; of a predicate alone.
        parts: why; empty for a predicate.
        main: which of the parts decides.
        premise: it is the left side of an implication.
    """

    formula: typed.Formula
    holds: bool
    sample: int
    rho: float
    until: int | None = None
    signals: tuple[str, ...] = ()
    parts: tuple[Blame, ...] = ()
    main: int = 0
    premise: bool = False

    @property
    def span(self) -> Span:
        """Where it is written."""
        return self.formula.span

    @property
    def leaf(self) -> Blame:
        """The predicate that decides."""
        return self.parts[self.main].leaf if self.parts else self

    @property
    def leaves(self) -> tuple[Blame, ...]:
        """All predicates."""
        return tuple(leaf for part in self.parts for leaf in part.leaves) if self.parts else (self,)


@dataclass(frozen=True, slots=True)
class Blamer:
    """Explains failures on one trace.

    Attributes:
        record: columns of the one trace, (samples, 1), up to what `end` is.
        grid: of time.
        cache: formulas, or their negations, as lowered.
        known: the most that lowered formulas can be, at which instants.
    """

    record: Record
    grid: Grid
    cache: dict[tuple[typed.Formula, bool], ir.Formula] = field(default_factory=dict)
    known: dict[ir.Formula, list[tuple[range, Floats]]] = field(default_factory=dict)

    def blame(self, formula: typed.Formula, sample: int, *, wanted: bool = True) -> Blame:
        """Why `formula` is not `wanted` at `sample`."""
        match formula:
            case typed.Truth():
                return self._node(formula, wanted, sample)
            case typed.Pred():
                return self._predicate(formula, sample, wanted)
            case typed.Not(span, body) if span == body.span and span.text:
                return self._predicate(formula, sample, wanted)  # `not in`: to a reader one predicate
            case typed.Not(_, body):
                return self.blame(body, sample, wanted=not wanted)
            case typed.Logic():
                return self._logic(formula, sample, wanted)
            case typed.Temporal() | typed.Until():
                return self._timed(formula, sample, wanted)
            case typed.Shift(_, steps, body):
                there = sample + steps
                inside = there >= 0 and (
                    there < self.record.samples or not self._unknown(body, there, wanted)
                )
                parts = (self.blame(body, there, wanted=wanted),) if inside else ()
                return replace(self._node(formula, wanted, sample), parts=parts)
            case typed.Edge():
                return self._edge(formula, sample, wanted)
            case typed.Freeze(_, _, body):
                return self.blame(thaw(body, self._values(formula, sample)), sample, wanted=wanted)
        assert_never(formula)

    # ------------------------------------------------------------------- values

    def _values(self, formula: typed.Freeze, sample: int) -> dict[str, ir.Num]:
        """What the formula binds at a sample; what does not exist becomes a sample beyond the trace."""
        values: dict[str, ir.Num] = {}
        last = self.record.samples - 1
        for name, num in formula.bindings:
            given = columns_of(num) <= self.record.env.keys()
            if given and sample <= last and defined(ir.Atom(num), last + 1)[sample]:
                value, _ = bounds(ir.Atom(num), self.record, range(sample, sample + 1), "open")
                values[name] = ir.Lit(float(value[0, 0]))
            else:
                values[name] = ir.At(next(iter(self.record.env)), last + 1)
        return values

    def _lowered(self, formula: typed.Formula, wanted: bool) -> ir.Formula:
        """The formula, or its negation where it is not wanted: what fails.

        A requirement may not depend on all that it mentions, and what it does not depend on is not given.
        """
        key = (formula, wanted)
        if key not in self.cache:
            goal = formula if wanted else typed.Not(formula.span, formula)
            self.cache[key] = granted(lower(goal, self.grid, []), self.record.env)
        return self.cache[key]

    def _margins(self, formula: typed.Formula, wanted: bool, instants: range) -> Floats:
        """By how much the formula is as wanted, at best, at consecutive instants: (instants,)."""
        lowered = self._lowered(formula, wanted)
        found = self._found(lowered, instants)
        if found is None:
            for node, its, values in evaluate_parts(
                lowered, self.record.env, instants, ops=self.record.ops, end="upper"
            ):
                self.known.setdefault(node, []).append((its, values[:, 0]))
            found = self._found(lowered, instants)
        assert found is not None
        return found

    def _unknown(self, formula: typed.Formula, sample: int, wanted: bool) -> bool:
        """Whether the trace does not tell: it was cut, and what is not there is not as it is wanted."""
        return bool(np.isposinf(self._margins(formula, wanted, range(sample, sample + 1))[0]))

    def _found(self, lowered: ir.Formula, instants: range) -> Floats | None:
        """Its values, where an evaluation of something around it has told them already."""
        for known, values in self.known.get(lowered, ()):
            if known.start <= instants.start and instants.stop <= known.stop:
                rows = values[instants.start - known.start : instants.stop - known.start]
                return rows.astype(np.float64)
        return None

    def _node(self, formula: typed.Formula, wanted: bool, sample: int) -> Blame:
        margin = float(self._margins(formula, wanted, range(sample, sample + 1))[0])
        return Blame(formula, not wanted, sample, margin if wanted else -margin)

    def _predicate(self, formula: typed.Formula, sample: int, wanted: bool) -> Blame:
        read = tuple(sorted(columns(self._lowered(formula, wanted))))
        return replace(self._node(formula, wanted, sample), signals=read)

    def _least(self, parts: Sequence[tuple[typed.Formula, int, bool]]) -> tuple[typed.Formula, int, bool]:
        """The part that is farthest from what is wanted of it."""
        margins = [self._margins(f, wanted, range(k, k + 1))[0] for f, k, wanted in parts]
        return parts[int(np.argmin(margins))]

    # ---------------------------------------------------------------- connectives

    def _logic(self, formula: typed.Logic, sample: int, wanted: bool) -> Blame:
        node = self._node(formula, wanted, sample)
        match formula.op:
            case "and" | "or":
                items = [(item, sample, wanted) for item in formula.items]
                all_needed = (formula.op == "and") is wanted
            case "->":
                left, right = formula.items
                items = [(left, sample, not wanted), (right, sample, wanted)]
                all_needed = not wanted
            case "<->" | "xor":
                items = [(item, sample, not self._is_true(item, sample)) for item in formula.items]
                all_needed = False
            case _:
                assert_never(formula.op)
        if all_needed:
            part, there, its = self._least(items)
            return replace(node, parts=(self.blame(part, there, wanted=its),))
        parts = tuple(self.blame(part, there, wanted=its) for part, there, its in items)
        if formula.op == "->":
            return replace(node, parts=(replace(parts[0], premise=True), parts[1]), main=1)
        return replace(node, parts=parts, main=int(np.argmin([abs(part.rho) for part in parts])))

    def _is_true(self, formula: typed.Formula, sample: int) -> bool:
        return bool(self._margins(formula, True, range(sample, sample + 1))[0] >= 0)

    def _edge(self, formula: typed.Edge, sample: int, wanted: bool) -> Blame:
        node = self._node(formula, wanted, sample)
        if sample == 0:
            return node
        now = formula.op == "rise"
        parts = [(formula.body, sample, now is wanted), (formula.body, sample - 1, now is not wanted)]
        if wanted:
            part, there, its = self._least(parts)
            return replace(node, parts=(self.blame(part, there, wanted=its),))
        return replace(node, parts=tuple(self.blame(part, there, wanted=its) for part, there, its in parts))

    # ------------------------------------------------------------------- windows

    def _instants(self, formula: typed.Formula, sample: int, wanted: bool) -> range:
        """The instants of the window of a temporal operator of which something is known, in order of time."""
        lowered = self._lowered(formula, wanted)
        last = self.record.samples - 1
        match lowered:
            case ir.Over(window=window) | ir.Until(window=window):
                known = last + min(max(map(history, parts(lowered))), _MOST_LATER)
                high = last if window.hi is None else min(sample + window.hi, known)
                return range(sample + window.lo, high + 1)
            case ir.Past(window=window) | ir.Since(window=window):
                low = 0 if window.hi is None else max(sample - window.hi, 0)
                return range(low, sample - window.lo + 1)
        raise TypeError(f"{type(lowered).__name__} has no window")

    def _timed(self, formula: typed.Temporal | typed.Until, sample: int, wanted: bool) -> Blame:
        if on_clock(formula):
            return self._timed(from_now(formula), 0, wanted)
        if isinstance(formula, typed.Temporal):
            return self._temporal(formula, sample, wanted)
        return self._until(formula, sample, wanted)

    def _temporal(self, formula: typed.Temporal, sample: int, wanted: bool) -> Blame:
        node = self._node(formula, wanted, sample)
        instants = self._instants(formula, sample, wanted)
        if not instants:
            return node
        margins = self._margins(formula.body, wanted, instants)
        if (formula.op in ("always", "historically")) is wanted:
            worst = instants[int(np.argmin(margins))]
            return replace(node, parts=(self.blame(formula.body, worst, wanted=wanted),))
        best = instants[int(np.argmax(np.where(np.isposinf(margins), -np.inf, margins)))]
        part = self.blame(formula.body, best, wanted=wanted)
        return replace(node, sample=instants[0], until=instants[-1], parts=(part,))

    def _until(self, formula: typed.Until, sample: int, wanted: bool) -> Blame:
        if formula.op == "unless":
            return self._unless(formula, sample, wanted)
        node = self._node(formula, wanted, sample)
        instants = self._instants(formula, sample, wanted)
        if not instants:
            return node
        past = formula.op == "since"
        held = range(instants[0], sample + 1) if past else range(sample, instants[-1] + 1)
        left = self._margins(formula.left, wanted, held)
        right = self._margins(formula.right, wanted, instants)
        left = left[::-1] if past else left
        right = right[::-1] if past else right
        if (formula.op == "release") is wanted:
            met, far = _released(left, right)
            there = (sample - far, sample - met) if past else (sample + far, sample + met)
            parts = (
                self.blame(formula.left, there[0], wanted=wanted),
                self.blame(formula.right, there[1], wanted=wanted),
            )
            return replace(node, parts=parts, main=1)
        offset, is_left = _unmet(left, right)
        there_ = sample - offset if past else sample + offset
        part = self.blame(formula.left if is_left else formula.right, there_, wanted=wanted)
        if is_left:
            return replace(node, parts=(part,))
        return replace(node, sample=instants[0], until=instants[-1], parts=(part,))

    def _unless(self, formula: typed.Until, sample: int, wanted: bool) -> Blame:
        """`always[0, b] left or left until[a, b] right`."""
        whole = replace(formula.interval, lo=typed.Time(), lo_open=False)
        held = typed.Temporal(formula.span, "always", whole, formula.left)
        met = typed.Until(formula.span, "until", formula.interval, formula.left, formula.right)
        return self.blame(typed.Logic(formula.span, "or", (held, met)), sample, wanted=wanted)


def _unmet(left: Floats, right: Floats) -> tuple[int, bool]:
    """Why `until` fails: an offset from now, and whether it is the left side that fails there.

    Where the right side is never met, it is shown where it comes closest; where it is, the left side did not
    hold up to there.
    """
    skipped = len(left) - len(right)
    met = np.flatnonzero(right >= 0)
    if not len(met):
        return skipped + int(np.argmax(right)), False
    return int(np.argmin(left[: skipped + int(met[0]) + 1])), True


def _released(left: Floats, right: Floats) -> tuple[int, int]:
    """Where `release` fails: offset of the right side, and the best the left side did up to there."""
    skipped = len(left) - len(right)
    freed = np.maximum.accumulate(left)[skipped:]
    worst = int(np.argmin(np.maximum(freed, right)))
    return skipped + worst, int(np.argmax(left[: skipped + worst + 1]))
