"""The section `param`: constants of a trajectory, drawn anew for each; nobody moves them but events."""

from __future__ import annotations

from dataclasses import replace

from stlc.compile.analysis.spread import spread
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.model import Assign
from stlc.dynamics.init.shared_draws import shared_draws
from stlc.dynamics.schema.columns import add_columns, name_columns, plain_columns
from stlc.dynamics.schema.expressions import Expressions
from stlc.dynamics.schema.flow import state_assigns
from stlc.dynamics.schema.names import Names
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.yaml_nodes import Entry, Node, Scalar
from stlc.signature import Column
from stlc.units import Unit

PARAM_KEYS = ("unit", "range", "draw", "size", "enum", "bool")


def read_params(node: Node | None, reader: Reader, names: Names) -> tuple[Assign, ...]:
    """The section `param`: columns behind the states, and how they are drawn, in order.

    `r: {unit: m, range: [0.6, 1.2]}` is drawn uniformly from its range; `draw` says otherwise, and may stand
    alone: `r: normal(1 m, 0.1 m)`. Later parameters may read earlier ones.
    """
    found: list[Assign] = []
    drawn: frozenset[str] = frozenset()
    for entry in reader.entries(node, "`param`"):
        if not names.declare(entry.key, "parameter", reader):
            continue
        here = names.expressions(reader).extended({}, samplers=True, ready=drawn)
        fields = _fields(entry, here)
        columns = _columns(entry, fields, here)
        add_columns(columns, names)
        assigns = _draws(entry, fields, columns, here, names)
        found.extend(assigns)
        names.columns[-len(columns) :] = [_ranged(column, assigns) for column in columns]
        name_columns(names, "parameter")
        drawn |= {column.name for column in columns}
    return tuple(found)


def _fields(entry: Entry, here: Expressions) -> dict[str, Node]:
    """The keys of a parameter; an expression alone is its `draw`."""
    if isinstance(entry.value, Scalar):
        return {"draw": entry.value}
    where = f"the parameter `{entry.key.text}`"
    found = here.reader.fields(entry.value, where, PARAM_KEYS)
    if not found.keys() & {"draw", "range", "enum", "bool"}:
        here.reader.report(
            "S102",
            f"{where} says nothing about its values",
            entry.key.span,
            f'{entry.key.text}: {{range: [0, 1]}}, or {entry.key.text}: "uniform(0, 1)"',
        )
    return found


def _columns(entry: Entry, fields: dict[str, Node], here: Expressions) -> tuple[Column, ...]:
    columns = plain_columns(entry.key.text, fields, f"the parameter `{entry.key.text}`", here)
    if isinstance(entry.value, Scalar):
        number = replace(here, reader=Reader(here.reader.source)).number(entry.value, "")
        unit = Unit() if number is None or number.bare else number.unit
        unit = unit if unit.offset else unit.si
        columns = tuple(replace(column, unit=unit) for column in columns)
    return tuple(replace(column, role="env") for column in columns)


def _draws(
    entry: Entry, fields: dict[str, Node], columns: tuple[Column, ...], here: Expressions, names: Names
) -> tuple[Assign, ...]:
    """How the values are drawn: as `draw` says, else evenly."""
    if "draw" in fields:
        written = Entry(entry.key, fields["draw"])
        return shared_draws(state_assigns(written, "`param`", here, names))
    return tuple(Assign(column.name, *_even(column)) for column in columns)


def _even(column: Column) -> tuple[ir.Num, str]:
    """Every value of a column equally often, and the words for it."""
    if column.labels:
        members = ", ".join(label for label, _ in column.labels)
        return ir.Op("choice", tuple(ir.Const(value) for _, value in column.labels)), f"choice({members})"
    if column.kind == "bool":
        return ir.Op("bernoulli", (ir.Const(0.5),)), "bernoulli(0.5)"
    low, high = column.low or 0.0, column.high or 0.0
    return ir.Op("uniform", (ir.Const(low), ir.Const(high))), f"uniform({low:g}, {high:g})"


def _ranged(column: Column, assigns: tuple[Assign, ...]) -> Column:
    """The column with the range that its distribution has, where none is written."""
    draw = next((assign.value for assign in assigns if assign.name == column.name), None)
    ends = None if draw is None or column.low is not None else spread(draw)
    return column if ends is None or ends[0] == ends[1] else replace(column, low=ends[0], high=ends[1])
