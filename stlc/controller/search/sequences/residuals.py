"""Residuals: what is left of a formula after the first samples of a trajectory.

Progression rewrites a formula over a prefix of a trajectory (Bacchus & Kabanza 2000, "Using temporal logics
to express search control knowledge for planning"). Parts that the prefix decides become true or false; the
others remain, with windows that count from the last sample of the prefix.

Example: `eventually[0, 9] (p and eventually[0, 9] q)` after 5 samples, of which the third met p, is
`eventually[1, 7] q or eventually[1, 5] (p and eventually[0, 9] q)`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.normal_form import joined
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


class Progression:
    """Progression of formulas over prefixes of trajectories.

    Args:
        formulas: the formulas, as they stand at the first sample.
        steps: number of steps of a whole trajectory.
    """

    def __init__(self, formulas: Sequence[ir.Formula], steps: int) -> None:
        self._formulas, self._steps = tuple(formulas), steps
        numbers: dict[ir.Formula, int] = {}
        self._index: dict[int, int] = {}
        for formula in formulas:
            self._collect(formula, numbers)
        self._parts = tuple(numbers)

    def _collect(self, formula: ir.Formula, numbers: dict[ir.Formula, int]) -> None:
        self._index[id(formula)] = numbers.setdefault(formula, len(numbers))
        if looks_ahead(formula):
            for part in operands(formula):
                self._collect(part, numbers)

    def after(self, env: Mapping[str, NDArray[np.float64]]) -> tuple[ir.Formula, ...]:
        """Return what is left of each formula after a prefix, or false for a formula that is lost.

        Args:
            env: states along the prefix, name -> (k + 1, 1).
        """
        count = len(next(iter(env.values())))
        low, high = (
            evaluate(self._parts, env, ops=NUMPY, count=count, end=end, stop=self._steps + 1)
            for end in ("lower", "upper")
        )
        bounds = [
            _Bounds(
                satisfied(np.broadcast_to(lower, (count, 1))[:, 0]).astype(np.bool_),
                np.logical_not(satisfied(np.broadcast_to(upper, (count, 1))[:, 0])),
            )
            for lower, upper in zip(low, high, strict=True)
        ]
        of = {key: bounds[number] for key, number in self._index.items()}
        left = _Residual(of, count - 1, self._steps)
        return tuple(left.at(formula, 0) for formula in self._formulas)


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
