"""Sections that declare names: `time`, `const`, `def`, `state`, `param` and `control`.

A column is one scalar state or parameter; a vector state of size n is n columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Protocol, get_args

from stlc.compile.frontend.arithmetic import absolute
from stlc.compile.frontend.scope import Definition, Known, column_entries, member_entries
from stlc.compile.frontend.values import Number, VectorValue
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.ranges import usual_range
from stlc.dynamics.declaration.motion import Assign, JumpDecl, shared_draws, state_assigns
from stlc.dynamics.declaration.schema.expressions import SECOND, written
from stlc.dynamics.declaration.schema.names import Context, ControlDecl, Names, Squash, component_names
from stlc.dynamics.declaration.schema.reader import Reader
from stlc.dynamics.declaration.schema.record import (
    EXPRESSION,
    FLAG,
    INSTANT,
    OF,
    SECONDS,
    STEPS,
    VECTOR,
    integer,
    items_of,
    key,
    raw,
    read,
    reads,
    values_of,
    word,
)
from stlc.dynamics.declaration.schema.yaml_nodes import Entry, Mapping, Node, Scalar, Sequence
from stlc.grammar import ast
from stlc.registry import INTEGRATORS
from stlc.signature import Column, Role
from stlc.units import Unit

Ranges = tuple[tuple[float, float], ...]

RANGE = raw({"type": "array", "prefixItems": [VECTOR, VECTOR], "minItems": 2, "maxItems": 2})
_SIZE = integer(high=Column.MAX_COMPONENTS)
_ENUM = raw({"type": ["array", "object"]})
_FORMULA = raw(EXPRESSION)


@reads({"type": "string"})
def unit_text(cx: Context, node: Node, _label: str) -> Unit | None:
    """Read a unit such as `m/s^2`; report S103 and return None if the text is not a unit."""
    text = cx.reader.text(node, "`unit`")
    try:
        return None if text is None else Unit.parse(text)
    except ValueError as error:
        advice = Unit.celsius_advice(text or "") or ("a unit is a product of powers, for example `m/s^2`",)
        cx.reader.report("S103", str(error), node.span, *advice)
        return None


@dataclass(frozen=True, slots=True)
class Clockwork:
    """The section `time`: time step, horizon, integration method.

    The horizon is 0 if it is missing or invalid.
    """

    dt: Fraction = key(SECONDS, "time step, exact", Fraction(1, 10), required=True)
    horizon: int = key(STEPS, "planning horizon, as a time or in steps", 0, required=True)
    integrator: str = key(word(INTEGRATORS.names), "integration method", "euler")
    substeps: int = key(integer(high=1000), "integration steps within one step", 1)
    discrete: bool = key(FLAG, "`flow` gives next values instead of derivatives", False)
    mission: int | None = key(INSTANT, "end of missions, to which plans reach; 0: none")


class Shaped(Protocol):
    """Keys that say which values the columns of a name can take."""

    unit: Unit
    ends: Node | None
    enum: Node | None
    boolean: bool
    size: int | None


@dataclass(repr=False, eq=False)
class StateKeys:
    """The keys that the declaration of one state may have."""

    unit: Unit = key(unit_text, "unit of the stored numbers", Unit())
    ends: Node | None = key(RANGE, "lower and upper end, numbers or vectors", name="range")
    clamp: bool = key(FLAG, "kept within `range` after every substep", False)
    role: str = key(word(("state", "env")), "`env`: changed by events alone", "state")
    enum: Node | None = key(_ENUM, "members, by name or by name and value")
    boolean: bool = key(FLAG, "takes 0 and 1", False, name="bool")
    size: int | None = key(_SIZE, "components of a vector")
    timer: Node | None = key(raw({"enum": ["up", "down"]}), "counts seconds up or down")
    run: Node | None = key(_FORMULA, "condition under which a timer runs")
    reset_when: Node | None = key(_FORMULA, "condition that resets a timer")
    to: Node | None = key(raw(EXPRESSION), "value after a reset; 0 unless given")


@dataclass(repr=False, eq=False)
class ParamKeys:
    """The keys that the declaration of one parameter may have."""

    unit: Unit = key(unit_text, "unit of the stored numbers", Unit())
    ends: Node | None = key(RANGE, "drawn uniformly from it unless `draw` is given", name="range")
    draw: Node | None = key(raw(VECTOR), "distribution of the value")
    size: int | None = key(_SIZE, "components of a vector")
    enum: Node | None = key(_ENUM, "members, by name or by name and value")
    boolean: bool = key(FLAG, "takes 0 and 1", False, name="bool")


@dataclass(repr=False, eq=False)
class ControlKeys:
    """The keys that the declaration of one control may have."""

    unit: Unit = key(unit_text, "unit of the stored numbers", Unit())
    ends: Node | None = key(RANGE, "lower and upper end, numbers or vectors", name="range")
    squash: Squash = key(
        word(get_args(Squash)), "map from a network output to the range; `angle`: a direction", "tanh"
    )
    levels: Node | None = key(raw(items_of(EXPRESSION)), "values that a search may try")
    size: int | None = key(_SIZE, "components of a vector")


# ------------------------------------------------------------- time, constants, definitions


def read_time(node: Node | None, cx: Context) -> Clockwork:
    """Read the section `time`, and declare the name `dt` (the time step) for expressions."""
    if node is None:
        return Clockwork()
    first = node.get("dt") if isinstance(node, Mapping) else None
    silent = replace(cx.here, reader=Reader(cx.reader.source))
    clock = read(Clockwork, replace(cx, dt=silent.duration(first, "`dt`") or cx.dt), node, "`time`")
    cx.names.entries["dt"] = Known(Number.fixed(float(clock.dt), SECOND), "the step")
    return clock


def read_constants(node: Node | None, cx: Context) -> None:
    """Read the section `const` and declare its numbers and vectors; a value may use earlier constants."""
    names = cx.names
    for entry in cx.reader.entries(node, "`const`"):
        name = entry.key.text
        if not names.declare(entry.key, "constant", cx.reader):
            continue
        where = f"the constant `{name}`"
        numbers = cx.plain.here.numbers(entry.value, where)
        if numbers is None:
            names.entries[name] = Known(Number.fixed(1.0), "constant")
            continue
        vector = len(numbers) > 1 or isinstance(entry.value, Sequence)
        called = component_names(name, len(numbers) if vector else None)
        for component, number in zip(called, numbers, strict=True):
            if number.constant is None:
                cx.reader.wrong(entry.value, where, "a number that is known now")
                break
            known = absolute(number).constant or 0.0
            names.constants[component] = (known, Unit() if number.bare else number.unit)
        names.place_components(name, called)
        value = VectorValue(numbers) if vector else numbers[0]
        names.entries[name] = Known(value, "constant", entry.key.span)
        if names.changes is not None:
            again = replace(cx.moving.here, rewrite=None).numbers(entry.value, where) or numbers
            changed = Known(VectorValue(again) if vector else again[0], "constant", entry.key.span)
            names.changes.constants[name] = names.changes.constant(name, changed)


def read_definitions(node: Node | None, cx: Context) -> None:
    """Read the section `def` and declare its named numbers and formulas; unused ones are checked too."""
    parsed: list[ast.Expr] = []
    for entry in cx.reader.entries(node, "`def`"):
        name = entry.key.text
        if not cx.names.declare(entry.key, "definition", cx.reader):
            continue
        expr = cx.plain.here.parse(entry.value, f"the definition `{name}`")
        if expr is not None:
            parsed.append(expr)
            cx.names.entries[name] = Definition(name, expr, about="definition", span=entry.key.span)
    here = cx.plain.here
    for expr in parsed:
        here.check(expr)


# ---------------------------------------------------------------------------------- states


def read_states(node: Node | None, cx: Context) -> dict[str, StateKeys]:
    """Read the section `state`: return the keys of every state, by name.

    The columns of the states (one per scalar or vector component) are declared as names.
    """
    reader, names = cx.reader, cx.names
    if node is None:
        reader.report("S102", "the file lacks `state`", reader.source.span(0, 1), "state: {x: {unit: m}}")
    described: dict[str, StateKeys] = {}
    for entry in reader.entries(node, "`state`"):
        names.declare(entry.key, "state", reader)
        where = f"the state `{entry.key.text}`"
        given = values_of(StateKeys, cx.plain, entry.value, where, OF)
        keys = described[entry.key.text] = StateKeys(**given)
        if keys.clamp and keys.ends is None:
            message, advice = f"{where} is clamped but has no range", "add `range: [low, high]`"
            reader.report("S204", message, entry.place("clamp"), advice)
        if keys.timer is not None and "size" in given:
            message = f"the timer `{entry.key.text}` is a single number"
            reader.report("S103", message, entry.place("size"), "declare one a timer")
        role: Role = "env" if keys.role == "env" else "state"
        columns = declared_columns(entry.key.text, keys, where, cx.plain)
        names.columns += (replace(each, role=role, fact=each.fact or keys.clamp) for each in columns)
        names.place_components(entry.key.text, [column.name for column in columns])
    name_columns(names, "state")
    return described


def name_columns(names: Names, about: str) -> None:
    """Make the columns in `names`, and the members of their enums, available as names in expressions.

    `about` describes a column in messages, for example "parameter".
    """
    known = column_entries(names.columns, about=about)
    names.entries |= {name: entry for name, entry in known.items() if name not in names.entries}
    names.entries |= member_entries(column.labels for column in names.columns if column.kind == "enum")


def declared_columns(name: str, keys: Shaped, where: str, cx: Context) -> tuple[Column, ...]:
    """Return the columns of the name `name`, made from its keys.

    `where` names its declaration in messages.
    """
    called = component_names(name, keys.size)
    if keys.enum is not None:
        labels = _members(keys.enum, where, cx.reader)
        values = [value for _, value in labels] or [0.0]
        shared = Column("", keys.unit, "enum", "state", min(values), max(values), labels, fact=True)
    elif keys.boolean:
        shared = Column("", keys.unit, "bool", "state", 0.0, 1.0, (), fact=True)
    else:
        bounds = read_ranges(keys.ends, keys.unit, len(called), where, cx) or ((None, None),) * len(called)
        return tuple(
            Column(each, keys.unit, low=low, high=high)
            for each, (low, high) in zip(called, bounds, strict=True)
        )
    return tuple(replace(shared, name=each) for each in called)


def _members(node: Node, where: str, reader: Reader) -> tuple[tuple[str, float], ...]:
    """Return (name, value) of each member of an enum, written `{stop: 0, light: 1}` or `[stop, light]`.

    `where` names the enum in messages.
    """
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
        message = f"{where} needs members, each with a name and a value of its own"
        reader.report("S103", message, node.span, "{enum: {stop: 0, go: 1}}")
    return tuple(members)


def read_ranges(node: Node | None, unit: Unit, size: int, where: str, cx: Context) -> Ranges | None:
    """Return (low, high) from `range: [low, high]`, in `unit`, for each of `size` components.

    Each of `low` and `high` is one number for all components, or a vector with one entry per component.
    `where` names the declaration in messages.
    """
    reader, here = cx.reader, cx.here
    if node is None:
        return None
    items = reader.items(node, f"`range` of {where}")
    if len(items) != 2:
        if items or (isinstance(node, Sequence) and not node.items):
            reader.wrong(node, f"`range` of {where}", "two numbers `[low, high]`")
        return None
    lows = here.constants(items[0], f"the lower bound of {where}", unit, size)
    highs = here.constants(items[1], f"the upper bound of {where}", unit, size)
    if lows is None or highs is None:
        return None
    for low, high in zip(lows, highs, strict=True):
        if not low < high:
            message = f"the range of {where} ends before it starts"
            reader.report("S204", message, node.span, f"[{high:g}, {low:g}]")
            return None
    return tuple(zip(lows, highs, strict=True))


# ---------------------------------------------------------------------------------- timers


def read_timers(states: dict[str, StateKeys], cx: Context) -> tuple[list[Assign], list[JumpDecl]]:
    """Read the timers: states with `timer: up` or `timer: down`.

    Returns the assignments of `flow` that advance the timers, and one jump per timer. A timer counts seconds
    while its condition `run` holds. When `reset_when` holds, the jump sets the timer to the value of `to`.
    """
    flows: list[Assign] = []
    jumps: list[JumpDecl] = []
    for name, keys in states.items():
        where = f"the timer `{name}`"
        if keys.timer is None:
            for called, node in (("run", keys.run), ("reset_when", keys.reset_when), ("to", keys.to)):
                if node is not None:
                    message = f"`{called}` needs `timer: up` or `timer: down` in {where}"
                    cx.reader.report("S102", message, node.span)
        elif not cx.names.vector(name):
            unit = cx.names.group(name)[0].unit
            flows += _timer_flow(name, keys, unit, cx)
            guard = cx.here.formula(keys.reset_when, f"`reset_when` of {where}")
            value = ir.Const(0.0) if keys.to is None else cx.here.stored(keys.to, where, unit)
            if guard is not None and value is not None:
                reset = Assign(name, value, written(keys.to))
                jumps.append(JumpDecl(f"reset {name}", guard, (reset,), text=written(keys.reset_when)))
    return flows, jumps


def _timer_flow(name: str, keys: StateKeys, unit: Unit, cx: Context) -> tuple[Assign, ...]:
    """Return the assignment that advances one timer; the tuple is empty if its condition `run` is invalid.

    The assigned value is the derivative of the timer, or its next value in a discrete-time system.
    """
    where = f"the timer `{name}`"
    direction = cx.reader.option(keys.timer, f"`timer` of {where}", ("up", "down")) or "up"
    run = ir.Truth(True) if keys.run is None else cx.here.formula(keys.run, f"`run` of {where}")
    if run is None:
        return ()
    speed = ir.Const((1.0 if direction == "up" else -1.0) / unit.scale)
    rate: ir.Num = speed if run.constant else speed * run.indicator()
    if cx.discrete:
        rate = ir.Signal(name) + ir.Const(float(cx.dt)) * rate
    return (Assign(name, rate, f"timer {direction}"),)


# ------------------------------------------------------------------------------ parameters


def read_params(node: Node | None, cx: Context) -> tuple[Assign, ...]:
    """Read the section `param`; return the distributions of the parameters, in order.

    The parameters are appended to the columns, after the states. `r: {unit: m, range: [0.6, 1.2]}` is uniform
    on its range; the key `draw` gives another distribution, and `r: normal(1 m, 0.1 m)` is short for it. The
    distribution of a parameter may depend on earlier parameters.
    """
    names = cx.names
    found: list[Assign] = []
    drawn: frozenset[str] = frozenset()
    for entry in cx.reader.entries(node, "`param`"):
        name = entry.key.text
        if not names.declare(entry.key, "parameter", cx.reader):
            continue
        here = cx.drawing({}, drawn)
        keys = _param_keys(entry, here)
        columns = [
            replace(each, role="env")
            for each in declared_columns(name, keys, f"the parameter `{name}`", here)
        ]
        names.columns += columns
        names.place_components(name, [column.name for column in columns])
        if keys.draw is not None:
            assigns = shared_draws(state_assigns(Entry(entry.key, keys.draw), "`param`", here))
        else:
            assigns = tuple(Assign(column.name, *_even(column)) for column in columns)
        found.extend(assigns)
        names.columns[-len(columns) :] = [_ranged(column, assigns) for column in columns]
        name_columns(names, "parameter")
        drawn |= {column.name for column in columns}
    return tuple(found)


def _param_keys(entry: Entry, cx: Context) -> ParamKeys:
    """Read the keys of a parameter.

    `r: normal(1 m, 0.1 m)` is short for a mapping with the key `draw`; the parameter then has the unit of the
    expression.
    """
    if isinstance(entry.value, Scalar):
        number = replace(cx.here, reader=Reader(cx.reader.source)).number(entry.value, "")
        unit = Unit() if number is None or number.bare else number.unit
        return ParamKeys(unit=unit if unit.offset else unit.si, draw=entry.value)
    where = f"the parameter `{entry.key.text}`"
    given = values_of(ParamKeys, cx, entry.value, where, OF)
    named = {each.key.text for each in entry.value.entries} if isinstance(entry.value, Mapping) else set()
    if not named & {"draw", "range", "enum", "bool"}:
        cx.reader.report(
            "S102",
            f"{where} says nothing about its values",
            entry.key.span,
            f'{entry.key.text}: {{range: [0, 1]}}, or {entry.key.text}: "uniform(0, 1)"',
        )
    return ParamKeys(**given)


def _even(column: Column) -> tuple[ir.Num, str]:
    """Return the uniform distribution over the values that a column can take.

    The result is a pair: the distribution as a numeric expression, and as text.
    """
    if column.labels:
        members = ", ".join(label for label, _ in column.labels)
        return ir.Op("choice", tuple(ir.Const(value) for _, value in column.labels)), f"choice({members})"
    if column.kind == "bool":
        return ir.Op("bernoulli", (ir.Const(0.5),)), "bernoulli(0.5)"
    low, high = column.low or 0.0, column.high or 0.0
    return ir.Op("uniform", (ir.Const(low), ir.Const(high))), f"uniform({low:g}, {high:g})"


def _ranged(column: Column, assigns: tuple[Assign, ...]) -> Column:
    """Return a random column without a declared range with the range of nearly all its values."""
    draw = next((assign.value for assign in assigns if assign.name == column.name), None)
    ends = None if draw is None or column.low is not None else usual_range(draw)
    return column if ends is None or ends[0] == ends[1] else replace(column, low=ends[0], high=ends[1])


# -------------------------------------------------------------------------------- controls


def read_controls(node: Node | None, cx: Context) -> None:
    """Read the section `control`, and declare its controls as names."""
    reader, names = cx.reader, cx.names
    for entry in reader.entries(node, "`control`"):
        names.declare(entry.key, "control", reader)
        name = entry.key.text
        where, here = f"the control `{name}`", cx.plain
        keys = read(ControlKeys, here, entry.value, where, OF)
        if keys.ends is None:
            advice = f"{name}: {{range: [-1, 1]}}"
            reader.report("S204", f"{where} has no range", entry.key.span, advice, label="needs bounds")
        called = component_names(name, keys.size)
        bounds = read_ranges(keys.ends, keys.unit, len(called), where, here) or ((-1.0, 1.0),) * len(called)
        common = max(low for low, _ in bounds), min(high for _, high in bounds)
        levels = read_levels(keys.levels, where, keys.unit, common, here)
        for each, ends in zip(called, bounds, strict=True):
            names.controls.append(ControlDecl(each, keys.unit, *ends, keys.squash, levels))
        names.place_components(name, called)
    columns = [Column(c.name, c.unit, "real", "input", c.low, c.high, (), fact=True) for c in names.controls]
    names.entries |= column_entries(columns, about="control")


def read_levels(
    node: Node | None, where: str, unit: Unit, bounds: tuple[float, float], cx: Context
) -> tuple[float, ...]:
    """Read `levels`: the values that a search may try for a control. They must lie within `bounds`.

    `where` names the control in messages. Returns the values in `unit`.
    """
    items = cx.reader.items(node, f"`levels` of {where}")
    levels = [cx.here.constant(item, f"a level of {where}", unit) for item in items]
    low, high = bounds
    for item, level in zip(items, levels, strict=True):
        if level is not None and not low <= level <= high:
            message, advice = f"a level of {where} is outside its range", f"the range is [{low:g}, {high:g}]"
            cx.reader.report("S204", message, item.span, advice)
    return tuple(level for level in levels if level is not None)
