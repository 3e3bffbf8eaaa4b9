"""How state moves: `flow`, `jump`, and timers, which are one flow and one jump each."""

from __future__ import annotations

import re
from dataclasses import replace

from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.model import Assign, JumpDecl
from stlc.dynamics.init.shared_draws import shared_draws
from stlc.dynamics.model.algebra import add, multiply
from stlc.dynamics.schema.expressions import SECOND, Expressions, written
from stlc.dynamics.schema.names import Clockwork, Names, base_name
from stlc.dynamics.schema.reader import Reader, first_line
from stlc.dynamics.schema.yaml_nodes import Entry, Mapping, Node, Scalar, Sequence, as_bool
from stlc.signature import Column
from stlc.units import Unit

JUMP_KEYS = ("name", "guard", "reset", "sharpness", "once")


def read_flow(node: Node | None, reader: Reader, names: Names, clock: Clockwork) -> tuple[Assign, ...]:
    """The section `flow`: derivatives in the unit of the state per second, or next values."""
    here = names.expressions(reader)
    found: list[Assign] = []
    for entry in reader.entries(node, "`flow`"):
        columns = states_of(entry, "`flow`", reader, names)
        if not columns:
            continue
        first = columns[0]
        if first.kind != "real" and not clock.discrete:
            kind = "true or false" if first.kind == "bool" else "an enum"
            message = f"`flow` sets `{entry.key.text}`, which is {kind}"
            reader.report("S203", message, entry.key.span, "change it with a jump or an event")
            continue
        if clock.discrete:
            where, unit = f"the next `{entry.key.text}`", first.unit
        else:
            where, unit = f"the derivative of `{entry.key.text}`", rate_unit(first.unit)
        if names.vector(entry.key.text):
            found.extend(_components(columns, entry.value, where, unit, here))
            continue
        value = here.stored(entry.value, where, unit)
        if value is not None:
            found.append(Assign(first.name, value, written(entry.value)))
    return tuple(found)


def read_jumps(node: Node | None, reader: Reader, names: Names) -> tuple[JumpDecl, ...]:
    """The section `jump`: guards, resets, and the sharpness of their blend (Eq. 6)."""
    here = names.expressions(reader)
    found: list[JumpDecl] = []
    for index, item in enumerate(reader.items(node, "`jump`")):
        fields = reader.fields(item, "a jump", JUMP_KEYS, required=("guard", "reset"))
        name = reader.name(fields.get("name"), "`name` of a jump") or f"jump {index + 1}"
        guard = here.formula(fields.get("guard"), "a guard")
        resets = read_sets(fields.get("reset"), "`reset`", here, names)
        sharpness = reader.number(fields.get("sharpness"), "`sharpness`", low=1e-9)
        if guard is None:
            continue
        if reader.flag(fields.get("once"), "`once`"):
            latch = latch_name(name)
            guard = ir.BoolOp("and", (guard, ir.Predicate(ir.Op("sub", (ir.Const(0.5), ir.Signal(latch))))))
            resets = (*resets, Assign(latch, ir.Const(1.0), "true"))
        found.append(JumpDecl(name, guard, resets, sharpness, written(fields.get("guard"))))
    return tuple(found)


def read_latches(node: Node | None, reader: Reader, names: Names) -> tuple[Assign, ...]:
    """For every jump that happens `once`, a state that remembers whether it has; false at first."""
    found: list[Assign] = []
    for index, item in enumerate(node.items if isinstance(node, Sequence) else ()):
        once = item.get("once") if isinstance(item, Mapping) else None
        if not isinstance(once, Scalar) or as_bool(once) is not True or not isinstance(item, Mapping):
            continue
        written_name = item.get("name")
        name = written_name.text if isinstance(written_name, Scalar) else f"jump {index + 1}"
        latch = latch_name(name)
        if names.group(latch) or latch in names.places:
            reader.report("E102", f"`{latch}` remembers the jump `{name}`, and is declared", once.span)
            continue
        names.places[latch] = once.span
        names.columns.append(Column(latch, Unit(), "bool", "state", 0.0, 1.0, (), fact=True))
        found.append(Assign(latch, ir.Const(0.0), "false"))
    return tuple(found)


def latch_name(jump: str) -> str:
    """The state that remembers whether a jump has happened."""
    return f"{re.sub(r'[^0-9A-Za-z_]', '_', jump)}_happened"


