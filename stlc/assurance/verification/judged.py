"""Bounds on robustness from affine forms of the signals.

The numbers in the predicates are evaluated over the forms of each sample, so that the distance of two
positions that depend on the same symbols is as narrow as it is. The formulas are then evaluated over
intervals, by the evaluator of `stlc check --uncertain` (`docs/decisions/0051-intervals.md`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stlc.assurance.verification.forms import FORMS, Floats, Forms, ranges, spread
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.backends.schedule import Boundary
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import frozen_in, leaves, map_children
from stlc.compile.semantics.tolerance import TOLERANCE

PROVED = 0.5 * TOLERANCE
"""A lower bound on robustness of at least -`PROVED` is a proof: the monitor takes -1e-6 as satisfied."""

_NAME = "#predicate{}"


@dataclass(frozen=True, slots=True, eq=False)
class BoxVerdicts:
    """Bounds on the robustness of signals.

    Attributes:
        low: lower bounds on the robustness of all formulas together, (batch,).
        high: upper bounds on it, (batch,).
        effects: effect of the first symbols on the undecided predicates, (batch, symbols).
    """

    low: Floats
    high: Floats
    effects: Floats


class Judge:
    """Robustness of formulas over affine forms of signals.

    Args:
        formulas: the formulas.
        end: treatment of instants beyond the last sample.
        apart: whether the symbols of different samples have nothing in common.
    """

    def __init__(
        self, formulas: Sequence[ir.Formula], *, end: Boundary = "strict", apart: bool = False
    ) -> None:
        self._end, self._apart = end, apart
        self._numbers: dict[ir.Num, str] = {}
        self._formulas = [self._named(formula) for formula in formulas]
        self._program = ArrayProgram({name: num for num, name in self._numbers.items()})
        self._read = frozenset(
            leaf.name
            for formula in self._formulas
            for leaf in leaves(formula)
            if isinstance(leaf, (ir.Signal, ir.ShiftedSignal))
        )

    def _named(self, formula: ir.Formula) -> ir.Formula:
        """The formula with a signal for the number of each predicate that reads no frozen value."""
        if isinstance(formula, ir.Predicate):
            if frozen_in(formula.num):
                return formula
            name = self._numbers.setdefault(formula.num, _NAME.format(len(self._numbers)))
            return replace(formula, num=ir.Signal(name))
        found: ir.Formula = map_children(formula, formulas=self._named)
        return found

    def __call__(self, history: Mapping[str, Sequence[Forms]], symbols: int) -> BoxVerdicts:
        """Bounds for signals, name -> one form (batch,) per sample; `symbols` is the number of effects."""
        samples = len(next(iter(history.values())))
        plain = {name: ranges(forms) for name, forms in history.items()}
        numbers = [self._program(self._sample(history, at), FORMS) for at in range(samples)]
        batch = (
            len(numbers[0][_NAME.format(0)].centre) if self._numbers else plain[next(iter(plain))].shape[1]
        )
        effects = np.full((symbols, batch), 1e-12)
        env = {name: plain[name] for name in plain if name in self._read or not self._numbers}
        for name in self._numbers.values():
            forms = [spread(each[name], batch) for each in numbers]
            env[name] = ranges(forms)
            for row, form in enumerate(forms):  # shares in the radius of forms that may have both signs
                crossing = ~((env[name].low[row] >= 0.0) | (env[name].high[row] <= 0.0))
                if crossing.any():
                    share = np.abs(form.generators[: len(effects)]) / np.maximum(form.radius, 1e-300)
                    effects[: len(share)] += np.where(crossing, np.nan_to_num(share), 0.0)
        found = evaluate(self._formulas, env, ops=INTERVALS, end=self._end)
        low, high = (
            np.min([np.broadcast_to(end[0], batch) for end in ends], axis=0)
            for ends in zip(*((each.low, each.high) for each in found), strict=True)
        )
        return BoxVerdicts(low, high, effects.T)

    def _sample(self, history: Mapping[str, Sequence[Forms]], at: int) -> dict[str, Forms]:
        """Forms that the numbers read at a sample; what lies outside of the signals is undefined."""
        like = next(iter(history.values()))[0].centre
        env: dict[str, Forms] = {}
        for name in self._program.columns:
            if name == ir.ELAPSED:
                env[name] = Forms.point(np.full(like.shape, float(at)))
                continue
            shifted = self._program.shifted.get(name)
            forms = history[name if shifted is None else shifted.name]
            place = at if shifted is None else at + shifted.steps
            if shifted is not None and shifted.clamped:
                place = min(max(place, 0), len(forms) - 1)
            if not 0 <= place < len(forms):
                env[name] = Forms.between(like * np.nan, like * np.nan)
            elif self._apart and place != at:
                bound = forms[place].range
                env[name] = Forms.between(bound.low, bound.high)
            else:
                env[name] = forms[place]
        return env or {"": Forms.point(np.zeros_like(like))}
