"""Decomposition of a formula into columns (time series) that grow sample by sample.

Each predicate becomes a column of robustness values. Each unbounded past operator becomes a column that is
computed recursively from its previous value. What remains is a formula over these columns; its past windows
are bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import columns as names_of_columns
from stlc.compile.ir.support import farthest, history, reach
from stlc.compile.ir.traverse import map_children, nodes, numbers, operands

RecursiveOp: TypeAlias = Literal["once", "historically", "since", "trigger"]


class EndlessError(Exception):
    """Error: a formula cannot be evaluated in bounded memory, because it needs the whole trace."""


@dataclass(frozen=True, slots=True)
class PredicateColumn:
    """Column (time series) of the robustness of a predicate, computed from the signals.

    Attributes:
        name: name of the column.
        formula: a predicate, or a `freeze` around one formula.
        back: lookback in samples.
        ahead: lookahead in samples.
    """

    name: str
    formula: ir.Formula
    back: int
    ahead: int


@dataclass(frozen=True, slots=True)
class RecursiveColumn:
    """Column (time series) of an unbounded past operator, computed recursively from its previous value.

    With the previous value `last`, `once` is max(body, last), and `since` is min(left, max(right, last)).
    `historically` and `trigger` are the same with min and max exchanged.

    Attributes:
        name: name of the column.
        op: the past operator.
        parts: operands of the operator, as formulas over other columns.
        back: lookback of the operands in rows.
        ahead: lookahead of the operands in rows.
    """

    name: str
    op: RecursiveOp
    parts: tuple[ir.Formula, ...]
    back: int
    ahead: int


DerivedColumn: TypeAlias = PredicateColumn | RecursiveColumn


@dataclass(frozen=True, slots=True)
class ColumnPlan:
    """Decomposition of a formula into columns (time series of predicates and of unbounded past operators).

    Attributes:
        formula: the formula, in which columns replace the predicates and unbounded past operators.
        streams: the columns; each one depends only on signals and on columns before it.
        lag: number of rows at the end of the columns that later samples may still change.
    """

    formula: ir.Formula
    streams: tuple[DerivedColumn, ...]
    lag: int


def _lag(streams: Sequence[DerivedColumn]) -> int:
    lags: dict[str, int] = {}
    for stream in streams:
        before = max((lags[name] for name in read_by(stream)), default=0)
        lags[stream.name] = stream.ahead + before
    return max(lags.values(), default=0)


def read_by(stream: DerivedColumn) -> frozenset[str]:
    """Return the names of the columns (time series) from which a column is computed."""
    parts = () if isinstance(stream, PredicateColumn) else stream.parts
    return frozenset().union(*map(names_of_columns, parts))


def endless(formula: ir.Formula) -> bool:
    """True if the formula has an unbounded future window."""
    windowed = (node for node in nodes(formula) if isinstance(node, ir.Windowed))
    return any(node.window.hi is None and not node.back for node in windowed)


def column(name: str) -> ir.Predicate:
    """Return a predicate whose value is the value of the column (time series) `name`."""
    return ir.Predicate(ir.Signal(name))


# ------------------------------------------------------------------------- planning


def plan(formula: ir.Formula) -> ColumnPlan:
    """Split a formula into columns (time series of predicates and past operators) and a formula over them.

    Raises:
        EndlessError: the formula cannot be evaluated without the whole trace.
    """
    planner = _Planner()
    over_columns = planner.over_columns(formula)
    streams = tuple(planner.streams.values())
    return ColumnPlan(over_columns, streams, _lag(streams))


@dataclass(slots=True)
class _Planner:
    streams: dict[object, DerivedColumn] = field(default_factory=dict)

    def over_columns(self, formula: ir.Formula) -> ir.Formula:
        """Replace predicates and unbounded past operators by columns, which are added to `streams`."""
        match formula:
            case ir.Predicate():
                return self._leaf(formula)
            case ir.Freeze():
                return self._frozen(formula)
            case ir.AtStart():
                raise EndlessError
            case ir.PastTemporal() | ir.Since():
                return self._past(map_children(formula, formulas=self.over_columns))
            case _:
                return map_children(formula, formulas=self.over_columns)

    def _leaf(self, formula: ir.Formula) -> ir.Formula:
        if formula not in self.streams:
            ahead, reads = reach(formula).future, looks_on(formula)
            ahead = max(ahead, reads) if isinstance(formula, ir.Predicate) else ahead + reads
            self.streams[formula] = PredicateColumn(f"#{len(self.streams)}", formula, history(formula), ahead)
        return column(self.streams[formula].name)

    def _frozen(self, formula: ir.Freeze) -> ir.Formula:
        for node in nodes(formula):
            if isinstance(node, ir.AtStart) or (isinstance(node, ir.Windowed) and node.window.hi is None):
                raise EndlessError
        return self._leaf(formula)

    def _past(self, formula: ir.PastTemporal | ir.Since) -> ir.Formula:
        """Rewrite a past operator whose operands are formulas over columns.

        An unbounded operator `op[a, inf)` is replaced by the column of `op[0, inf)`, read `a` samples
        earlier.
        """
        if formula.window.hi is not None:
            return formula
        value, first = self._recursive(formula.op, operands(formula)), formula.window.lo
        if not first:
            return value
        dual = formula.op in ("historically", "trigger")
        earlier = ir.Shift(-first, value, outside=dual)
        if isinstance(formula, ir.PastTemporal):
            return earlier
        recent = ir.PastTemporal("once" if dual else "historically", ir.Window(0, first - 1), formula.left)
        return ir.BoolOp("or" if dual else "and", (recent, earlier))

    def _recursive(self, op: RecursiveOp, parts: tuple[ir.Formula, ...]) -> ir.Formula:
        if any(map(endless, parts)):
            raise EndlessError
        key = (op, parts)
        if key not in self.streams:
            back, ahead = max(map(history, parts)), max(reach(part).future for part in parts)
            self.streams[key] = RecursiveColumn(f"#{len(self.streams)}", op, parts, back, ahead)
        return column(self.streams[key].name)


def looks_on(formula: ir.Formula) -> int:
    """Return how far ahead the predicates of a formula read signals, in samples.

    The distance is counted from the instant at which a predicate is evaluated. The result is the greatest
    distance over all predicates.
    """
    return max((farthest(num).future for num in numbers(formula)), default=0)