def read_timers(
    states: dict[str, dict[str, Node]], reader: Reader, names: Names, clock: Clockwork
) -> tuple[tuple[Assign, ...], tuple[JumpDecl, ...]]:
    """States written as `timer: up | down` with `run`, `reset_when` and `to`."""
    flows: list[Assign] = []
    jumps: list[JumpDecl] = []
    here = names.expressions(reader)
    for name, found in states.items():
        column = names.group(name)[0]
        where = f"the timer `{name}`"
        _misplaced(found, where, reader)
        if "timer" not in found:
            continue
        if "size" in found:
            reader.report("S103", f"{where} is a single number", found["size"].span, "declare one a timer")
            continue
        direction = reader.option(found["timer"], f"`timer` of {where}", ("up", "down")) or "up"
        run = here.formula(found["run"], f"`run` of {where}") if "run" in found else ir.Truth(True)
        if run is not None:
            rate = _running(run, direction, column.unit)
            if clock.discrete:
                rate = add(ir.Signal(column.name), multiply(ir.Const(float(clock.dt)), rate))
            flows.append(Assign(column.name, rate, f"timer {direction}"))
        guard = here.formula(found.get("reset_when"), f"`reset_when` of {where}")
        value = here.stored(found["to"], where, column.unit) if "to" in found else ir.Const(0.0)
        if guard is not None and value is not None:
            jumps.append(
                JumpDecl(
                    f"reset {column.name}",
                    guard,
                    (Assign(column.name, value, written(found.get("to"))),),
                    text=written(found.get("reset_when")),
                )
            )
    return tuple(flows), tuple(jumps)


def _misplaced(found: dict[str, Node], where: str, reader: Reader) -> None:
    """Keys of a timer without `timer`."""
    for key in ("run", "reset_when", "to"):
        if key in found and "timer" not in found:
            reader.report("S102", f"`{key}` needs `timer: up` or `timer: down` in {where}", found[key].span)


def _running(run: ir.Formula, direction: str, unit: Unit) -> ir.Num:
    """One second a second while `run` holds, in the unit of the timer."""
    speed = (1.0 if direction == "up" else -1.0) / unit.scale
    return ir.Const(speed) if run == ir.Truth(True) else ir.Op("mul", (ir.Const(speed), ir.Indicator(run)))


def read_sets(node: Node | None, where: str, here: Expressions, names: Names) -> tuple[Assign, ...]:
    """New values of states, in order."""
    found: list[Assign] = []
    for entry in here.reader.entries(node, where):
        found.extend(shared_draws(state_assigns(entry, where, here, names)))
    return tuple(found)


def state_assigns(entry: Entry, where: str, here: Expressions, names: Names) -> tuple[Assign, ...]:
    """A value for a state: one for each component of a vector."""
    columns = states_of(entry, where, here.reader, names)
    if not columns:
        return ()
    if not names.vector(entry.key.text):
        found = column_assign(columns[0], entry.value, here)
        return () if found is None else (found,)
    if columns[0].kind == "real":
        return _components(columns, entry.value, f"`{entry.key.text}`", columns[0].unit, here)
    items = (entry.value,) * len(columns)
    if isinstance(entry.value, Sequence):
        items = here.reader.items(entry.value, where)
    if len(items) != len(columns):
        message = f"`{entry.key.text}` has {len(columns)} components, this has {len(items)}"
        here.reader.report("S203", message, first_line(entry.value.span))
        return ()
    each = [column_assign(column, item, here) for column, item in zip(columns, items, strict=True)]
    return tuple(found for found in each if found is not None)


def _components(
    columns: tuple[Column, ...], node: Node, where: str, unit: Unit, here: Expressions
) -> tuple[Assign, ...]:
    """Values for the components of a vector."""
    values = here.stored_each(node, where, unit, len(columns))
    if values is None:
        return ()
    texts = component_texts(node, len(columns))
    return tuple(
        Assign(column.name, value, text) for column, value, text in zip(columns, values, texts, strict=True)
    )


def component_texts(node: Node, size: int) -> tuple[str, ...]:
    """What each component of a vector is written as."""
    if isinstance(node, Sequence):
        return tuple(written(item) for item in node.items)
    text = written(node)
    return tuple(f"{text if text.isidentifier() else f'({text})'}[{index}]" for index in range(size))


def column_assign(column: Column, node: Node, here: Expressions) -> Assign | None:
    """A value for a column: members by name for an enum, formulas for a bool, units checked."""
    where = f"`{column.name}`"
    boolean = column.kind == "bool"
    value = here.truth(node, where) if boolean else here.stored(node, where, column.unit)
    allowed = {0.0: "false", 1.0: "true"} if boolean else {number: label for label, number in column.labels}
    if allowed and isinstance(value, ir.Const) and value.value not in allowed:
        here.reader.wrong(node, where, " or ".join(f"`{label}`" for label in allowed.values()))
        return None
    return None if value is None else Assign(column.name, value, written(node))


def states_of(entry: Entry, where: str, reader: Reader, names: Names) -> tuple[Column, ...]:
    """The columns of the state that a key names (S202 where it names none)."""
    name = entry.key.text
    columns = names.group(name)
    if columns:
        return columns
    states = list(dict.fromkeys(base_name(column.name) for column in names.columns))
    near = reader.near(name, states)
    guess = f"did you mean `{near}`?" if near else f"states: {', '.join(states)}"
    reader.report("S202", f"{where} sets `{name}`, which is not a state", entry.key.span, guess)
    return ()


def rate_unit(unit: Unit) -> Unit:
    """The unit of a derivative; that of an undeclared unit is undeclared."""
    return unit / SECOND if unit.text else replace(unit)
