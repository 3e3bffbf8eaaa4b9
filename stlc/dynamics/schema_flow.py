"""How state moves: `flow`, `jump`, and timers, which are one flow and one jump each."""

from __future__ import annotations

from dataclasses import replace

from stlc.compile import ir
from stlc.dynamics.decl import Assign, JumpDecl
from stlc.dynamics.schema_expressions import SECOND, Expressions, written
from stlc.dynamics.schema_names import Clockwork, Names, later
from stlc.dynamics.schema_reader import Reader
from stlc.dynamics.yaml_nodes import Entry, Node
from stlc.signature import Column
from stlc.units import Unit

JUMP_KEYS = ("name", "guard", "reset", "sharpness", "once")


def read_flow(node: Node | None, reader: Reader, names: Names, clock: Clockwork) -> tuple[Assign, ...]:
    """The section `flow`: derivatives in the unit of the state per second, or next values."""
    here = names.expressions(reader)
    found: list[Assign] = []
    for entry in reader.entries(node, "`flow`"):
        column = state_of(entry, "`flow`", reader, names)
        if column is None:
            continue
        if column.kind != "real" and not clock.discrete:
            kind = "true or false" if column.kind == "bool" else "an enum"
            message = f"`flow` sets `{column.name}`, which is {kind}"
            reader.report("S203", message, entry.key.span, "change it with a jump or an event")
            continue
        if clock.discrete:
            where, unit = f"the next `{column.name}`", column.unit
        else:
            where, unit = f"the derivative of `{column.name}`", rate_unit(column.unit)
        value = here.stored(entry.value, where, unit)
        if value is not None:
            found.append(Assign(column.name, value, written(entry.value)))
    return tuple(found)


def read_jumps(node: Node | None, reader: Reader, names: Names) -> tuple[JumpDecl, ...]:
    """The section `jump`: guards, resets, and the sharpness of their blend (Eq. 6)."""
    here = names.expressions(reader)
    found: list[JumpDecl] = []
    for index, item in enumerate(reader.items(node, "`jump`")):
        fields = reader.fields(item, "a jump", JUMP_KEYS, required=("guard", "reset"))
        name = reader.text(fields.get("name"), "`name` of a jump") or f"jump {index + 1}"
        if "once" in fields:
            later(reader, fields["once"], "a jump that happens only once")
        guard = here.formula(fields.get("guard"), "a guard")
        resets = read_sets(fields.get("reset"), "`reset`", here, names)
        sharpness = reader.number(fields.get("sharpness"), "`sharpness`", low=1e-9)
        if guard is not None:
            found.append(JumpDecl(name, guard, resets, sharpness, written(fields.get("guard"))))
    return tuple(found)


def read_timers(
    states: dict[str, dict[str, Node]], reader: Reader, names: Names, clock: Clockwork
) -> tuple[tuple[Assign, ...], tuple[JumpDecl, ...]]:
    """States written as `timer: up | down` with `run`, `reset_when` and `to`."""
    flows: list[Assign] = []
    jumps: list[JumpDecl] = []
    here = names.expressions(reader)
    for column in names.columns:
        found = states[column.name]
        where = f"the timer `{column.name}`"
        _misplaced(found, where, reader)
        if "timer" not in found:
            continue
        if clock.discrete:
            later(reader, found["timer"], "a timer in a discrete system")
        direction = reader.option(found["timer"], f"`timer` of {where}", ("up", "down")) or "up"
        run = here.formula(found["run"], f"`run` of {where}") if "run" in found else ir.Truth(True)
        if run is not None:
            flows.append(Assign(column.name, _running(run, direction, column.unit), f"timer {direction}"))
        guard = here.formula(found.get("reset_when"), f"`reset_when` of {where}")
        value = here.stored(found["to"], where, column.unit) if "to" in found else ir.Lit(0.0)
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
    return ir.Lit(speed) if run == ir.Truth(True) else ir.Op("mul", (ir.Lit(speed), ir.Ind(run)))


def read_sets(node: Node | None, where: str, here: Expressions, names: Names) -> tuple[Assign, ...]:
    """New values of states, in order."""
    found = []
    for entry in here.reader.entries(node, where):
        column = state_of(entry, where, here.reader, names)
        value = None if column is None else column_assign(column, entry.value, here)
        if value is not None:
            found.append(value)
    return tuple(found)


def column_assign(column: Column, node: Node, here: Expressions) -> Assign | None:
    """A value for a column: members by name for an enum, formulas for a bool, units checked."""
    where = f"`{column.name}`"
    boolean = column.kind == "bool"
    value = here.truth(node, where) if boolean else here.stored(node, where, column.unit)
    allowed = {0.0: "false", 1.0: "true"} if boolean else {number: label for label, number in column.labels}
    if allowed and isinstance(value, ir.Lit) and value.value not in allowed:
        here.reader.wrong(node, where, " or ".join(f"`{label}`" for label in allowed.values()))
        return None
    return None if value is None else Assign(column.name, value, written(node))


def state_of(entry: Entry, where: str, reader: Reader, names: Names) -> Column | None:
    """The state that a key names (S202 where it names none)."""
    name = entry.key.text
    for column in names.columns:
        if column.name == name:
            return column
    states = [column.name for column in names.columns]
    near = reader.near(name, states)
    guess = f"did you mean `{near}`?" if near else f"states: {', '.join(states)}"
    reader.report("S202", f"{where} sets `{name}`, which is not a state", entry.key.span, guess)
    return None


def rate_unit(unit: Unit) -> Unit:
    """The unit of a derivative; that of an undeclared unit is undeclared."""
    return unit / SECOND if unit.text else replace(unit)
