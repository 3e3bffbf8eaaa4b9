"""Families of formulas of equal shape, as one shape and a table of parameters: obstacles are data.

A hundred boxes become one loop over a hundred rows, not a hundred copies of the same code. Constants and
column names may differ; operators, windows and function calls are part of the shape.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias, assert_never

from stlc.compile.backends.c.numbers import LISTED
from stlc.compile.ir import nodes as ir

LEAST = 8
"""Minimum number of members of a family."""

Entry: TypeAlias = ir.Const | ir.Signal | ir.ShiftedSignal


@dataclass(frozen=True, slots=True)
class FamilyTable:
    """Constants and columns that distinguish the members of a family, one row per member.

    Attributes:
        rows: number of members.
        constants: C name -> constant of each row.
        columns: C name -> column of each row.
    """

    rows: int
    constants: Mapping[str, tuple[float, ...]]
    columns: Mapping[str, tuple[str, ...]]

    @property
    def names(self) -> frozenset[str]:
        """Names of the table's entries in the shape, as frozen values and columns."""
        return frozenset(f"{LISTED}{name}" for name in (*self.constants, *self.columns))


@dataclass(frozen=True, slots=True)
class Family:
    """Formulas that differ in constants and columns.

    Attributes:
        members: indices of the formulas.
        shape: common formula, with names of table entries where the members differ.
        table: values of these names for each member.
    """

    members: tuple[int, ...]
    shape: ir.Formula
    table: FamilyTable


def families(formulas: Sequence[ir.Formula], first: int) -> list[Family]:
    """Return the families of at least `LEAST` members.

    Args:
        formulas: candidates.
        first: number of the first table, part of the names in it; further tables count on.
    """
    if len(formulas) < LEAST:
        return []
    alike: dict[ir.Formula, list[int]] = {}
    for place, formula in enumerate(formulas):
        alike.setdefault(_changed(formula, _blank), []).append(place)
    groups = [group for group in alike.values() if len(group) >= LEAST]
    return [_family(formulas, group, first + i) for i, group in enumerate(groups)]


def _blank(leaf: Entry) -> ir.Num:
    return ir.Const(0.0) if isinstance(leaf, ir.Const) else replace(leaf, name="")


def _family(formulas: Sequence[ir.Formula], members: Sequence[int], number: int) -> Family:
    constants: dict[tuple[str, ...], str] = {}
    columns: dict[tuple[str, ...], str] = {}
    values: dict[str, tuple[float, ...]] = {}
    stands: list[ir.Num] = []
    entries = zip(*(_entries(formulas[member]) for member in members), strict=True)
    for rows in entries:
        first = rows[0]
        if isinstance(first, ir.Const):
            numbers = tuple(row.value for row in rows if isinstance(row, ir.Const))
            key = tuple(value.hex() for value in numbers)
            if len(set(key)) > 1:
                name = constants.setdefault(key, f"t{number}_{len(constants)}")
                values[name] = numbers
                stands.append(ir.FrozenVar(f"{LISTED}{name}"))
                continue
        else:
            key = tuple(row.name for row in rows if not isinstance(row, ir.Const))
            if len(set(key)) > 1:
                name = columns.setdefault(key, f"c{number}_{len(columns)}")
                stands.append(replace(first, name=f"{LISTED}{name}"))
                continue
        stands.append(first)
    left = iter(stands)
    shape = _changed(formulas[members[0]], lambda _: next(left))
    table = FamilyTable(len(members), values, {name: key for key, name in columns.items()})
    return Family(tuple(members), shape, table)


def _entries(formula: ir.Formula) -> list[Entry]:
    """Leaves that may differ among formulas of one shape, in the order of `_changed`."""
    found: list[Entry] = []

    def note(leaf: Entry) -> ir.Num:
        found.append(leaf)
        return leaf

    _changed(formula, note)
    return found


def _changed(formula: ir.Formula, change: Callable[[Entry], ir.Num]) -> ir.Formula:
    """Return the formula with each leaf that may differ replaced by `change(leaf)`."""
    match formula:
        case ir.Truth() | ir.Freeze():  # names of frozen values are unique: no other has this shape
            return formula
        case ir.Predicate(num):
            return replace(formula, num=_number(num, change))
        case ir.BoolOp(_, items):
            return replace(formula, items=tuple(_changed(item, change) for item in items))
        case ir.Temporal(_, _, body) | ir.PastTemporal(_, _, body) | ir.Shift(_, body) | ir.AtStart(body):
            return replace(formula, body=_changed(body, change))
        case ir.Until(_, _, left, right) | ir.Since(_, _, left, right):
            return replace(formula, left=_changed(left, change), right=_changed(right, change))
        case _:
            assert_never(formula)


def _number(num: ir.Num, change: Callable[[Entry], ir.Num]) -> ir.Num:
    match num:
        case ir.Signal(name) | ir.ShiftedSignal(name) if name.startswith(
            LISTED
        ):  # an entry of the enclosing table
            return num
        case ir.Signal(ir.ELAPSED):
            return num
        case ir.Const() | ir.Signal() | ir.ShiftedSignal():
            return change(num)
        case ir.FrozenVar() | ir.Extern():  # a call is computed once for its columns
            return num
        case ir.Op("pow", (base, exponent)):  # compilers round some constant exponents differently
            return ir.Op("pow", (_number(base, change), exponent))
        case ir.Op(_, args):
            return replace(num, args=tuple(_number(arg, change) for arg in args))
        case ir.Indicator(cond):
            return replace(num, cond=_changed(cond, change))
        case ir.Where(cond, yes, no):
            cond = _changed(cond, change)
            return ir.Where(cond, _number(yes, change), _number(no, change))
        case _:
            assert_never(num)
