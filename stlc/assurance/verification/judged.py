"""Bounds on robustness from affine forms of the signals.

The numbers in the predicates are evaluated over the forms of each sample, so that the distance of two
positions that depend on the same symbols is as narrow as it is, and over their ranges; the intersection is
taken. The formulas are then evaluated over intervals, by the evaluator of `stlc check --uncertain`
(`docs/decisions/0051-intervals.md`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stlc.assurance.verification.forms import FORMS, Floats, Forms, in_use, over_time, ranges, spread
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.interval import Intervals
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.backends.schedule import Boundary
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.tolerance import TOLERANCE

PROVED = 0.5 * TOLERANCE
"""A lower bound on robustness of at least -`PROVED` is a proof: the monitor takes -1e-6 as satisfied."""

_NAME = "#predicate{}"

_ROOM = 1 << 18
"""Numbers of a form over time: the samples that are evaluated at once are as many as have so many."""


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
        shifts: whether numbers that read several samples are evaluated over forms, or over ranges alone.
    """

    def __init__(
        self,
        formulas: Sequence[ir.Formula],
        *,
        end: Boundary = "strict",
        apart: bool = False,
        shifts: bool = True,
    ) -> None:
        self._end, self._apart, self._shifts = end, apart, shifts
        self._numbers: dict[ir.Num, str] = {}
        self._formulas = [self._named(formula) for formula in formulas]
        self._program = ArrayProgram({name: num for num, name in self._numbers.items()})
        self._read = frozenset(name for formula in self._formulas for name, *_ in formula.reads())

    def _named(self, formula: ir.Formula) -> ir.Formula:
        """The formula with a signal for the number of each predicate that is evaluated over forms."""
        if isinstance(formula, ir.Predicate):
            if formula.frozen or (formula.shifted and not self._shifts):
                return formula
            name = self._numbers.setdefault(formula.num, _NAME.format(len(self._numbers)))
            return replace(formula, num=ir.Signal(name))
        found: ir.Formula = formula.map_children(formulas=self._named)
        return found

    def __call__(self, history: Mapping[str, Sequence[Forms]], symbols: int) -> BoxVerdicts:
        """Bounds on all formulas together; `symbols` is the number of effects. See `bounds`."""
        effects = np.full((symbols, *next(iter(history.values()))[0].shape), 1e-12)
        found = self.bounds(history, effects)
        return BoxVerdicts(found.low.min(0), found.high.min(0), effects.T)

    def bounds(self, history: Mapping[str, Sequence[Forms]], effects: Floats | None = None) -> Intervals:
        """Bounds on the robustness of each formula, (formulas, batch).

        Args:
            history: name of a signal -> one form (batch,) per sample.
            effects: effects of the first symbols on the undecided predicates, (symbols, batch), to which
                those of these signals are added.
        """
        first = next(iter(history.values()))
        samples, batch = len(first), len(first[0].centre)
        env = {
            name: ranges(forms) for name, forms in history.items() if name in self._read or not self._numbers
        }
        if self._numbers:
            width = max(in_use(forms) for forms in history.values()) * batch
            size = max(_ROOM // max(width, 1), 1)
            parts = [
                self._margins(history, range(at, min(at + size, samples)), batch, effects)
                for at in range(0, samples, size)
            ]
            for name in self._numbers.values():
                low, high = (
                    np.concatenate([getattr(part[name], end) for part in parts]) for end in ("low", "high")
                )
                env[name] = Intervals(low, high)
        found = evaluate(self._formulas, env, ops=INTERVALS, end=self._end)
        low, high = (
            np.stack([np.broadcast_to(end[0], batch) for end in ends])
            for ends in zip(*((each.low, each.high) for each in found), strict=True)
        )
        return Intervals(low, high)

    def _margins(
        self, history: Mapping[str, Sequence[Forms]], at: range, batch: int, effects: Floats | None
    ) -> dict[str, Intervals]:
        """Intervals of the numbers at the samples `at`, (samples, batch); their effects are added."""
        forms = {
            name: over_time([self._form(history, name, i) for i in at]) for name in self._program.columns
        }
        forms = forms or {"": Forms.point(np.zeros((len(at), batch)))}
        linear = self._program(forms, FORMS)
        plain = self._program({name: form.range for name, form in forms.items()}, INTERVALS)
        found = {}
        for name in self._numbers.values():
            form, bound = spread(linear[name], len(at), batch), plain[name]
            own = form.range
            low = np.fmax(bound.low, own.low)  # one is NaN where it alone cannot exclude undefined values
            high = np.maximum(np.fmin(bound.high, own.high), low)
            found[name] = Intervals(low, high)
            crossing = ~((low >= 0.0) | (high <= 0.0))
            if effects is not None and crossing.any():  # shares in the radius where both signs may occur
                share = np.abs(form.generators[: len(effects)]) / np.maximum(form.radius, 1e-300)
                effects[: len(share)] += np.where(crossing, np.nan_to_num(share), 0.0).sum(1)
        return found

    def _form(self, history: Mapping[str, Sequence[Forms]], name: str, at: int) -> Forms:
        """Form that the numbers read as `name` at a sample; what lies outside of the signals is undefined."""
        like = next(iter(history.values()))[0].centre
        if name == ir.ELAPSED:
            return Forms.point(np.full(like.shape, float(at)))
        shifted = self._program.shifted.get(name)
        if shifted is None:
            return history[name][at]
        forms, place = history[shifted.name], at + shifted.steps
        if shifted.clamped:
            place = min(max(place, 0), len(forms) - 1)
        if not 0 <= place < len(forms):
            return Forms.between(like * np.nan, like * np.nan)
        if self._apart and place != at:
            return Forms.between(forms[place].range.low, forms[place].range.high)
        return forms[place]
