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
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import history, reach
from stlc.compile.ir.traverse import map_children
from stlc.monitor.online.columns import NOTHING, ColumnReader, Side
from stlc.monitor.online.streams import ColumnPlan, EndlessError, column, endless

Floats: TypeAlias = NDArray[np.float64]

_MOST = 6
"""Greatest number n of unbounded operators; there are 2^n coefficients."""

_FOREVER = ir.Window(0, None)


@dataclass(frozen=True, slots=True)
class DelayedFormula:
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
        parts: column `$k` -> the subformula that it replaces.
        origins: column `!k` -> its operator in the formula, with the original window.
        operators: column `!k` -> formula for the value of its operator. The formula combines the columns
            `$0`, `$1`, … (samples received) with the column `!k` (later samples).
    """

    root: ir.Formula
    parts: dict[str, DelayedFormula] = field(default_factory=dict)
    origins: dict[str, DelayedFormula] = field(default_factory=dict)
    operators: dict[str, ir.Formula] = field(default_factory=dict)

    @property
    def reach(self) -> int:
        """Greatest number of samples that a subformula or an operator reads ahead.

        Unbounded windows are not counted.
        """
        return max((part.reach for part in (*self.parts.values(), *self.origins.values())), default=0)

    def unsure(self, plan: ColumnPlan) -> int:
        """Number of unknown samples to append to the received samples before bounds are computed.

        With more unknown samples, the bounds would be the same. `plan` contains the columns (time series of
        subformulas).
        """
        streams = sum(stream.back + stream.ahead for stream in plan.streams)
        return self.reach + self.back + streams + 1

    @property
    def back(self) -> int:
        """Greatest number of rows that a subformula without unbounded windows reads back."""
        return max((history(part.formula) for part in self.parts.values()), default=0)


def skeleton(formula: ir.Formula) -> UnboundedOperators:
    """Separate the unbounded operators of a formula from its other subformulas.

    Raises:
        EndlessError: an unbounded operator occurs inside a bounded one, or there are too many unbounded
            operators.
    """
    found = UnboundedOperators(formula)
    found.root = _taken(formula, 0, found)
    if len(found.origins) > _MOST:
        raise EndlessError
    return found


def _taken(formula: ir.Formula, steps: int, found: UnboundedOperators) -> ir.Formula:
    """Return `formula`, evaluated `steps` samples after an instant, as a formula over columns.

    A column is the time series of a subformula. Columns that are missing in `found` are added to it.
    """
    if not endless(formula):
        return _part(formula, steps, found)
    match formula:
        case ir.BoolOp(op, items):
            return ir.BoolOp(op, tuple(_taken(item, steps, found) for item in items))
        case ir.Shift(later, body, None) if later >= 0:
            return _taken(body, steps + later, found)
        case ir.Temporal(op, ir.Window(lo, None), body):
            seen = ir.Temporal(op, _FOREVER, _taken(body, steps + lo, found))
            rest = _rest(DelayedFormula(formula, steps), found)
            found.operators[rest] = ir.BoolOp("and" if op == "always" else "or", (seen, column(rest)))
            return found.operators[rest]
        case ir.Until(op, ir.Window(lo, None), left, right):
            met = _met(ir.Until(op, _FOREVER, left, right), steps + lo, found)
            if not lo:
                return met
            if endless(left):
                raise EndlessError
            before = ir.Temporal("always" if op == "until" else "eventually", ir.Window(0, lo - 1), left)
            return ir.BoolOp("and" if op == "until" else "or", (_part(before, steps, found), met))
        case _:
            raise EndlessError


def _rest(origin: DelayedFormula, found: UnboundedOperators) -> str:
    """Return the name of the column that stands for the unknown value of `origin` on future samples.

    `origin` is an unbounded operator. The column is added to `found` if it is missing. Two operators share a
    column only if they are written in the same way: `next (always p)` and `always (next p)` get two columns.
    Both operators read the same samples, but their values differ at the end of the trace.
    """
    return _column_of(origin, found.origins, "!")


def _column_of(formula: DelayedFormula, columns: dict[str, DelayedFormula], prefix: str) -> str:
    """Return the name of the column of `formula`; a missing column is added to `columns`.

    The name of a new column begins with `prefix`.
    """
    for name, known in columns.items():
        if known == formula:
            return name
    columns[f"{prefix}{len(columns)}"] = formula
    return f"{prefix}{len(columns) - 1}"


def _met(node: ir.Until, steps: int, found: UnboundedOperators) -> ir.Formula:
    """Rewrite an unbounded `until` or `release`, so that received and later samples are separated.

    An `until` is true in two cases. In the first case, the samples received satisfy it. In the second case,
    its left side is true on all of these samples, and the later samples satisfy the `until`. The value of the
    `until` on later samples is unknown. A new column (time series) stands for it. For `release`, exchange
    `and` and `or`.
    """
    left, right = _taken(node.left, steps, found), _taken(node.right, steps, found)
    name = _rest(DelayedFormula(node, steps), found)
    until = node.op == "until"
    throughout = ir.Temporal("always" if until else "eventually", _FOREVER, left)
    later = ir.BoolOp("and" if until else "or", (throughout, column(name)))
    seen = ir.Until(node.op, _FOREVER, left, right)
    found.operators[name] = ir.BoolOp("or" if until else "and", (seen, later))
    return found.operators[name]


def _part(formula: ir.Formula, steps: int, found: UnboundedOperators) -> ir.Formula:
    if isinstance(formula, ir.Truth):
        return formula
    return column(_column_of(DelayedFormula(formula, steps), found.parts, "$"))


def _neutral(origin: DelayedFormula) -> float:
    """Value of an unbounded operator on an empty window: +inf for `always` and `release`, else -inf."""
    assert isinstance(origin.formula, (ir.Temporal, ir.Until))
    return math.inf if origin.formula.op in ("always", "release") else -math.inf


@dataclass(slots=True)
class UnboundedState:
    """Lower or upper bound on a formula with unbounded windows, computed incrementally.

    The samples before the frontier `at` are summarized in coefficients, as the docstring of the module
    explains. The bound is computed from these coefficients and from the values that the unbounded operators
    have from the frontier on.

    Attributes:
        bones: the decomposition of the formula into its unbounded operators and its other subformulas.
        side: columns (time series) of the predicates and past operators, evaluated for the bound.
        begin: the sample at which the formula is evaluated.
        at: the frontier, a sample. The coefficients summarize all samples before it.
        coefficients: one row per subset of the operators, (subsets, traces). A coefficient is the value of
            the formula if the operators of the subset are +inf from `at` on, and the others -inf. None before
            the first `advance`.
    """

    bones: UnboundedOperators
    side: Side
    begin: int = 0
    at: int = 0
    coefficients: Floats | None = None
    _parts: dict[int, tuple[list[str], ColumnReader]] = field(default_factory=dict, init=False)
    _root: ColumnReader = field(init=False)
    _operators: ColumnReader = field(init=False)
    _chosen: NDArray[np.bool_] = field(init=False)
    _unsure: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        for steps in dict.fromkeys(part.steps for part in self.bones.parts.values()):
            alike = {name: part.formula for name, part in self.bones.parts.items() if part.steps == steps}
            self._parts[steps] = (list(alike), ColumnReader(list(alike.values()), self.side.end))
        self._root = ColumnReader([self.bones.root], "truncate")
        self._operators = ColumnReader(list(self.bones.operators.values()), "truncate")
        operators = len(self.bones.operators)
        self._chosen = np.arange(1 << operators)[:, None] >> np.arange(operators) & 1 == 1
        self._unsure = self.bones.unsure(self.side.plan)

    def advance(self, settled: int) -> None:
        """Move the frontier `at` to sample `settled`, and update `coefficients`.

        The coefficients then summarize all samples before `settled`, so that these can be dropped. They
        describe how the value of the formula depends on the still unknown values of the unbounded operators
        from `settled` on.
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
        for name, origin in self.bones.origins.items():
            env[name] = np.full(env[NOTHING].shape, _neutral(origin))
        found = self._first(env)
        return found if self.coefficients is None else self._at(found[:, None])

    def ended(self, formula: ir.Formula, samples: int) -> Floats:
        """Value (traces,) of `formula` if the trace ends after `samples` samples."""
        if self.coefficients is None:
            return self._plain(formula, self.begin, samples)
        origins = self.bones.origins.values()
        rests = [self._plain(origin.formula, self.at + origin.steps, samples) for origin in origins]
        return self._at(np.stack(rests))

    def _first(self, env: Mapping[str, Floats]) -> Floats:
        """Values at sample `at` of all unbounded operators, one row each.

        `env` contains the columns. Before the first `advance`, there is only one row: the value of the whole
        formula.
        """
        reader = self._root if self.coefficients is None else self._operators
        return np.concatenate(reader(env, 0, 1))

    def _plain(self, formula: ir.Formula, at: int, samples: int) -> Floats:
        """Value (traces,) of a formula at sample `at`, with unbounded windows clipped at the last sample."""
        parts: dict[str, DelayedFormula] = {}
        plain = _outlined(formula, parts)
        first = min(self.at, at)
        reader = ColumnReader([part.formula for part in parts.values()], self.side.end)
        found = self.side.values(reader, first, samples - first) if parts else []
        env = dict(zip(parts, found, strict=True))
        env[NOTHING] = np.zeros((samples - first, self.side.rows[NOTHING].shape[1]))
        return ColumnReader([plain], self.side.end)(env, at - first, 1)[0]

    def _columns(self, count: int) -> dict[str, Floats]:
        """Values (count, traces) of all subformulas without unbounded windows, from sample `at` on."""
        env = {NOTHING: np.zeros((count, self.side.rows[NOTHING].shape[1]))}
        for steps, (names, reader) in self._parts.items():
            env |= zip(names, self.side.values(reader, self.at + steps, count), strict=True)
        return env

    def _at(self, rests: Floats) -> Floats:
        """Return the values (points, traces) of the formula at several points.

        A point consists of one value for each unbounded operator: its value from the frontier on. `rests`
        contains the points, (operators, points, traces). The values of the formula follow from these and
        `coefficients`.
        """
        assert self.coefficients is not None
        worth = np.where(self._chosen[:, :, None, None], rests, math.inf).min(axis=1, initial=math.inf)
        return np.asarray(np.minimum(worth, self.coefficients[:, None]).max(axis=0))


def _outlined(formula: ir.Formula, parts: dict[str, DelayedFormula]) -> ir.Formula:
    """Replace all subformulas without unbounded windows by columns (time series of their values).

    The replaced subformulas are added to `parts`.
    """
    if not endless(formula):
        return _part(formula, 0, UnboundedOperators(formula, parts))
    match formula:
        case ir.BoolOp() | ir.Shift() | ir.Temporal() | ir.Until():
            return map_children(formula, formulas=lambda part: _outlined(part, parts))
        case _:
            raise EndlessError
