"""Decomposition of a formula into columns that can grow sample by sample.

Predicates become columns of robustness values. An unbounded past operator becomes a column that is
continued from its last value. The remaining formula over columns has bounded windows only.
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
    """The formula needs unbounded memory: a past operator reads a value that only the end decides."""


@dataclass(frozen=True, slots=True)
class PredicateColumn:
    """Column that follows from the signals: the robustness of a predicate.

    Attributes:
        name: of the column.
        formula: a predicate, or a `freeze` around one.
        back: lookback in samples.
        ahead: lookahead in samples.
    """

    name: str
    formula: ir.Formula
    back: int
    ahead: int


@dataclass(frozen=True, slots=True)
class RecursiveColumn:
    """Column that continues from its last value: a past operator from the start of the trace on.

    `once`: max(body, last). `since`: min(left, max(right, last)); the others are their duals.

    Attributes:
        name: of the column.
        op: which operator.
        parts: its operands, over other columns.
        back: lookback of the operands in rows.
        ahead: their lookahead in rows.
    """

    name: str
    op: RecursiveOp
    parts: tuple[ir.Formula, ...]
    back: int
    ahead: int


DerivedColumn: TypeAlias = PredicateColumn | RecursiveColumn


@dataclass(frozen=True, slots=True)
class ColumnPlan:
    """A formula over columns, and the columns in order of dependency.

    Attributes:
        formula: over the columns.
        streams: the columns.
        lag: for how many samples the last rows of a column may still change.
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
    """Return the names of the columns that a column reads."""
    parts = () if isinstance(stream, PredicateColumn) else stream.parts
    return frozenset().union(*map(names_of_columns, parts))


def endless(formula: ir.Formula) -> bool:
    """True if the formula has an unbounded future window."""
    windowed = (node for node in nodes(formula) if isinstance(node, ir.Windowed))
    return any(node.window.hi is None and not node.back for node in windowed)


def column(name: str) -> ir.Predicate:
    """Return a column as a formula."""
    return ir.Predicate(ir.Signal(name))


# ------------------------------------------------------------------------- planning


def plan(formula: ir.Formula) -> ColumnPlan:
    """Decompose a formula into columns.

    Raises:
        EndlessError: it needs the whole trace.
    """
    planner = _Planner()
    over_columns = planner.over_columns(formula)
    streams = tuple(planner.streams.values())
    return ColumnPlan(over_columns, streams, _lag(streams))


@dataclass(slots=True)
class _Planner:
    streams: dict[object, DerivedColumn] = field(default_factory=dict)

    def over_columns(self, formula: ir.Formula) -> ir.Formula:
        """The formula with columns for predicates and for unbounded past operators."""
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
        """A past operator over columns; an unbounded one becomes a column, read where its window ends."""
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
    """Return the lookahead of the predicates: samples that may be missing at the end of the trace."""
    return max((farthest(num).future for num in numbers(formula)), default=0)
