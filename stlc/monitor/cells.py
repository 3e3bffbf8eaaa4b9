"""Bounds on robustness where a step of the grid holds several samples, or none.

A cell is the time from an instant of the grid to the next. Its moments are the instant itself and all
instants within at which a signal was recorded (`stlc.trace.resample.Moments`). A predicate has a least and a
greatest value in a cell; where a signal lies between two samples, each of them is a pair of bounds.

A formula is rewritten over these values. `all` is its least value in a cell, `some` its greatest, and `point`
its value at the instant itself; each has a lower and an upper bound. A window `[a, b]` from an instant covers
the cells `a` to `b - 1`, and of cell `b` the instant. Seen from another moment of a cell, it covers the cells
`a + 1` to `b - 1`, and parts of both others. Operators that compare instants (`next`, `prev`, `rise`, `fall`)
compare those of the grid, and with them everything that a step holds beyond its two ends (`edge`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.interval import Intervals
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.holes import holes_in, without_holes
from stlc.compile.namespace import Array

Floats: TypeAlias = NDArray[np.float64]
Over: TypeAlias = Literal["all", "some", "point", "edge"]

MOST_CORNERS = 5
"""Clocks of a predicate whose signals are taken before and after a moment independently of each other."""
_MOST_ITEMS = 4
"""Operands up to which the bounds on a conjunction or disjunction are the tightest."""
_DUAL: Mapping[Over, Over] = {"all": "some", "some": "all", "point": "point"}
_NAME = "@cell"


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Recorded values of signals in the cells of a grid.

    Attributes:
        times: times of the moments in seconds, (moments,).
        starts: index of the first moment of each cell, (cells,).
        before: signal -> value, or that of the sample before, (moments, batch); NaN: unknown.
        after: signal -> value, or that of the sample after; the same array where it is the same.
        clocks: signal -> number of its clock.
    """

    times: Floats
    starts: NDArray[np.int64]
    before: Mapping[str, Floats]
    after: Mapping[str, Floats]
    clocks: Mapping[str, int]
    _columns: dict[tuple[ir.Predicate, Over, bool], Floats] = field(default_factory=dict)
    _names: dict[ir.Predicate, str] = field(default_factory=dict)
    _sides: dict[tuple[ir.Formula, bool], tuple[ir.Formula, ir.Formula]] = field(default_factory=dict)

    def sides(
        self, formula: ir.Formula, env: dict[str, Array], *, loose: bool
    ) -> tuple[ir.Formula, ir.Formula]:
        """Return two formulas for a lower and an upper bound on `formula` at the instants of the grid.

        The columns that they read are added to `env`, if it holds all cells. If `loose`, every window counts
        its cells as a whole.
        """
        if (formula, loose) not in self._sides:
            low = self._bound(formula, "all" if loose else "point", lower=True, loose=loose)
            high = self._bound(formula, "some" if loose else "point", lower=False, loose=loose)
            self._sides[formula, loose] = low, high
        if len(next(iter(env.values()))) == len(self.starts):
            for (atom, over, lower), values in self._columns.items():
                env.setdefault(self._name(atom, over, lower), values)
        return self._sides[formula, loose]

    def _bound(self, formula: ir.Formula, over: Over, *, lower: bool, loose: bool) -> ir.Formula:
        """Return a formula whose value in each cell is a bound on `formula` over its moments."""

        def of(part: ir.Formula, over: Over) -> ir.Formula:
            return self._bound(part, over, lower=lower, loose=loose)

        safe: Over = "all" if lower else "some"
        match formula:
            case ir.Truth():
                return formula
            case ir.Predicate():
                return self._column(formula, over, lower)
            case ir.BoolOp(_, items) if over in ("all", "some") and not loose and (edges := _compared(items)):
                rest = tuple(item for item in items if item not in edges)
                parts = [of(item, "edge") for item in edges]
                if rest:
                    parts.append(of(replace(formula, items=rest) if len(rest) > 1 else rest[0], over))
                return replace(formula, items=tuple(parts)) if len(parts) > 1 else parts[0]
            case ir.BoolOp(op, items):
                free = over != ("some" if op == "and" else "all") or lower is (op == "or")
                if free or loose or len(items) > _MOST_ITEMS:
                    return replace(formula, items=tuple(of(item, over if free else safe) for item in items))
                choices = [
                    replace(formula, items=tuple(of(e, over if e is item else _DUAL[over]) for e in items))
                    for item in items
                ]
                return ir.BoolOp("or" if op == "and" else "and", tuple(choices))
            case ir.Temporal() | ir.PastTemporal() if not loose and over != "edge":
                return self._windowed(formula, over, lower=lower)
            case ir.Shift(body=body) if not loose:
                return replace(formula, body=of(body, "point" if over == "point" else "edge"))
            case ir.AtStart(body=body):
                return replace(formula, body=of(body, "point" if not loose else safe))
            case _:
                return formula.map_children(formulas=lambda part: of(part, safe))

    def _windowed(self, formula: ir.Temporal | ir.PastTemporal, over: Over, *, lower: bool) -> ir.Formula:
        """Bound on an operator with a window; see the text of the module.

        `eventually` is the dual of `always`: `all` and `some`, lower and upper, `and` and `or` change places.
        """
        least = formula.op in ("always", "historically")
        lo, hi = formula.window.lo, formula.window.hi
        whole: Over = "all" if least else "some"

        def part(first: int, last: int | None, over: Over) -> ir.Formula | None:
            if last is not None and last < first:
                return None
            body = self._bound(formula.body, over, lower=lower, loose=False)
            return replace(formula.with_window(first, last), body=body)

        inner = None if hi is None else hi - 1
        edge: Over = "point" if over == "point" else _DUAL[whole]
        if over == whole and lo == 0 and (hi == 0 or formula.back):
            edge = whole
        if over != "point" and lower is least:  # every cell that the window may touch counts
            parts = [part(lo, hi, whole)]
        elif over not in ("point", whole):
            parts = [part(lo, hi, _DUAL[whole]), part(lo + 1, inner, whole)]
        elif formula.back:
            parts = [part(lo + 1, hi, whole), part(lo, lo, edge)]
        else:
            parts = [part(lo, inner, whole), None if hi is None else part(hi, hi, edge)]
        known = tuple(each for each in parts if each is not None)
        if not known:  # an empty window
            return formula
        return known[0] if len(known) == 1 else ir.BoolOp("and" if least else "or", known)

    def _name(self, atom: ir.Predicate, over: Over, lower: bool) -> str:
        known = self._names.setdefault(atom, f"{_NAME}{len(self._names)}")
        return f"{known}.{over}.{'low' if lower else 'high'}"

    def _column(self, atom: ir.Predicate, over: Over, lower: bool) -> ir.Predicate:
        """Return a predicate whose margin is a bound on that of `atom` in each cell."""
        if (atom, over, lower) not in self._columns:
            for side, values in zip((True, False), self._margins(atom), strict=True):
                found: dict[Over, Floats] = dict.fromkeys(("all", "some", "point", "edge"), values)
                if len(values) != len(self.starts):
                    found["all"] = np.minimum.reduceat(values, self.starts, axis=0)
                    found["some"] = np.maximum.reduceat(values, self.starts, axis=0)
                    found["point"] = values[self.starts]
                    found["edge"] = _beyond_ends(found["all" if side else "some"], found["point"], least=side)
                self._columns.update({(atom, each, side): column for each, column in found.items()})
        name = self._name(atom, over, lower)
        return ir.Predicate(ir.Signal(name), strict=atom.strict, span=atom.span)

    def _margins(self, atom: ir.Predicate) -> tuple[Floats, Floats]:
        """Bounds on the margin of a predicate, at each moment, or in each cell if it reads other instants."""
        names = sorted({name for name, *_ in atom.reads()})
        if atom.shifted or atom.frozen or not self.before.keys() >= set(names):
            hulls = self.hulls(edges=True)
            (found,) = evaluate([atom], hulls, ops=INTERVALS, count=len(self.starts), end="truncate")
            return _unknown_at(-np.inf, found.low), _unknown_at(np.inf, found.high)
        if not names:
            (value,) = evaluate([atom], {"": np.zeros((1, 1))})
            batch = next(iter(self.before.values())).shape[1]
            constant = np.broadcast_to(value, (len(self.starts), batch))
            return constant, constant
        open_ = [name for name in names if self.after[name] is not self.before[name]]
        clocks = sorted({self.clocks[name] for name in open_})[:MOST_CORNERS]
        low, high = np.array(np.inf), np.array(-np.inf)
        for later in product((False, True), repeat=len(clocks)):
            taken = {clock for clock, late in zip(clocks, later, strict=True) if late}
            env = {name: (self.after if self.clocks[name] in taken else self.before)[name] for name in names}
            (margin,) = evaluate([atom], env, count=len(self.times))
            low = np.minimum(low, _unknown_at(-np.inf, margin))
            high = np.maximum(high, _unknown_at(np.inf, margin))
        return low, high

    def hulls(self, *, edges: bool = False) -> dict[str, Intervals]:
        """Least and greatest value of each signal in each cell, as intervals; NaN where one is unknown.

        With `edges`, they are those at the instant of the grid, and what the cell holds beyond its two ends.
        """
        found = {}
        for name, before in self.before.items():
            ends = (before, self.after[name])
            low = np.minimum.reduceat(np.minimum(*ends), self.starts, axis=0)
            high = np.maximum.reduceat(np.maximum(*ends), self.starts, axis=0)
            if edges:
                low = _beyond_ends(low, np.minimum(*ends)[self.starts], least=True)
                high = _beyond_ends(high, np.maximum(*ends)[self.starts], least=False)
            found[name] = Intervals(low, high)
        return found

    def last(self, cell: int) -> float:
        """Time of the last moment of a cell in seconds."""
        following = [*self.starts.tolist(), len(self.times)][cell + 1]
        return float(self.times[following - 1])

    def interval_env(self) -> tuple[dict[str, Array], frozenset[str]]:
        """Signals as intervals without NaN, and the names of those that are unknown somewhere."""
        hulls = self.hulls()
        holes = holes_in({name: hull.low for name, hull in hulls.items()})
        low = without_holes({name: hull.low for name, hull in hulls.items()}, holes)
        high = without_holes({name: hull.high for name, hull in hulls.items()}, holes)
        return {
            name: Intervals(values, np.maximum(values, high[name])) for name, values in low.items()
        }, holes

    def witness(self, formula: ir.Formula) -> tuple[dict[str, Floats], Floats]:
        """Return recorded values, one per cell, that speak most against a formula, and their times.

        In each cell it is the moment at which the formula without its windows has the least value.
        """
        flat, moments = _without_time(formula), len(self.times)
        names: dict[ir.Formula, str] = {}
        values: dict[str, Array] = {}
        for atom in flat.walk():
            if isinstance(atom, ir.Predicate) and atom not in names:
                names[atom] = f"{len(names)}"
                high = self._margins(atom)[1]
                values[names[atom]] = high if len(high) == moments else np.zeros((moments, high.shape[1]))
        worth = np.zeros((moments, 1))
        if values:
            (worth,) = evaluate([over_columns(flat, names)], values, count=moments)
        worth = worth.min(axis=1)
        cells = pairwise([*self.starts.tolist(), moments])
        chosen = np.array([first + int(np.argmin(worth[first:stop])) for first, stop in cells])
        return {name: x[chosen] for name, x in self.before.items()}, self.times[chosen]

    def of_trace(self, trace: int) -> Cells:
        """Return the cells of one trace."""
        before = {name: x[:, trace : trace + 1] for name, x in self.before.items()}
        after = {
            name: before[name] if x is self.before[name] else x[:, trace : trace + 1]
            for name, x in self.after.items()
        }
        return Cells(self.times, self.starts, before, after, self.clocks)


