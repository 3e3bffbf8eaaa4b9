"""Residuals: what is left of a formula after the first samples of a trajectory.

Progression rewrites a formula over a prefix of a trajectory (Bacchus & Kabanza 2000, "Using temporal logics
to express search control knowledge for planning"). Parts that the prefix decides become true or false; the
others remain, with windows that count from the last sample of the prefix.

Example: `eventually[0, 9] (p and eventually[0, 9] q)` after 5 samples, of which the third met p, is
`eventually[1, 7] q or eventually[1, 5] (p and eventually[0, 9] q)`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.normal_form import joined
from stlc.compile.ir.support import history
from stlc.compile.ir.traverse import nodes, operands
from stlc.compile.semantics.tolerance import satisfied

if TYPE_CHECKING:
    from numpy.typing import NDArray

YES, NO = ir.Truth(True), ir.Truth(False)


def looks_ahead(formula: ir.Formula) -> bool:
    """True if a formula has an operator of the future."""
    return any(
        isinstance(node, (ir.Temporal, ir.Until, ir.AtStart))
        or (isinstance(node, ir.Shift) and node.steps > 0)
        for node in nodes(formula)
    )


@dataclass(frozen=True, slots=True)
class _Bounds:
    """Bounds on the truth of a formula at the samples of a prefix, (k + 1,) each.

    Attributes:
        met: True where every continuation meets the formula.
        lost: True where every continuation violates it.
    """

    met: NDArray[np.bool_]
    lost: NDArray[np.bool_]

    @property
    def negated(self) -> _Bounds:
        """Bounds on the negated formula."""
        return _Bounds(self.lost, self.met)


class Progression:
    """Progression of formulas over prefixes of trajectories.

    Args:
        formulas: the formulas, as they stand at the first sample.
        steps: number of steps of a whole trajectory.
    """

    def __init__(self, formulas: Sequence[ir.Formula], steps: int) -> None:
        self._formulas, self._steps = tuple(formulas), steps
        found = [part for formula in formulas for part in _parts(formula)]
        present = dict.fromkeys(part for part in found if not looks_ahead(part))
        back = {part for part in present if history(part)}
        self._here, self._back = tuple(part for part in present if part not in back), tuple(back)

    def after(self, env: Mapping[str, NDArray[np.float64]]) -> tuple[ir.Formula, ...]:
        """Return what is left of each formula after a prefix, or false for a formula that is lost.

        Args:
            env: states along the prefix, name -> (k + 1, 1).
        """
        count = len(next(iter(env.values())))
        flat = {name: column.reshape(1, -1) for name, column in env.items()}
        values = [
            *zip(self._here, evaluate(self._here, flat, ops=NUMPY), strict=True),
            *zip(self._back, evaluate(self._back, env, ops=NUMPY, count=count), strict=True),
        ]
        known = dict[ir.Formula, _Bounds]()
        for part, value in values:
            held = np.broadcast_to(satisfied(value).reshape(-1), count).astype(np.bool_)
            known[part] = _Bounds(held, ~held)
        of = dict[int, _Bounds]()
        for formula in self._formulas:
            self._bounds(formula, known, of, count)
        left = _Residual(of, count - 1, self._steps)
        return tuple(left.at(formula, 0) for formula in self._formulas)

    def _bounds(
        self, formula: ir.Formula, present: Mapping[ir.Formula, _Bounds], of: dict[int, _Bounds], count: int
    ) -> _Bounds:
        """Return bounds on a formula, and add them and those of its parts to `of`, by identity."""
        if id(formula) in of:
            return of[id(formula)]
        if not looks_ahead(formula):
            found = present[formula]
        else:
            parts = [self._bounds(part, present, of, count) for part in operands(formula)]
            found = self._combined(formula, parts, count)
        of[id(formula)] = found
        return found

    def _combined(self, formula: ir.Formula, parts: Sequence[_Bounds], count: int) -> _Bounds:
        match formula:
            case ir.BoolOp(op):
                both, one = (np.logical_and.reduce, np.logical_or.reduce)
                met, lost = [each.met for each in parts], [each.lost for each in parts]
                return _Bounds(both(met), one(lost)) if op == "and" else _Bounds(one(met), both(lost))
            case ir.Temporal("eventually", window):
                return self._until(window, _Bounds(*np.array([[True], [False]]).repeat(count, 1)), parts[0])
            case ir.Temporal("always", window):
                never = _Bounds(*np.array([[True], [False]]).repeat(count, 1))
                return self._until(window, never, parts[0].negated).negated
            case ir.Until("until", window):
                return self._until(window, *parts)
            case ir.Until("release", window):
                return self._until(window, *(each.negated for each in parts)).negated
            case _:
                unknown = np.zeros(count, np.bool_)
                return _Bounds(unknown, unknown)

    def _until(self, window: ir.Window, left: _Bounds, right: _Bounds) -> _Bounds:
        """Return bounds on an `until` at each sample of the prefix."""
        count = len(left.met)
        now = np.arange(count)
        first = now + window.lo
        last = np.full(count, self._steps) if window.hi is None else np.minimum(now + window.hi, self._steps)
        sure = np.minimum(np.minimum(last, count - 1), _next(~left.met) - 1)
        open_ = np.minimum(last, np.where(_next(left.lost) < count, _next(left.lost) - 1, self._steps))
        return _Bounds(
            _number(right.met, first, sure) > 0,
            (open_ < count) & (_number(~right.lost, first, open_) == 0),
        )


def _parts(formula: ir.Formula) -> Iterator[ir.Formula]:
    """Yield a formula and its operands, down to formulas that do not look ahead."""
    yield formula
    if looks_ahead(formula):
        for part in operands(formula):
            yield from _parts(part)


def _next(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """For each sample, the first one from there at which a mask is true; their number if there is none."""
    there = np.where(mask, np.arange(len(mask)), len(mask))
    found: NDArray[np.int64] = np.minimum.accumulate(there[::-1])[::-1]
    return found


def _number(mask: NDArray[np.bool_], first: NDArray[np.int64], last: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of samples in ranges at which a mask is true."""
    total = np.concatenate(([0], mask.cumsum()))
    begin, end = (np.clip(each, 0, len(mask)) for each in (first, last + 1))
    found: NDArray[np.int64] = np.maximum(total[end] - total[begin], 0)
    return found


