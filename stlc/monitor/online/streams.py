"""Decomposition of a formula into columns (time series) that grow sample by sample.

Each predicate becomes a column of robustness values. Each unbounded past operator becomes a column that is
computed recursively from its previous value. What remains is a formula over these columns; its past windows
are bounded.
"""

from __future__ import annotations

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
class DerivedColumn:
    """Column (time series) of robustness values of a predicate or of an unbounded past operator.

    A past operator is computed recursively. With the previous value `last`, `once` is max(body, last), and
    `since` is min(left, max(right, last)). `historically` and `trigger` are the same with min and max
    exchanged.

    Attributes:
        name: name of the column.
        op: the past operator; None for a predicate, or a `freeze` around one formula.
        parts: operands of the past operator, as formulas over other columns, or the predicate.
        back: lookback of `parts` in samples.
        ahead: lookahead of `parts` in samples.
    """

    name: str
    op: RecursiveOp | None
    parts: tuple[ir.Formula, ...]
    back: int
    ahead: int

    @property
    def reads(self) -> frozenset[str]:
        """Names of the columns from which this one is computed; a predicate is computed from signals."""
        return frozenset().union(*map(names_of_columns, self.parts if self.op else ()))

    @property
    def pointwise(self) -> bool:
        """True for a predicate that reads signals only at the sample at which it is evaluated."""
        return not (self.op or self.back or self.ahead or isinstance(self.parts[0], ir.Freeze))


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


def endless(formula: ir.Formula) -> bool:
    """True if the formula has an unbounded future window."""
    windowed = (node for node in nodes(formula) if isinstance(node, ir.Windowed))
    return any(node.window.hi is None and not node.back for node in windowed)


def unbounded(formula: ir.Formula) -> bool:
    """True if the formula has an unbounded window, in the future or in the past."""
    return any(isinstance(node, ir.Windowed) and node.window.hi is None for node in nodes(formula))


def column(name: str) -> ir.Predicate:
    """Return a predicate whose value is the value of the column (time series) `name`."""
    return ir.Predicate(ir.Signal(name))


def looks_on(formula: ir.Formula) -> int:
    """Greatest lookahead of a predicate in samples, from the instant at which it is evaluated."""
    return max((farthest(num).future for num in numbers(formula)), default=0)


def plan(formula: ir.Formula) -> ColumnPlan:
    """Split a formula into columns (time series of predicates and past operators) and a formula over them.

    Raises:
        EndlessError: the formula cannot be evaluated without the whole trace.
    """
    planner = _Planner()
    over_columns = planner.over_columns(formula)
    streams = tuple(planner.streams.values())
    lags: dict[str, int] = {}
    for stream in streams:
        lags[stream.name] = stream.ahead + max((lags[name] for name in stream.reads), default=0)
    return ColumnPlan(over_columns, streams, max(lags.values(), default=0))


@dataclass(slots=True)
class _Planner:
    streams: dict[object, DerivedColumn] = field(default_factory=dict)

    def over_columns(self, formula: ir.Formula) -> ir.Formula:
        """Replace predicates and unbounded past operators by columns, which are added to `streams`."""
        match formula:
            case ir.Predicate():
                return self._column(None, (formula,), max(reach(formula).future, looks_on(formula)))
            case ir.Freeze():
                if unbounded(formula) or any(isinstance(node, ir.AtStart) for node in nodes(formula)):
                    raise EndlessError
                return self._column(None, (formula,), reach(formula).future + looks_on(formula))
            case ir.AtStart():
                raise EndlessError
            case ir.PastTemporal(window=ir.Window(hi=None)) | ir.Since(window=ir.Window(hi=None)):
                return self._past(map_children(formula, formulas=self.over_columns))
            case _:
                return map_children(formula, formulas=self.over_columns)

    def _past(self, formula: ir.PastTemporal | ir.Since) -> ir.Formula:
        """Replace `op[a, inf)` over columns by the column of `op[0, inf)`, read `a` samples earlier."""
        parts, first = operands(formula), formula.window.lo
        if any(map(endless, parts)):
            raise EndlessError
        value = self._column(formula.op, parts, max(reach(part).future for part in parts))
        if not first:
            return value
        dual = formula.op in ("historically", "trigger")
        earlier = ir.Shift(-first, value, outside=dual)
        if isinstance(formula, ir.PastTemporal):
            return earlier
        recent = ir.PastTemporal("once" if dual else "historically", ir.Window(0, first - 1), formula.left)
        return ir.BoolOp("or" if dual else "and", (recent, earlier))

    def _column(self, op: RecursiveOp | None, parts: tuple[ir.Formula, ...], ahead: int) -> ir.Predicate:
        if (op, parts) not in self.streams:
            name = f"#{len(self.streams)}"
            self.streams[op, parts] = DerivedColumn(name, op, parts, max(map(history, parts)), ahead)
        return column(self.streams[op, parts].name)
