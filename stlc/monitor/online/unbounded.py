"""Formulas with windows to the end of the trace, evaluated at one sample in bounded memory.

The trace is divided at a sample called the frontier. Example: the robustness of `always p` is the minimum of
two numbers. The first is the least robustness of p before the frontier. It is known, and takes constant
memory. The second is the robustness of `always p` from the frontier on. It may still change.

In general, the value of the formula is a function of several unknown numbers, called variables. Each variable
is the value that one of the unbounded operators has from the frontier on. The function consists of minima and
maxima only. It is therefore determined by its values, called coefficients, for variables that are +inf or
-inf. There is one coefficient for each subset of the variables: the variables in the subset are +inf, and all
others are -inf. The coefficients depend only on the samples before the frontier, so these samples can be
dropped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import history, reach
from stlc.compile.ir.traverse import map_children
from stlc.monitor.online.columns import NOTHING, ColumnReader, Side
from stlc.monitor.online.history import Floats
from stlc.monitor.online.streams import ColumnPlan, EndlessError, column, endless

_MOST = 6
"""Greatest number n of unbounded operators; there are 2^n coefficients."""

_FOREVER = ir.Window(0, None)


class DelayedFormula(NamedTuple):
    """A formula that is evaluated `steps` samples after an instant."""

    formula: ir.Formula
    steps: int

    @property
    def reach(self) -> int:
        """Lookahead in samples."""
        return self.steps + reach(self.formula).future


@dataclass(slots=True)
class UnboundedOperators:
    """Decomposition of a formula into its unbounded future operators and its other subformulas.

    A column is a time series of values. Columns `$0`, `$1`, … replace the subformulas without unbounded
    operators. Columns `!0`, `!1`, … hold what the samples not yet received contribute to the values of the
    unbounded operators. Operators are rewritten so that their windows begin at 0.

    Attributes:
        root: the formula over columns.
        parts: subformula -> the column `$k` that replaces it.
        origins: operator of the formula, with the original window -> its column `!k`. Two operators share a
            column only if they are written in the same way: `next (always p)` and `always (next p)` read the
            same samples, but their values differ at the end of the trace.
        operators: column `!k` -> formula for the value of its operator. The formula combines the columns
            `$0`, `$1`, … (samples received) with the column `!k` (later samples).
    """

    root: ir.Formula
    parts: dict[DelayedFormula, str] = field(default_factory=dict)
    origins: dict[DelayedFormula, str] = field(default_factory=dict)
    operators: dict[str, ir.Formula] = field(default_factory=dict)

    @property
    def reach(self) -> int:
        """Lookahead in samples of the subformulas and operators, without their unbounded windows."""
        return max((part.reach for part in (*self.parts, *self.origins)), default=0)

    @property
    def back(self) -> int:
        """Lookback in rows of the subformulas without unbounded windows."""
        return max((history(part.formula) for part in self.parts), default=0)

    def unsure(self, plan: ColumnPlan) -> int:
        """Number of unknown samples to append before bounds are computed; more would not change them."""
        return self.reach + self.back + sum(stream.back + stream.ahead for stream in plan.streams) + 1

    def over_columns(self, formula: ir.Formula, steps: int) -> ir.Formula:
        """Return `formula`, evaluated `steps` samples after an instant, as a formula over columns.

        Missing columns are added. Raises EndlessError if an unbounded operator is inside a bounded one.
        """
        if not endless(formula):
            return self.part(formula, steps)
        match formula:
            case ir.BoolOp(op, items):
                return ir.BoolOp(op, tuple(self.over_columns(item, steps) for item in items))
            case ir.Shift(later, body, None) if later >= 0:
                return self.over_columns(body, steps + later)
            case ir.Temporal(op, ir.Window(lo, None), body):
                seen = ir.Temporal(op, _FOREVER, self.over_columns(body, steps + lo))
                name = self._rest(formula, steps)
                self.operators[name] = ir.BoolOp("and" if op == "always" else "or", (seen, column(name)))
                return self.operators[name]
            case ir.Until(op, ir.Window(lo, None), left, right):
                if lo and endless(left):
                    raise EndlessError
                # An `until` is true if the samples received satisfy it, or if its left side is true on all of
                # these and the later samples satisfy it. For `release`, exchange `and` and `or`.
                until, node = op == "until", ir.Until(op, _FOREVER, left, right)
                first, last = self.over_columns(left, steps + lo), self.over_columns(right, steps + lo)
                name = self._rest(node, steps + lo)
                throughout = ir.Temporal("always" if until else "eventually", _FOREVER, first)
                rest = ir.BoolOp("and" if until else "or", (throughout, column(name)))
                met = ir.BoolOp("or" if until else "and", (replace(node, left=first, right=last), rest))
                self.operators[name] = met
                if not lo:
                    return met
                before = self.part(replace(throughout, window=ir.Window(0, lo - 1), body=left), steps)
                return replace(rest, items=(before, met))
            case _:
                raise EndlessError

    def _rest(self, operator: ir.Formula, steps: int) -> str:
        return self.origins.setdefault(DelayedFormula(operator, steps), f"!{len(self.origins)}")

    def part(self, formula: ir.Formula, steps: int) -> ir.Formula:
        """Return the column of a subformula without unbounded operators."""
        if isinstance(formula, ir.Truth):
            return formula
        return column(self.parts.setdefault(DelayedFormula(formula, steps), f"${len(self.parts)}"))

    def outlined(self, formula: ir.Formula) -> ir.Formula:
        """Replace all subformulas without unbounded operators by columns; unbounded operators stay."""
        if not endless(formula):
            return self.part(formula, 0)
        if isinstance(formula, (ir.BoolOp, ir.Shift, ir.Temporal, ir.Until)):
            return map_children(formula, formulas=self.outlined)
        raise EndlessError


def skeleton(formula: ir.Formula) -> UnboundedOperators:
    """Separate the unbounded operators of a formula from its other subformulas.

    Raises:
        EndlessError: an unbounded operator occurs inside a bounded one, or there are too many unbounded
            operators.
    """
    found = UnboundedOperators(formula)
    found.root = found.over_columns(formula, 0)
    if len(found.origins) > _MOST:
        raise EndlessError
    return found


@dataclass(slots=True)
class UnboundedState:
    """Lower or upper bound on a formula with unbounded windows, computed incrementally.

    The samples before the frontier `at` are summarized in coefficients, as the module explains.

    Attributes:
        bones: the decomposition of the formula into its unbounded operators and its other subformulas.
        side: columns (time series) of the predicates and past operators, evaluated for the bound.
        at: the frontier, a sample. The coefficients summarize all samples before it. At first, this is the
            sample at which the formula is evaluated.
        coefficients: one row per subset of the operators, (subsets, traces). A coefficient is the value of
            the formula if the operators of the subset are +inf from `at` on, and the others -inf. None before
            the first `advance`.
    """

    bones: UnboundedOperators
    side: Side
    at: int = 0
    coefficients: Floats | None = None
    _parts: dict[int, tuple[list[str], ColumnReader]] = field(default_factory=dict, init=False)
    _root: ColumnReader = field(init=False)
    _operators: ColumnReader = field(init=False)
    _chosen: NDArray[np.bool_] = field(init=False)
    _unsure: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        for steps in dict.fromkeys(part.steps for part in self.bones.parts):
            alike = {name: part.formula for part, name in self.bones.parts.items() if part.steps == steps}
            self._parts[steps] = (list(alike), ColumnReader(list(alike.values()), self.side.end))
        self._root = ColumnReader([self.bones.root], "truncate")
        self._operators = ColumnReader(list(self.bones.operators.values()), "truncate")
        operators = len(self.bones.operators)
        self._chosen = np.arange(1 << operators)[:, None] >> np.arange(operators) & 1 == 1
        self._unsure = self.bones.unsure(self.side.plan)

    def advance(self, settled: int) -> None:
        """Move the frontier `at` to sample `settled`, and update `coefficients`.

        The samples before `settled` can then be dropped.
        """
        count = settled - self.at
        if count <= 0:
            return
        subsets = len(self._chosen)
        env = {name: np.tile(values, subsets) for name, values in self._columns(count).items()}
        like = env[NOTHING]
        for name, chosen in zip(self.bones.operators, self._chosen.T, strict=True):
            ends = np.repeat(np.where(chosen, math.inf, -math.inf), like.shape[1] // subsets)
            env[name] = np.broadcast_to(ends, like.shape)
        found = self._first(env).reshape(-1, subsets, like.shape[1] // subsets)
        self.coefficients = found[0] if self.coefficients is None else self._at(found)
        self.at = settled

    def value(self, samples: int) -> Floats:
        """The bound (traces,) after `samples` samples, while the trace continues.

        Unknown samples are appended to the received ones, and the formula is evaluated on all of them.
        """
        env = self._columns(samples - self.at + self._unsure)
        for origin, name in self.bones.origins.items():
            assert isinstance(origin.formula, ir.Windowed)
            empty = math.inf if origin.formula.op in ("always", "release") else -math.inf
            env[name] = np.full(env[NOTHING].shape, empty)
        found = self._first(env)
        return found if self.coefficients is None else self._at(found[:, None])

    def ended(self, formula: ir.Formula, samples: int) -> Floats:
        """Value (traces,) of `formula` if the trace ends after `samples` samples."""
        if self.coefficients is None:
            return self._plain(formula, self.at, samples)
        rests = [self._plain(each.formula, self.at + each.steps, samples) for each in self.bones.origins]
        return self._at(np.stack(rests))

    def _first(self, env: Mapping[str, Floats]) -> Floats:
        """Values at sample `at` of all unbounded operators, or, before `advance`, of the whole formula."""
        reader = self._root if self.coefficients is None else self._operators
        return np.concatenate(reader(env, 0, 1))

    def _plain(self, formula: ir.Formula, at: int, samples: int) -> Floats:
        """Value (traces,) of a formula at sample `at`, with unbounded windows clipped at the last sample."""
        found = UnboundedOperators(formula)
        plain, first = found.outlined(formula), min(self.at, at)
        env = {NOTHING: np.zeros((samples - first, self.side.rows[NOTHING].shape[1]))}
        if found.parts:
            reader = ColumnReader([part.formula for part in found.parts], self.side.end)
            values = self.side.values(reader, first, samples - first)
            env |= zip(found.parts.values(), values, strict=True)
        return ColumnReader([plain], self.side.end)(env, at - first, 1)[0]

    def _columns(self, count: int) -> dict[str, Floats]:
        """Values (count, traces) of all subformulas without unbounded windows, from sample `at` on."""
        env = {NOTHING: np.zeros((count, self.side.rows[NOTHING].shape[1]))}
        for steps, (names, reader) in self._parts.items():
            env |= zip(names, self.side.values(reader, self.at + steps, count), strict=True)
        return env

    def _at(self, rests: Floats) -> Floats:
        """Return the values (points, traces) of the formula for values `rests` of the unbounded operators.

        `rests`, (operators, points, traces), are the values from the frontier on.
        """
        assert self.coefficients is not None
        worth = np.where(self._chosen[:, :, None, None], rests, math.inf).min(axis=1, initial=math.inf)
        return np.asarray(np.minimum(worth, self.coefficients[:, None]).max(axis=0))