@dataclass(frozen=True, slots=True)
class _Residual:
    bounds: Mapping[int, _Bounds]
    now: int
    steps: int

    def at(self, formula: ir.Formula, sample: int) -> ir.Formula:
        """Return what is left of `formula`, asked at `sample`, after sample `now`."""
        known = self.bounds[id(formula)]
        if known.met[sample]:
            return YES
        if known.lost[sample]:
            return NO
        match formula:
            case ir.BoolOp(op, items):
                left = [self.at(item, sample) for item in items]
                return joined(op, left, ir.Truth(op == "and"))
            case ir.Temporal(op, window, body):
                ahead, seen = self._split(window, sample)
                both: Literal["and", "or"] = "or" if op == "eventually" else "and"
                left = [self.at(body, k) for k in self._open(body, seen)]
                left += [] if ahead is None else [ir.Temporal(op, ahead, body)]
                return joined(both, left, ir.Truth(both == "and"))
            case ir.Until("until", window, one, other):
                ahead, seen = self._split(window, sample)
                held = ~self.bounds[id(one)].lost
                left = [self.at(other, k) for k in self._open(other, seen) if held[sample : k + 1].all()]
                if ahead is not None and held[sample : self.now + 1].all():
                    left.append(ir.Until("until", ahead, one, other))
                return joined("or", left, NO)
            case _:
                return YES

    def _split(self, window: ir.Window, sample: int) -> tuple[ir.Window | None, range]:
        """Return the part of a window after the prefix, counted from its last sample, and the part in it."""
        first = sample + window.lo
        last = self.steps if window.hi is None else min(sample + window.hi, self.steps)
        ahead = ir.Window(max(first - self.now, 1), last - self.now) if last > self.now else None
        return ahead, range(first, min(last, self.now) + 1)

    def _open(self, body: ir.Formula, seen: range) -> list[int]:
        """The first and the last sample in `seen` at which `body` is undecided."""
        known = self.bounds[id(body)]
        undecided = [k for k in seen if not known.met[k] and not known.lost[k]]
        return sorted({*undecided[:1], *undecided[-1:]})
