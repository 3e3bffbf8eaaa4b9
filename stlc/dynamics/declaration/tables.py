"""Section `table`: interpolation tables in one or two arguments, which expressions call as functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias, get_args

from stlc.compile.frontend.scope import External
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.columns import unit_text
from stlc.dynamics.declaration.schema.names import Context
from stlc.dynamics.declaration.schema.reader import first_line
from stlc.dynamics.declaration.schema.record import EXPRESSION, OF, key, raw, read, word
from stlc.dynamics.declaration.schema.yaml_nodes import Entry, Mapping, Node, Scalar
from stlc.dynamics.declaration.schema.yaml_nodes import Sequence as ListNode
from stlc.units import Unit

Extrapolate: TypeAlias = Literal["linear", "hold"]
Row: TypeAlias = tuple[float, ...]
MAX_VALUES = 1000
_NESTED = {"type": "array", "items": {"anyOf": [EXPRESSION, {"type": "array", "items": EXPRESSION}]}}


@dataclass(frozen=True, slots=True)
class TableDecl:
    """An interpolation table: a function that is linear in each argument between the points of a grid.

    Attributes:
        name: name in expressions.
        units: unit of each argument.
        unit: unit of the values.
        points: the points of each argument, in its unit; they increase.
        values: values at the points, in `unit`: a row for each point of the first of two arguments, or one
            row for a single argument.
        extrapolate: values outside of the points: on the line of the outermost cell, or the value at the end.
    """

    name: str
    units: tuple[Unit, ...]
    unit: Unit
    points: tuple[Row, ...]
    values: tuple[Row, ...]
    extrapolate: Extrapolate


@dataclass(repr=False, eq=False)
class TableKeys:
    """The keys that the declaration of one table may have."""

    of: Node | None = key(
        raw({"type": ["array", "object"]}),
        "names of one or two arguments, or name and unit of each",
        required=True,
    )
    at: Node | None = key(raw(_NESTED), "points of the argument, or a list of points for each", required=True)
    values: Node | None = key(
        raw(_NESTED),
        "values at the points; of two arguments, a row for each point of the first",
        required=True,
    )
    unit: Unit = key(unit_text, "unit of the values", Unit())
    extrapolate: Extrapolate = key(
        word(get_args(Extrapolate)), "outside the points: the line goes on, or the last value stays", "linear"
    )


def read_tables(node: Node | None, cx: Context) -> tuple[TableDecl, ...]:
    """Read the section `table`, and declare its tables as functions for expressions."""
    found: list[TableDecl] = []
    for entry in cx.reader.entries(node, "`table`"):
        if cx.names.declare(entry.key, "table", cx.reader):
            table = _table(entry, cx)
            if table is not None:
                found.append(table)
    return tuple(found)


def _table(entry: Entry, cx: Context) -> TableDecl | None:
    """Read one table, and declare it as a function; None if it is invalid.

    If numbers are changed while the file is read again, its values may read columns; the function takes these
    as further arguments, and the values are NaN in the declaration.
    """
    where = f"the table `{entry.key.text}`"
    keys = read(TableKeys, cx.plain, entry.value, where, OF)
    units = _units(keys.of, where, cx)
    if units is None or keys.at is None or keys.values is None:
        return None
    called = f"`at` of {where}"
    if len(units) == 1:
        points: tuple[Row, ...] = (_row(keys.at, units[0], called, cx),)
        rows: tuple[Node, ...] = (keys.values,)
    else:
        at = cx.reader.items(keys.at, called)
        if len(at) == len(units):
            points = tuple(_row(item, unit, called, cx) for item, unit in zip(at, units, strict=True))
        else:
            cx.reader.wrong(keys.at, called, f"{len(units)} lists of numbers, one per argument")
            points = ((),) * len(units)
        rows = cx.reader.items(keys.values, f"`values` of {where}")
    numbers = tuple(_numbers(row, keys.unit, f"`values` of {where}", cx) for row in rows)
    values = tuple(
        tuple(number.value if isinstance(number, ir.Const) else math.nan for number in row) for row in numbers
    )
    table = TableDecl(entry.key.text, units, keys.unit, points, values, keys.extrapolate)
    if not _sound(table, keys, cx):
        return None
    factors = tuple(sorted({name for row in numbers for number in row for name in number.columns}))
    cx.names.entries[table.name] = External(
        table.name,
        (None,) * len(points),
        None,
        table.unit,
        "real",
        body(table, numbers, factors),
        "table",
        entry.key.span,
        units,
        tuple(map(ir.Signal, factors)),
    )
    return table


def _units(node: Node | None, where: str, cx: Context) -> tuple[Unit, ...] | None:
    """Read the arguments of a table; return their units."""
    found: list[Unit | None] = []
    if isinstance(node, Mapping):
        found = [unit_text.read(cx, each.value, f"`{each.key.text}` of {where}") for each in node.entries]
    elif isinstance(node, ListNode):
        names = [cx.reader.name(item, f"an argument of {where}") for item in node.items]
        found = [None if name is None else Unit.ONE for name in names]
    known = tuple(unit for unit in found if unit is not None and not unit.offset)
    if node is not None and (len(known) not in (1, 2) or len(known) < len(found)):
        advice = "of: [throttle, speed], or of: {throttle: 1, speed: rad/s}; temperatures in K"
        cx.reader.wrong(node, f"`of` of {where}", "one or two arguments", advice)
        return None
    return known or None


def _row(node: Node, unit: Unit, where: str, cx: Context) -> Row:
    """Read a list of numbers in `unit`; `where` names the list in messages."""
    found: list[float] = []
    for item in cx.reader.items(node, where):
        value = item.number if isinstance(item, Scalar) else None
        value = cx.plain.here.constant(item, f"a number in {where}", unit) if value is None else value
        found.append(0.0 if value is None else value)
    return tuple(found)


def _numbers(node: Node, unit: Unit, where: str, cx: Context) -> tuple[ir.Num, ...]:
    """Read a list of values in `unit`: constants, unless the numbers of the file are changed."""
    if cx.names.changes is None or unit.offset:
        return tuple(map(ir.Const, _row(node, unit, where, cx)))
    items = cx.reader.items(node, where)
    found = (cx.moving.here.stored(item, f"a number in {where}", unit) for item in items)
    return tuple(ir.Const(0.0) if number is None else number for number in found)


def _sound(table: TableDecl, keys: TableKeys, cx: Context) -> bool:
    """True if the points of a table increase and its values fit them; else S204 is reported."""
    assert keys.at is not None
    assert keys.values is not None
    message, place = "", keys.at
    if any(len(row) < 2 or any(a >= b for a, b in pairwise(row)) for row in table.points):
        message = f"the points of the table `{table.name}` must be two or more that increase"
    else:
        shape = [len(row) for row in table.points]
        rows, wide = (1, shape[0]) if len(shape) == 1 else shape
        if len(table.values) != rows or any(len(row) != wide for row in table.values):
            wanted = f"{wide} values" if len(shape) == 1 else f"{rows} rows of {wide} values"
            message, place = f"the table `{table.name}` needs {wanted}", keys.values
        elif rows * wide > MAX_VALUES:
            message, place = f"the table `{table.name}` has more than {MAX_VALUES} values", keys.values
    if message:
        cx.reader.report("S204", message, first_line(place.span))
    return not message


# --------------------------------------------------------------------------------- the value


def body(table: TableDecl, values: Sequence[Sequence[ir.Num]], read: Sequence[str] = ()) -> ir.Body:
    """Return a table as a function of its arguments in SI units; its value is in the table's unit.

    `values` are those of the table as numbers. The columns that they read, `read`, are further arguments.

    Along an argument, the value is computed as a sum: the value at the first point, plus for each cell its
    increase times the share of the cell that lies below the argument. The sum is exact, has the derivative of
    the cell, and needs no branches.

    The table is interpolated along the first argument first. If that is constant within a step, this part is
    computed once for all stages of the integrator.
    """
    lets: list[tuple[str, ir.Num]] = []

    def shares(number: int) -> list[ir.Num]:
        unit, points = table.units[number], table.points[number]
        argument: ir.Num = ir.Signal(f"at{number}")
        if unit.ratio != 1:
            argument = argument * (1.0 / unit.scale)
        found: list[ir.Num] = []
        for cell, (left, right) in enumerate(pairwise(points)):
            share: ir.Num = (argument - left) * (1.0 / (right - left))
            if cell > 0 or table.extrapolate != "linear":
                share = share.apply("max", 0.0)
            if cell < len(points) - 2 or table.extrapolate != "linear":
                share = share.apply("min", 1.0)
            lets.append((f"share{number}.{cell}", share))
            found.append(ir.Signal(lets[-1][0]))
        return found

    along = shares(0)
    if len(table.points) == 1:
        return ir.Body(("at0", *read), tuple(lets), (_along(values[0], along),))
    for index, column in enumerate(zip(*values, strict=True)):
        lets.append((f"column{index}", _along(column, along)))
    columns = [ir.Signal(f"column{index}") for index in range(len(values[0]))]
    value = _along(columns, shares(1))
    return ir.Body(("at0", "at1", *read), tuple(lets), (value,))


def _along(values: Sequence[ir.Num], shares: Sequence[ir.Num]) -> ir.Num:
    """Return the interpolated value along one argument."""
    parts = [values[0]]
    for (left, right), share in zip(pairwise(values), shares, strict=True):
        if isinstance(left, ir.Const) and isinstance(right, ir.Const):
            rise: ir.Num = ir.Const(right.value - left.value)
        else:
            rise = right - left
        parts.append(rise * share)
    return ir.Num.total(parts)
