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
from stlc.compile.ir.support import history, reach
from stlc.compile.ir.traverse import leaves as readings
from stlc.compile.ir.traverse import map_children, nodes, numbers

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
    """Names of the columns that a stream reads."""
    return (
        frozenset()
        if isinstance(stream, PredicateColumn)
        else frozenset().union(*map(names_of_columns, stream.parts))
    )


def endless(formula: ir.Formula) -> bool:
    """True if the formula has an unbounded future window."""
    windowed = (node for node in nodes(formula) if isinstance(node, ir.Windowed))
    return any(node.window.hi is None and not node.back for node in windowed)


def column(name: str) -> ir.Predicate:
    """A column as a formula."""
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
            case ir.PastTemporal(op, window, body):
                return self._past(op, window, self.over_columns(body))
            case ir.Since(op, window, left, right):
                return self._since(op, window, self.over_columns(left), self.over_columns(right))
            case _:
                return map_children(formula, formulas=self.over_columns)

    def _leaf(self, formula: ir.Formula) -> ir.Formula:
        if formula not in self.streams:
            ahead = reach(formula).future
            ahead = (
                max(ahead, looks_on(formula))
                if isinstance(formula, ir.Predicate)
                else ahead + looks_on(formula)
            )
            self.streams[formula] = PredicateColumn(f"#{len(self.streams)}", formula, history(formula), ahead)
        return column(self.streams[formula].name)

    def _frozen(self, formula: ir.Formula) -> ir.Formula:
        if endless(formula) or any(
            unbounded_past(node) or isinstance(node, ir.AtStart) for node in nodes(formula)
        ):
            raise EndlessError
        return self._leaf(formula)

    def _latched(self, op: RecursiveOp, *parts: ir.Formula) -> ir.Formula:
        if any(map(endless, parts)):
            raise EndlessError
        key = (op, parts)
        if key not in self.streams:
            back, ahead = max(map(history, parts)), max(reach(part).future for part in parts)
            self.streams[key] = RecursiveColumn(f"#{len(self.streams)}", op, parts, back, ahead)
        return column(self.streams[key].name)

    def _past(self, op: Literal["historically", "once"], window: ir.Window, body: ir.Formula) -> ir.Formula:
        if window.hi is not None:
            return ir.PastTemporal(op, window, body)
        return _earlier(self._latched(op, body), window.lo, neutral=op == "historically")

    def _since(
        self, op: Literal["since", "trigger"], window: ir.Window, left: ir.Formula, right: ir.Formula
    ) -> ir.Formula:
        if window.hi is not None:
            return ir.Since(op, window, left, right)
        reached = _earlier(self._latched(op, left, right), window.lo, neutral=op == "trigger")
        if not window.lo:
            return reached
        recent = ir.Window(0, window.lo - 1)
        if op == "since":
            return ir.BoolOp("and", (ir.PastTemporal("historically", recent, left), reached))
        return ir.BoolOp("or", (ir.PastTemporal("once", recent, left), reached))


def _earlier(formula: ir.Formula, steps: int, *, neutral: bool) -> ir.Formula:
    return ir.Shift(-steps, formula, outside=neutral) if steps else formula


def unbounded_past(node: ir.Formula) -> bool:
    """True if a node is a past operator with an unbounded window."""
    return isinstance(node, ir.Windowed) and node.back and node.window.hi is None


def looks_on(formula: ir.Formula) -> int:
    """Lookahead of the predicates: samples that may be missing at the end of the trace."""
    return max(0, *_offsets(formula))


def _offsets(formula: ir.Formula) -> list[int]:
    found = [
        leaf.steps for num in numbers(formula) for leaf in readings(num) if isinstance(leaf, ir.ShiftedSignal)
    ]
    return [0, *found]
