"""Sections `flow` and `jump`: derivatives, and the guards (conditions) and resets (new values) of jumps.

The motion of timers is included.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import sampler_names
from stlc.dynamics.declaration.schema.expressions import SECOND, written
from stlc.dynamics.declaration.schema.names import Context
from stlc.dynamics.declaration.schema.reader import first_line
from stlc.dynamics.declaration.schema.record import (
    FLAG,
    FORMULA,
    NAME,
    OF,
    VECTOR,
    Kind,
    key,
    mapping_of,
    number,
    values_of,
)
from stlc.dynamics.declaration.schema.yaml_nodes import Entry, Mapping, Node, Scalar
from stlc.dynamics.declaration.schema.yaml_nodes import Sequence as ListNode
from stlc.signature import Column
from stlc.similar import did_you_mean
from stlc.units import Unit

_SAMPLERS = frozenset(sampler_names())


@dataclass(frozen=True, slots=True)
class Assign:
    """Assignment of a number to a column or a local name: a new value or, in `flow`, a derivative.

    Attributes:
        name: name of the column or local name.
        value: the number, in the unit of the column; a derivative in that unit per second.
        text: source text of the value.
    """

    name: str
    value: ir.Num
    text: str = field(default="", compare=False)


# ----------------------------------------------------------------------------- new values


def read_sets(cx: Context, node: Node | None, label: str) -> tuple[Assign, ...]:
    """Read new values of states, as in the entry `set` of an event; return the assignments in order.

    `label` names the mapping in messages.
    """
    found: list[Assign] = []
    for entry in cx.reader.entries(node, label):
        found.extend(shared_draws(state_assigns(entry, label, cx)))
    return tuple(found)


SETS = Kind(read_sets, mapping_of(VECTOR))
"""New values by the names of states."""


def state_assigns(entry: Entry, where: str, cx: Context) -> tuple[Assign, ...]:
    """Read the value of a state; return one assignment, or one per component of a vector.

    The key of `entry` is the name of the state. `where` names the mapping in messages.
    """
    columns = states_of(entry, where, cx)
    if not columns:
        return ()
    if not cx.names.vector(entry.key.text):
        found = column_assign(columns[0], entry.value, cx)
        return () if found is None else (found,)
    if columns[0].kind == "real":
        return components(columns, entry.value, f"`{entry.key.text}`", columns[0].unit, cx)
    items = (entry.value,) * len(columns)
    if isinstance(entry.value, ListNode):
        items = cx.reader.items(entry.value, where)
    if len(items) != len(columns):
        message = f"`{entry.key.text}` has {len(columns)} components, this has {len(items)}"
        cx.reader.report("S203", message, first_line(entry.value.span))
        return ()
    each = [column_assign(column, item, cx) for column, item in zip(columns, items, strict=True)]
    return tuple(found for found in each if found is not None)


def components(
    columns: tuple[Column, ...], node: Node, where: str, unit: Unit, cx: Context
) -> tuple[Assign, ...]:
    """Read the value of a vector in `unit`; return one assignment for each of `columns`, its components.

    The tuple is empty if the value is invalid. `where` names the vector in messages.
    """
    values = cx.here.stored_each(node, where, unit, len(columns))
    if values is None:
        return ()
    texts = component_texts(node, len(columns))
    return tuple(
        Assign(column.name, value, text) for column, value, text in zip(columns, values, texts, strict=True)
    )


def component_texts(node: Node, size: int) -> tuple[str, ...]:
    """Return the source text of each of the `size` components of a vector.

    For a vector in one expression, the texts are `(a + b)[0]`, `(a + b)[1]`, ….
    """
    if isinstance(node, ListNode):
        return tuple(written(item) for item in node.items)
    text = written(node)
    return tuple(f"{text if text.isidentifier() else f'({text})'}[{index}]" for index in range(size))


def column_assign(column: Column, node: Node, cx: Context) -> Assign | None:
    """Read the value of one column, and check its unit.

    The value of an enum column is the name of a member. The value of a bool column is a formula. Any other
    value is a number. Returns None if the value is invalid.
    """
    where = f"`{column.name}`"
    boolean, here = column.kind == "bool", cx.here
    value = here.truth(node, where) if boolean else here.stored(node, where, column.unit)
    allowed = {0.0: "false", 1.0: "true"} if boolean else {number: label for label, number in column.labels}
    if allowed and isinstance(value, ir.Const) and value.value not in allowed:
        cx.reader.wrong(node, where, " or ".join(f"`{label}`" for label in allowed.values()))
        return None
    return None if value is None else Assign(column.name, value, written(node))


def states_of(entry: Entry, where: str, cx: Context) -> tuple[Column, ...]:
    """Return the columns of the state that the key of `entry` names; report S202 if there is no such state.

    `where` names the mapping in the message.
    """
    name = entry.key.text
    columns = cx.names.group(name)
    if columns:
        return columns
    states = cx.names.states
    advice = did_you_mean(name, states, f"states: {', '.join(states)}")
    cx.reader.report("S202", f"{where} sets `{name}`, which is not a state", entry.key.span, *advice)
    return ()


def rate_unit(unit: Unit) -> Unit:
    """Return the unit of the derivative of a column with unit `unit`; undeclared if `unit` is undeclared."""
    return unit / SECOND if unit.text else replace(unit)


# ----------------------------------------------------------------------------------- flow


def read_flow(node: Node | None, cx: Context) -> tuple[Assign, ...]:
    """Read the section `flow`: derivatives in the unit of the state per second, or next values."""
    found: list[Assign] = []
    for entry in cx.reader.entries(node, "`flow`"):
        columns = states_of(entry, "`flow`", cx)
        if not columns:
            continue
        first = columns[0]
        if first.kind != "real" and not cx.discrete:
            kind = "true or false" if first.kind == "bool" else "an enum"
            message = f"`flow` sets `{entry.key.text}`, which is {kind}"
            cx.reader.report("S203", message, entry.key.span, "change it with a jump or an event")
            continue
        if cx.discrete:
            where, unit = f"the next `{entry.key.text}`", first.unit
        else:
            where, unit = f"the derivative of `{entry.key.text}`", rate_unit(first.unit)
        if cx.names.vector(entry.key.text):
            found.extend(components(columns, entry.value, where, unit, cx))
            continue
        value = cx.here.stored(entry.value, where, unit)
        if value is not None:
            found.append(Assign(first.name, value, written(entry.value)))
    return tuple(found)


# ----------------------------------------------------------------------------------- jumps


@dataclass(frozen=True, slots=True)
class JumpDecl:
    """A jump: a condition (`guard`) and new values of states (`resets`).

    If the guard holds at the start of a step, the resets, not the flow, give the next values of their states.
    If the jump is `located`, they take place within the step, when the guard begins to hold.
    """

    name: str = key(NAME, "for messages", "", label=OF)
    guard: ir.Formula = key(FORMULA, "condition on the state", label="a guard", required=True)
    resets: tuple[Assign, ...] = key(SETS, "new values", (), name="reset", required=True)
    sharpness: float | None = key(number(1e-9), "of the blend with the flow in training (w of Eq. 6)")
    text: str = field(default="", compare=False)
    once: bool = key(FLAG, "at most once in a trajectory", False, shown=False)
    located: bool = key(FLAG, "at the instant at which the guard begins to hold", False, shown=False)


def read_jumps(node: Node | None, cx: Context) -> tuple[JumpDecl, ...]:
    """Read the section `jump`: the jumps, in file order."""
    found: list[JumpDecl] = []
    for index, item in enumerate(cx.reader.items(node, "`jump`")):
        values = values_of(JumpDecl, cx, item, "a jump")
        if "guard" not in values:
            continue
        guard = item.get("guard") if isinstance(item, Mapping) else None
        jump = JumpDecl(**{"name": f"jump {index + 1}", "text": written(guard), **values})
        if jump.located:
            _check_located(item, cx)
        if jump.once:
            latch = latch_name(jump.name)
            open_ = ir.Predicate(0.5 - ir.Signal(latch))
            resets = (*jump.resets, Assign(latch, ir.Const(1.0), "true"))
            jump = replace(jump, guard=jump.guard & open_, resets=resets)
        found.append(jump)
    return tuple(found)


def _check_located(jump: Node, cx: Context) -> None:
    """Report E015 where a jump cannot be located within a step."""
    why = ""
    if cx.discrete:
        why = "a discrete system has no instants within a step"
    elif cx.names.controls:
        why = "training has no derivative of the instants of jumps"
    if why:
        place = jump.get("located") if isinstance(jump, Mapping) else None
        message = f"`located` is for systems in continuous time without controls: {why}"
        cx.reader.report("E015", message, (place or jump).span, "leave it out, and shorten the step")


def read_latches(node: Node | None, cx: Context) -> tuple[Assign, ...]:
    """Declare a bool state for every jump with `once`; it is true once the jump has happened.

    Returns the assignments that set these states to false at the start.
    """
    found: list[Assign] = []
    for index, item in enumerate(node.items if isinstance(node, ListNode) else ()):
        once = item.get("once") if isinstance(item, Mapping) else None
        if not isinstance(once, Scalar) or once.boolean is not True or not isinstance(item, Mapping):
            continue
        written_name = item.get("name")
        name = written_name.text if isinstance(written_name, Scalar) else f"jump {index + 1}"
        latch = latch_name(name)
        if cx.names.group(latch) or latch in cx.names.places:
            cx.reader.report("E102", f"`{latch}` remembers the jump `{name}`, and is declared", once.span)
            continue
        cx.names.places[latch] = once.span
        cx.names.columns.append(Column(latch, Unit(), "bool", "state", 0.0, 1.0, (), fact=True))
        found.append(Assign(latch, ir.Const(0.0), "false"))
    return tuple(found)


def latch_name(jump: str) -> str:
    """Name of the bool state that records whether the jump called `jump` has happened."""
    return f"{re.sub(r'[^0-9A-Za-z_]', '_', jump)}_happened"


# ------------------------------------------------------------------------- shared samplers


def shared_draws(assigns: Sequence[Assign]) -> tuple[Assign, ...]:
    """Return assignments in which a random number that occurs in several of them is drawn only once.

    For a vector, `p: "uniform(0, 1) * [1, 2]"` gives two assignments with the same `uniform(0, 1)`. A new
    assignment before them draws the number and stores it in a local name; the two then read this name. In
    contrast, `p: "uniform(low, high)"` with vectors `low` and `high` draws one random number per component.
    """
    if len(assigns) < 2:
        return tuple(assigns)
    readers = Counter(
        draw
        for assign in assigns
        for draw in {
            id(part)
            for part in assign.value.subexpressions()
            if isinstance(part, ir.Op) and part.name in _SAMPLERS
        }
    )
    shared = {draw for draw, count in readers.items() if count > 1}
    if not shared:
        return tuple(assigns)
    before: list[Assign] = []
    known: dict[int, ir.Num] = {}

    def rewritten(num: ir.Num) -> ir.Num:
        """Return the number with each sampler that is drawn once replaced by the local name of its value."""
        if id(num) not in known:
            changed = num.map_parts(rewritten)
            if id(num) in shared:
                before.append(Assign(f"{assigns[0].name}#{len(before)}", changed))
                changed = ir.Signal(before[-1].name)
            known[id(num)] = changed
        return known[id(num)]

    changed = [replace(assign, value=rewritten(assign.value)) for assign in assigns]
    return (*before, *changed)
