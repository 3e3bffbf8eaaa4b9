"""The sections `state` and `control`: columns with units and bounds, one for each component of a vector."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

from stlc.compile.frontend.scope import column_entries, member_entries
from stlc.compile.frontend.signals import MAX_COMPONENTS
from stlc.dynamics.declaration.model import ControlDecl, Squash
from stlc.dynamics.schema.expressions import Expressions
from stlc.dynamics.schema.names import Names, base_name, component_names, read_unit
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.yaml_nodes import Node, Sequence
from stlc.signature import Column, Role
from stlc.units import Unit

STATE_KEYS = ("unit", "range", "clamp", "role", "enum", "bool", "size", "timer", "run", "reset_when", "to")
CONTROL_KEYS = ("unit", "range", "squash", "levels", "size")
BOOL_LABELS = ()
Ranges = tuple[tuple[float, float], ...]


def read_states(node: Node | None, reader: Reader, names: Names) -> dict[str, dict[str, Node]]:
    """The section `state`; gives back the fields of every state."""
    if node is None:
        reader.report("S102", "the file lacks `state`", reader.source.span(0, 1), "state: {x: {unit: m}}")
    described: dict[str, dict[str, Node]] = {}
    for entry in reader.entries(node, "`state`"):
        names.declare(entry.key, "state", reader)
        where = f"the state `{entry.key.text}`"
        found = reader.fields(entry.value, where, STATE_KEYS)
        described[entry.key.text] = found
        add_columns(_columns(entry.key.text, found, where, reader, names), names)
    name_columns(names, "state")
    return described


def add_columns(columns: tuple[Column, ...], names: Names) -> None:
    """Columns of one state, whose components are declared where it is."""
    names.columns.extend(columns)
    names.place_components(base_name(columns[0].name), [column.name for column in columns])


def name_columns(names: Names, about: str) -> None:
    """Make the columns names that expressions may use, and their members with them."""
    known = column_entries(names.columns, about=about)
    names.entries |= {name: entry for name, entry in known.items() if name not in names.entries}
    names.entries |= member_entries(column.labels for column in names.columns if column.kind == "enum")


def _columns(
    name: str, found: dict[str, Node], where: str, reader: Reader, names: Names
) -> tuple[Column, ...]:
    """One state: one column, or the components of a vector."""
    role = reader.option(found.get("role"), f"`role` of {where}", ("state", "env")) or "state"
    clamp = bool(reader.flag(found.get("clamp"), f"`clamp` of {where}"))
    if clamp and "range" not in found:
        reader.report(
            "S204", f"{where} is clamped but has no range", found["clamp"].span, "add `range: [low, high]`"
        )
    columns = plain_columns(name, found, where, names.expressions(reader))
    shown: Role = "env" if role == "env" else "state"
    return tuple(replace(column, role=shown, fact=column.fact or clamp) for column in columns)


def plain_columns(name: str, found: dict[str, Node], where: str, here: Expressions) -> tuple[Column, ...]:
    """The columns that `unit`, `range`, `enum`, `bool` and `size` describe."""
    reader = here.reader
    unit = read_unit(found.get("unit"), reader)
    size = read_size(found.get("size"), where, reader)
    called = component_names(name, size)
    if "enum" in found:
        labels = _members(found["enum"], where, reader)
        values = [value for _, value in labels] or [0.0]
        return tuple(
            Column(each, unit, "enum", "state", min(values), max(values), labels, fact=True)
            for each in called
        )
    if reader.flag(found.get("bool"), f"`bool` of {where}"):
        return tuple(Column(each, unit, "bool", "state", 0.0, 1.0, BOOL_LABELS, fact=True) for each in called)
    bounds = read_ranges(found.get("range"), where, unit, size, here)
    if bounds is None:
        return tuple(Column(each, unit) for each in called)
    return tuple(
        Column(each, unit, low=low, high=high) for each, (low, high) in zip(called, bounds, strict=True)
    )


def read_size(node: Node | None, where: str, reader: Reader) -> int | None:
    """How many components a vector has; None for a single number."""
    return reader.integer(node, f"`size` of {where}", high=MAX_COMPONENTS)


def _members(node: Node, where: str, reader: Reader) -> tuple[tuple[str, float], ...]:
    """`{stop: 0, light: 1}` or `[stop, light]`."""
    members: list[tuple[str, float]] = []
    if isinstance(node, Sequence):
        words = [reader.name(item, f"a member of {where}") for item in reader.items(node, where)]
        members = [(word, float(value)) for value, word in enumerate(words) if word]
    else:
        for entry in reader.entries(node, f"`enum` of {where}"):
            value = reader.integer(entry.value, f"the member `{entry.key.text}`", low=-1_000_000)
            if value is not None and reader.nameable(entry.key, f"a member of {where}"):
                members.append((entry.key.text, float(value)))
    if len(dict(members)) < max(len(members), 1) or len({value for _, value in members}) < len(members):
        help_ = "{enum: {stop: 0, go: 1}}"
        reader.report(
            "S103", f"{where} needs members, each with a name and a value of its own", node.span, help_
        )
    return tuple(members)


def read_ranges(
    node: Node | None, where: str, unit: Unit, size: int | None, here: Expressions
) -> Ranges | None:
    """`[low, high]` of every component, in `unit`; an end is a number for all or a vector."""
    if node is None:
        return None
    items = here.reader.items(node, f"`range` of {where}")
    if len(items) != 2:
        if items or (isinstance(node, Sequence) and not node.items):
            here.reader.wrong(node, f"`range` of {where}", "two numbers `[low, high]`")
        return None
    lows = here.constants(items[0], f"the lower bound of {where}", unit, size or 1)
    highs = here.constants(items[1], f"the upper bound of {where}", unit, size or 1)
    if lows is None or highs is None:
        return None
    for low, high in zip(lows, highs, strict=True):
        if not low < high:
            here.reader.report(
                "S204", f"the range of {where} ends before it starts", node.span, f"[{high:g}, {low:g}]"
            )
            return None
    return tuple(zip(lows, highs, strict=True))


def read_controls(node: Node | None, reader: Reader, names: Names) -> None:
    """The section `control`."""
    if node is None:
        reader.report(
            "S102", "the file lacks `control`", reader.source.span(0, 1), "control: {u: {range: [-1, 1]}}"
        )
    for entry in reader.entries(node, "`control`"):
        names.declare(entry.key, "control", reader)
        name = entry.key.text
        where = f"the control `{name}`"
        found = reader.fields(entry.value, where, CONTROL_KEYS)
        if "range" not in found:
            reader.report(
                "S204",
                f"{where} has no range",
                entry.key.span,
                f"{name}: {{range: [-1, 1]}}",
                label="needs bounds",
            )
        controls = _controls(name, found, where, names.expressions(reader))
        names.controls.extend(controls)
        names.place_components(name, [control.name for control in controls])
    columns = [Column(c.name, c.unit, "real", "input", c.low, c.high, (), fact=True) for c in names.controls]
    names.entries |= column_entries(columns, about="control")


def _controls(name: str, found: dict[str, Node], where: str, here: Expressions) -> tuple[ControlDecl, ...]:
    """One control, or the components of a vector."""
    reader = here.reader
    unit = read_unit(found.get("unit"), reader)
    size = read_size(found.get("size"), where, reader)
    called = component_names(name, size)
    bounds = read_ranges(found.get("range"), where, unit, size, here) or ((-1.0, 1.0),) * len(called)
    word = reader.option(found.get("squash"), f"`squash` of {where}", get_args(Squash)) or "tanh"
    squash: Squash = "clip" if word == "clip" else "angle" if word == "angle" else "tanh"
    low, high = max(low for low, _ in bounds), min(high for _, high in bounds)
    kept = read_levels(found.get("levels"), where, unit, (low, high), here)
    return tuple(
        ControlDecl(each, unit, *ends, squash, kept) for each, ends in zip(called, bounds, strict=True)
    )


def read_levels(
    node: Node | None, where: str, unit: Unit, bounds: tuple[float, float], here: Expressions
) -> tuple[float, ...]:
    """The values of a control that a search may try, within its range."""
    items = here.reader.items(node, f"`levels` of {where}")
    levels = [here.constant(item, f"a level of {where}", unit) for item in items]
    low, high = bounds
    for item, level in zip(items, levels, strict=True):
        if level is not None and not low <= level <= high:
            here.reader.report(
                "S204",
                f"a level of {where} is outside its range",
                item.span,
                f"the range is [{low:g}, {high:g}]",
            )
    return tuple(level for level in levels if level is not None)