def _unknown_at(bound: float, values: Floats) -> Floats:
    return np.where(np.isnan(values), bound, values)


def _beyond_ends(extreme: Floats, point: Floats, *, least: bool) -> Floats:
    """Values at the instants of the grid, or the extreme of a cell that both of its ends do not reach."""
    following = np.concatenate((point[1:], point[-1:]))
    if least:
        return np.where(extreme < np.minimum(point, following), extreme, point)
    return np.where(extreme > np.maximum(point, following), extreme, point)


def _compared(items: Sequence[ir.Formula]) -> list[ir.Formula]:
    """Operands that compare instants, and predicates on the same signals, as in `rise(p)`; [] without any."""
    shifts = [item for item in items if isinstance(item, ir.Shift)]
    read = frozenset().union(*(shift.columns for shift in shifts))
    same = [item for item in items if isinstance(item, ir.Predicate) and item.columns <= read]
    return [*shifts, *same] if shifts else []


def _without_time(formula: ir.Formula) -> ir.Formula:
    """The formula with every temporal operator replaced by its operands."""
    match formula:
        case ir.Temporal() | ir.PastTemporal() | ir.Shift() | ir.AtStart() | ir.Freeze():
            return _without_time(formula.body)
        case ir.Until(op=op, left=left, right=right) | ir.Since(op=op, left=left, right=right):
            sides = (_without_time(left), _without_time(right))
            return ir.BoolOp("and" if op in ("until", "since") else "or", sides)
        case _:
            return formula.map_children(formulas=_without_time)


def over_columns(formula: ir.Formula, names: Mapping[ir.Formula, str]) -> ir.Formula:
    """Return the formula over the columns `names` of the values of its predicates and `freeze` formulas."""
    if isinstance(formula, (ir.Predicate, ir.Freeze)):
        return ir.Predicate(ir.Signal(names[formula]))
    return formula.map_children(formulas=lambda part: over_columns(part, names))
