"""Families of formulas that differ in parameters only: common code and a table of parameters.

A hundred box-shaped obstacles become one loop over a hundred rows, not a hundred copies of the same code.
Constants and signal names may differ within a family; operators, windows and function calls may not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, TypeVar

from stlc.compile.backends.c.numbers import LISTED
from stlc.compile.ir import nodes as ir

LEAST = 8
"""Minimum number of members of a family."""

Entry: TypeAlias = ir.Const | ir.Signal | ir.ShiftedSignal
N = TypeVar("N", bound=Any)


@dataclass(frozen=True, slots=True)
class FamilyTable:
    """Table of the constants and signals by which the members of a family differ, one row per member.

    Attributes:
        rows: number of members.
        constants: C name -> constant of each row.
        columns: C name -> signal of each row.
    """

    rows: int
    constants: Mapping[str, tuple[float, ...]]
    columns: Mapping[str, tuple[str, ...]]

    @property
    def names(self) -> frozenset[str]:
        """Names of the table's entries in the formula that the members of a family share.

        For example, `x > 1` and `x > 2` share the formula `x > a`. The name `a` stands for 1 in the first row
        of the table and for 2 in the second.
        """
        return frozenset(f"{LISTED}{name}" for name in (*self.constants, *self.columns))


@dataclass(frozen=True, slots=True)
class Family:
    """Formulas that differ in constants and signals only.

    Attributes:
        members: indices of the formulas.
        shape: the formula that all members share, with a name in each place where the members differ.
        table: for each of these names, the constant or signal of every member.
    """

    members: tuple[int, ...]
    shape: ir.Formula
    table: FamilyTable


def families(formulas: Sequence[ir.Formula], first: int) -> list[Family]:
    """Group formulas that differ in constants and signals only; return groups of at least `LEAST` members.

    Args:
        formulas: formulas to group.
        first: number of the first group; the next groups are numbered `first + 1` and so on. The number is
            part of the C names in the table of the group.
    """
    if len(formulas) < LEAST:
        return []
    groups: dict[ir.Formula, list[int]] = {}
    for place, formula in enumerate(formulas):
        groups.setdefault(_changed(formula, _blank), []).append(place)
    large = [group for group in groups.values() if len(group) >= LEAST]
    return [_family(formulas, group, first + i) for i, group in enumerate(large)]


def _blank(leaf: Entry) -> ir.Num:
    return ir.Const(0.0) if isinstance(leaf, ir.Const) else replace(leaf, name="")


def _family(formulas: Sequence[ir.Formula], members: Sequence[int], number: int) -> Family:
    constants: dict[str, tuple[float, ...]] = {}
    columns: dict[str, tuple[str, ...]] = {}
    names: dict[tuple[str, ...], str] = {}
    replaced: list[ir.Num] = []
    for rows in zip(*(_entries(formulas[member]) for member in members), strict=True):
        first, key = rows[0], tuple(map(repr, rows))
        if len(set(key)) == 1:
            replaced.append(first)
        elif isinstance(first, ir.Const):
            name = names.setdefault(key, f"t{number}_{len(constants)}")
            constants[name] = tuple(row.value for row in rows if isinstance(row, ir.Const))
            replaced.append(ir.FrozenVar(f"{LISTED}{name}"))
        else:
            entries = tuple(row.name for row in rows if not isinstance(row, ir.Const))
            name = names.setdefault(entries, f"c{number}_{len(columns)}")
            columns[name] = entries
            replaced.append(replace(first, name=f"{LISTED}{name}"))
    left = iter(replaced)
    shape = _changed(formulas[members[0]], lambda _: next(left))
    return Family(tuple(members), shape, FamilyTable(len(members), constants, columns))


def _entries(formula: ir.Formula) -> list[Entry]:
    """Constants and signals of a formula that may differ between the members of a family.

    They are listed in order of occurrence. Constants that must not differ, such as exponents, are left out.
    """
    found: list[Entry] = []

    def note(leaf: Entry) -> ir.Num:
        found.append(leaf)
        return leaf

    _changed(formula, note)
    return found


def _changed(node: N, change: Callable[[Entry], ir.Num]) -> N:
    """Replace each constant or signal in `node` that may differ between the members of a family.

    A constant or signal `leaf` is replaced by `change(leaf)`.
    """
    if isinstance(node, (ir.Freeze, ir.Extern)):
        return node  # names of frozen values are unique; a call is computed once for its columns
    if isinstance(node, (ir.Const, ir.Signal, ir.ShiftedSignal)):
        shared = not isinstance(node, ir.Const) and (node.name == ir.ELAPSED or node.name.startswith(LISTED))
        return node if shared else change(node)  # type: ignore[return-value]

    def below(child: Any) -> Any:
        return _changed(child, change)

    if isinstance(node, ir.Op) and node.name == "pow":  # compilers round some constant exponents differently
        return replace(node, args=(below(node.args[0]), node.args[1]))
    found: N = node.map_children(formulas=below, numbers=below)
    return found
