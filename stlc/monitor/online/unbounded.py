"""Windows to the end of the trace, evaluated at its first sample in bounded memory.

The value is a monotone function of the values of the unbounded operators from a frontier on: a lattice
polynomial. Its coefficients are its values where each operator is -inf or +inf, which are the formula on
the samples up to the frontier, with each unbounded operator continued by that constant.
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
    """A formula without unbounded windows, read some samples after its instant."""

    formula: ir.Formula
    steps: int

    @property
    def reach(self) -> int:
        """Lookahead in samples."""
        return self.steps + reach(self.formula).future


@dataclass(slots=True)
class UnboundedOperators:
    """The unbounded operators of a formula over columns `$0`, `$1`, …; each with `lo` 0.

    The value of an operator after the last row, its rest, is a column of its own, `!0`, `!1`, ….

    Attributes:
        root: the formula.
        parts: column -> the formula that it stands for.
        origins: rest -> its operator, before the lower bound was removed.
        operators: rest -> its operator over columns, the rest among them.
    """

    root: ir.Formula
    parts: dict[str, DelayedFormula] = field(default_factory=dict)
    origins: dict[str, DelayedFormula] = field(default_factory=dict)
    operators: dict[str, ir.Formula] = field(default_factory=dict)

    @property
    def reach(self) -> int:
        """Samples after an instant that have to be known before it enters a polynomial."""
        return max((part.reach for part in (*self.parts.values(), *self.origins.values())), default=0)

    def unsure(self, plan: ColumnPlan) -> int:
        """Number of unknown samples after which one more makes no difference."""
        streams = sum(stream.back + stream.ahead for stream in plan.streams)
        return self.reach + self.back + streams + 1

    @property
    def back(self) -> int:
        """Lookback of the parts in rows."""
        return max((history(part.formula) for part in self.parts.values()), default=0)


def skeleton(formula: ir.Formula) -> UnboundedOperators:
    """Decompose a formula over columns.

    Raises:
        EndlessError: an unbounded operator stands under a bounded one, or there are too many.
    """
    found = UnboundedOperators(formula)
    found.root = _taken(formula, 0, found)
    if len(found.origins) > _MOST:
        raise EndlessError
    return found


def _taken(formula: ir.Formula, steps: int, found: UnboundedOperators) -> ir.Formula:
    """The formula `steps` samples later, over columns."""
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
    """Column with the value of an operator from the last row on.

    Operators that read the same columns may still differ at the end of the trace: `next (always p)` and
    `always (next p)` are not equal there.
    """
    return _column_of(origin, found.origins, "!")


def _column_of(formula: DelayedFormula, columns: dict[str, DelayedFormula], prefix: str) -> str:
    """The name of the column of a formula, added where there is none."""
    for name, known in columns.items():
        if known == formula:
            return name
    columns[f"{prefix}{len(columns)}"] = formula
    return f"{prefix}{len(columns) - 1}"


def _met(node: ir.Until, steps: int, found: UnboundedOperators) -> ir.Formula:
    """`until` without a lower bound: met within the rows, or its left side holds there and it is met later.

    For `release` the dual.
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
    """The value of the rest of an operator at the end of the trace: nothing more is met, nothing fails."""
    assert isinstance(origin.formula, (ir.Temporal, ir.Until))
    return math.inf if origin.formula.op in ("always", "release") else -math.inf


@dataclass(slots=True)
class UnboundedState:
    """The value of a formula at its first sample: its least or its greatest.

    Attributes:
        bones: the formula.
        side: the columns.
        begin: the sample at which the formula is evaluated.
        at: number of the first sample that is not yet in the polynomial.
        coefficients: (subsets of the operators, traces): the value where those operators are +inf from
            `at` on and the others -inf; None before the first `advance`.
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
        """Fold the samples before `settled` into the polynomial."""
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
        """The value while the trace continues, followed by as many unknown samples as affect the formula."""
        env = self._columns(samples - self.at + self._unsure)
        for name, origin in self.bones.origins.items():
            env[name] = np.full(env[NOTHING].shape, _neutral(origin))
        found = self._first(env)
        return found if self.coefficients is None else self._at(found[:, None])

    def ended(self, formula: ir.Formula, samples: int) -> Floats:
        """The value with the last sample as the end of the trace."""
        if self.coefficients is None:
            return self._plain(formula, self.begin, samples)
        origins = self.bones.origins.values()
        rests = [self._plain(origin.formula, self.at + origin.steps, samples) for origin in origins]
        return self._at(np.stack(rests))

    def _first(self, env: Mapping[str, Floats]) -> Floats:
        """Values at the frontier, one row each: of the formula, or with a polynomial of the operators."""
        reader = self._root if self.coefficients is None else self._operators
        return np.concatenate(reader(env, 0, 1))

    def _plain(self, formula: ir.Formula, at: int, samples: int) -> Floats:
        """A formula over columns at one sample, unbounded windows clipped at the last sample."""
        parts: dict[str, DelayedFormula] = {}
        plain = _outlined(formula, parts)
        first = min(self.at, at)
        reader = ColumnReader([part.formula for part in parts.values()], self.side.end)
        found = self.side.values(reader, first, samples - first) if parts else []
        env = dict(zip(parts, found, strict=True))
        env[NOTHING] = np.zeros((samples - first, self.side.rows[NOTHING].shape[1]))
        return ColumnReader([plain], self.side.end)(env, at - first, 1)[0]

    def _columns(self, count: int) -> dict[str, Floats]:
        """The parts at the next `count` samples."""
        env = {NOTHING: np.zeros((count, self.side.rows[NOTHING].shape[1]))}
        for steps, (names, reader) in self._parts.items():
            env |= zip(names, self.side.values(reader, self.at + steps, count), strict=True)
        return env

    def _at(self, rests: Floats) -> Floats:
        """The polynomial at the operators' values `rests` (operators, points, traces): a row per point."""
        assert self.coefficients is not None
        worth = np.where(self._chosen[:, :, None, None], rests, math.inf).min(axis=1, initial=math.inf)
        return np.asarray(np.minimum(worth, self.coefficients[:, None]).max(axis=0))


def _outlined(formula: ir.Formula, parts: dict[str, DelayedFormula]) -> ir.Formula:
    """The formula with columns for all parts without unbounded windows."""
    if not endless(formula):
        return _part(formula, 0, UnboundedOperators(formula, parts))
    match formula:
        case ir.BoolOp() | ir.Shift() | ir.Temporal() | ir.Until():
            return map_children(formula, formulas=lambda part: _outlined(part, parts))
        case _:
            raise EndlessError
