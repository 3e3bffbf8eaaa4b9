"""`grid` and `from` under `init`: initial states that are known, not drawn."""

from __future__ import annotations

from pathlib import Path

from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.init import FileDecl, GridDecl
from stlc.dynamics.schema.expressions import Expressions
from stlc.dynamics.schema.flow import column_assign, states_of
from stlc.dynamics.schema.names import Names
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.yaml_nodes import Entry, Mapping, Node, Sequence
from stlc.files import beside
from stlc.signature import Column

AXIS_KEYS = ("from", "to", "count")
MAX_COUNT = 1_000_000
FORMATS = (".npz", ".csv", ".parquet", ".mat", ".mcap")


def read_grid(node: Node, here: Expressions, names: Names) -> GridDecl:
    """`{x: {from: -1, to: 1, count: 21}, sign: [stop, light]}`: every combination of the values."""
    axes = []
    for entry in here.reader.entries(node, "`grid`"):
        columns = states_of(entry, "`grid`", here.reader, names)
        if columns and names.vector(entry.key.text):
            advice = f'"{columns[0].name}": …'
            here.reader.report("S203", f"`{entry.key.text}` is a vector", entry.key.span, advice)
        elif columns:
            axes.append((columns[0].name, _values(columns[0], entry, here)))
    if not axes:
        here.reader.wrong(node, "`grid`", "states and their values", "{x: {from: -1, to: 1, count: 21}}")
    return GridDecl(tuple(axes))


def _values(column: Column, entry: Entry, here: Expressions) -> tuple[float, ...]:
    """The values of one axis, in the unit of the column; one that is wrong stands for 0."""
    if isinstance(entry.value, Mapping):
        return _spaced(column, entry.value, here)
    single = not isinstance(entry.value, Sequence)
    items = (entry.value,) if single else here.reader.items(entry.value, f"the values of `{column.name}`")
    if not items:
        here.reader.wrong(entry.value, f"the values of `{column.name}`", "a list of at least one value")
    found = []
    for item in items:
        assign = column_assign(column, item, here)
        if assign is not None and not isinstance(assign.value, ir.Const):
            here.reader.wrong(item, f"a value of `{column.name}`", "a constant", "draw it under `draw`")
        found.append(assign.value.value if assign is not None and isinstance(assign.value, ir.Const) else 0.0)
    return tuple(found) or (0.0,)


def _spaced(column: Column, node: Mapping, here: Expressions) -> tuple[float, ...]:
    """`{from: 0, to: 1, count: 5}`: evenly spaced, both ends among them."""
    where = f"the values of `{column.name}`"
    found = here.reader.fields(node, where, AXIS_KEYS, required=AXIS_KEYS)
    low = here.constant(found.get("from"), f"`from` of {where}", column.unit)
    high = here.constant(found.get("to"), f"`to` of {where}", column.unit)
    count = here.reader.integer(found.get("count"), f"`count` of {where}", low=2, high=MAX_COUNT)
    if column.kind != "real":
        here.reader.wrong(node, where, "a list of its members")
    if low is None or high is None or count is None:
        return (0.0,)
    return tuple(low + (high - low) * index / (count - 1) for index in range(count))


def read_file(node: Node, names: tuple[str, ...], reader: Reader) -> FileDecl | None:
    """`from: starts.npz`, relative to the system file; the states that are not drawn come from there."""
    text = reader.text(node, "`from`")
    if text is None:
        return None
    if Path(text).suffix not in FORMATS:
        reader.wrong(node, "`from`", "a file of states", f"formats: {', '.join(FORMATS)}")
    return FileDecl(beside(Path(node.span.source.name).parent, text), names, node.span)
