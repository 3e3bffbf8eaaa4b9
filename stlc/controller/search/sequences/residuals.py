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
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.tolerance import TOLERANCE

YES, NO = ir.Truth(True), ir.Truth(False)


def looks_ahead(formula: ir.Formula) -> bool:
    """True if a formula has an operator of the future."""
    return any(
        isinstance(node, (ir.Temporal, ir.Until, ir.AtStart))
        or (isinstance(node, ir.Shift) and node.steps > 0)
        for node in formula.walk()
    )


class Progression:
    """Progression of formulas over prefixes of trajectories.

    Args:
        formulas: the formulas, as they stand at the first sample.
        steps: number of steps of a whole trajectory.
    """

    def __init__(self, formulas: Sequence[ir.Formula], steps: int) -> None:
        self._formulas, self._steps = tuple(formulas), steps
        self._parts = list(self._formulas)
        for part in self._parts:
            self._parts.extend(part.operands if looks_ahead(part) else ())
        present = dict.fromkeys(part for part in self._parts if not looks_ahead(part))
        self._here = tuple(part for part in present if not part.history)
        self._back = tuple(part for part in present if part.history)
        self._names = {part: str(i) for i, part in enumerate((*self._here, *self._back))}
        self._forms = [self._form(part) for part in self._parts]

    def _form(self, formula: ir.Formula) -> ir.Formula:
        """Return a formula with a signal for each part that does not look ahead; `?` is unknown."""
        if isinstance(formula, (ir.BoolOp, ir.Temporal, ir.Until)) and looks_ahead(formula):
            return formula.map_children(formulas=self._form)
        return ir.Predicate(ir.Signal(self._names.get(formula, "?")))

    def after(self, env: Mapping[str, NDArray[np.float64]]) -> tuple[ir.Formula, ...]:
        """Return the residual of each formula after a prefix; false for a formula that the prefix violates.

        Args:
            env: states along the prefix, name -> (k + 1, 1).
        """
        count = len(next(iter(env.values())))
        flat = {name: column.reshape(1, -1) for name, column in env.items()}
        values = (
            *evaluate(self._here, flat),
            *evaluate(self._back, env, count=count),
        )
        shape = self._steps + 1, 2
        unknown = np.broadcast_to([-1.0, 1.0], shape)  # the worst or best continuation
        signals = {"?": unknown}
        for name, value in zip(self._names.values(), values, strict=True):
            signals[name] = unknown.copy()
            signals[name][:count] = np.where(TOLERANCE.satisfied(value), 1.0, -1.0).reshape(-1, 1)
        bounds = evaluate(self._forms, signals, count=self._steps + 1, end="truncate")
        known = {
            id(part): np.broadcast_to(each, shape) >= 0.0
            for part, each in zip(self._parts, bounds, strict=True)
        }
        left = _Residual(known, count - 1, self._steps)
        return tuple(left.at(formula, 0) for formula in self._formulas)


@dataclass(frozen=True, slots=True)
class _Residual:
    """Remainder of formulas after the sample `now`.

    Attributes:
        known: whether each formula, by identity, is met by the worst and best continuation, (T + 1, 2).
        now: last sample of the prefix.
        steps: number of steps of a whole trajectory.
    """

    known: Mapping[int, NDArray[np.bool_]]
    now: int
    steps: int

    def at(self, formula: ir.Formula, sample: int) -> ir.Formula:
        """Return the residual after sample `now` of `formula` at `sample`."""
        worst, best = self.known[id(formula)][sample]
        if worst or not best:
            return ir.Truth(bool(worst))
        match formula:
            case ir.BoolOp(op, items):
                left = [self.at(item, sample) for item in items]
                return ir.BoolOp.joined(op, left)
            case ir.Temporal(op, window, body):
                ahead, seen = self._split(window, sample)
                both: Literal["and", "or"] = "or" if op == "eventually" else "and"
                left = [self.at(body, k) for k in self._open(body, seen)]
                left += [] if ahead is None else [ir.Temporal(op, ahead, body)]
                return ir.BoolOp.joined(both, left)
            case ir.Until("until", window, one, other):
                ahead, seen = self._split(window, sample)
                held = self.known[id(one)][:, 1]
                left = [self.at(other, k) for k in self._open(other, seen) if held[sample : k + 1].all()]
                if ahead is not None and held[sample : self.now + 1].all():
                    left.append(ir.Until("until", ahead, one, other))
                return ir.BoolOp.joined("or", left)
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
        worst, best = self.known[id(body)].T
        undecided = [k for k in seen if best[k] and not worst[k]]
        return sorted({*undecided[:1], *undecided[-1:]})
