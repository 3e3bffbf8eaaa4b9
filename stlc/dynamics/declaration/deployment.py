"""Sections `backup`, `test` and `scenario`: backup policy, deployment (closed-loop test), scenarios."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_args

from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.columns import read_levels
from stlc.dynamics.declaration.learning import INTEGERS, Term, term_list
from stlc.dynamics.declaration.motion import SETS, Assign, components, rate_unit, read_sets, states_of
from stlc.dynamics.declaration.schema.expressions import written
from stlc.dynamics.declaration.schema.names import Context, base_name
from stlc.dynamics.declaration.schema.reader import first_line
from stlc.dynamics.declaration.schema.record import (
    EXPRESSION,
    INSTANT,
    LINE,
    NAME,
    OF,
    STEPS,
    VECTOR,
    Kind,
    fraction,
    integer,
    items_of,
    json_schema,
    key,
    list_of,
    mapping_of,
    part,
    read,
    reads,
    values_of,
    word,
)
from stlc.dynamics.declaration.schema.yaml_nodes import Mapping as MappingNode
from stlc.dynamics.declaration.schema.yaml_nodes import Node, Scalar
from stlc.files import named_in
from stlc.grammar import ast
from stlc.runtime.prefixes import SAMPLES, SAMPLINGS, Sampling
from stlc.source import Span

METRICS = ("stl_accuracy", "safety", "progress", "latency")
SPECS = (".stl", ".stlc")
Edge = Literal["rise", "fall"]
Starts = Literal["any", "savable", "feasible"]
"""Admitted initial states of agents: all, those with a known safe plan, or a known satisfying plan."""


# ------------------------------------------------------------------------------------ backup


@reads(mapping_of({"type": "array", "items": EXPRESSION}))
def _levels(cx: Context, node: Node, label: str) -> Mapping[str, tuple[float, ...]]:
    """Read `levels` of the section `backup`: name of a control -> values that the backup policy tries.

    These values replace the `levels` in the declaration of the control. `label` names the section in
    messages.
    """
    found = {}
    for entry in cx.reader.entries(node, label):
        name = entry.key.text
        meant = [each for each in cx.names.controls if name in (each.name, base_name(each.name))]
        if not meant:
            cx.reader.unknown(entry.key, label, tuple(each.name for each in cx.names.controls))
        for control in meant:
            where, bounds = f"the control `{control.name}`", (control.low, control.high)
            levels = read_levels(entry.value, where, control.unit, bounds, cx.plain)
            found[control.name] = levels or control.levels
    return MappingProxyType(found)


@dataclass(frozen=True, slots=True)
class BackupDecl:
    """The section `backup`: the control prefixes (first few steps of a plan) that the backup policy tries."""

    bins: int = key(integer(2), "values of a control, evenly over its range", 5)
    levels: Mapping[str, tuple[float, ...]] = key(_levels, "values by control, in place of `bins`", {})
    lengths: tuple[int, ...] = key(INTEGERS, "lengths of prefixes, in steps", (1, 2, 3), name="T0")
    batch: int = key(integer(), "trajectories at a time", 8192)
    samples: int = key(integer(high=1 << 20), "largest number of prefixes of one length", SAMPLES)
    sampling: Sampling = key(word(SAMPLINGS), "choice of prefixes, where there are more", "lattice")


def read_backup(cx: Context, node: Node | None, label: str) -> BackupDecl:
    """Read the section `backup` of a file or of a scenario; `label` names the section in messages.

    The lengths of control prefixes are numbers of steps. A length beyond the horizon is reported (S103) and
    dropped.
    """
    backup, horizon = read(BackupDecl, cx, node, label), cx.horizon
    lengths = node.get("T0") if isinstance(node, MappingNode) else None
    if lengths is not None and 0 < horizon < max(backup.lengths):
        cx.reader.report("S103", f"`T0` goes beyond the horizon of {horizon} steps", lengths.span)
    return replace(backup, lengths=tuple(each for each in backup.lengths if each <= horizon) or (1,))


_BACKUP = Kind(read_backup, json_schema(BackupDecl), BackupDecl)


# ------------------------------------------------------------------------------------ events


@reads(EXPRESSION)
def _trigger(cx: Context, node: Node, label: str) -> dict[str, Any] | None:
    """Read the condition of an event: a state formula, or `rise(…)` or `fall(…)` around a state formula.

    Returns the fields `when` and `edge` of `EventDecl`; None if the text cannot be parsed. `label` names the
    condition in messages.
    """
    expr = cx.here.parse(node, label)
    match expr:
        case None:
            return None
        case ast.Call(_, ast.Name(_, "rise" | "fall" as edge), (ast.Arg(_, None, value),)):
            return {"when": cx.here.formula_of(value), "edge": edge}
        case _:
            return {"when": cx.here.formula_of(expr)}


@dataclass(frozen=True, slots=True)
class EventDecl:
    """An exogenous event: a change of states between two steps, which the planner does not foresee.

    If `edge` is `rise`, the event happens only at the steps at which `when` becomes true; if it is `fall`,
    only at the steps at which `when` becomes false.
    """

    name: str = key(NAME, "for messages", "", label=OF)
    when: ir.Formula | None = key(_trigger, "condition, or `rise(…)`, `fall(…)` of one", spread=True)
    edge: Edge | None = None
    at: int | None = key(INSTANT, "time or step at which it happens once")
    every: int | None = key(STEPS, "period, as a time or in steps")
    sets: tuple[Assign, ...] = key(SETS, "new values, in order", (), name="set", required=True)


@reads(items_of(json_schema(EventDecl)), EventDecl)
def _events(cx: Context, node: Node, label: str) -> tuple[EventDecl, ...]:
    """Read a list of events, and return the valid ones; `label` names the list in messages.

    Each event has exactly one of the keys `when`, `at` and `every`.
    """
    found = []
    for index, item in enumerate(cx.reader.items(node, label)):
        event = read(EventDecl, cx, item, "an event")
        event = replace(event, name=event.name or f"event {index + 1}")
        given = {each.key.text for each in item.entries} if isinstance(item, MappingNode) else set()
        if len(given & {"when", "at", "every"}) != 1:
            message = f"the event `{event.name}` needs exactly one of `when`, `at` and `every`"
            cx.reader.report("S102", message, first_line(item.span))
        found.append(event)
    return tuple(found)


# -------------------------------------------------------------------------------------- test


@dataclass(frozen=True, slots=True)
class WorldRef:
    """Reference to a world: the class `name` in the Python file `path`, which simulates the true system."""

    path: Path
    name: str
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class JudgeRef:
    """Reference to a specification that judges closed-loop runs.

    Attributes:
        path: path of the file.
        written: the path as it is written in the system file. A run folder holds a copy of the
            specification, which is looked up by this text.
        span: source location of the path.
    """

    path: Path
    written: str
    span: Span = field(compare=False, repr=False)


@reads({"type": ["string", "null"]})
def _world(cx: Context, node: Node, _label: str) -> WorldRef | None:
    """Read the reference `file.py:Class` to a world; the path of the file is relative to the system file.

    Returns None for the value null, and for an invalid reference, which is reported.
    """
    text = None if isinstance(node, Scalar) and node.is_null else cx.reader.text(node, "`world`")
    if text is None:
        return None
    file, _, name = text.rpartition(":")
    if not file.endswith(".py") or not name.isidentifier():
        cx.reader.wrong(node, "`world`", "a Python file and a class", "write `traffic_grid.py:TrafficGrid`")
        return None
    return WorldRef(named_in(node.span.source, file), name, node.span)


@reads({"type": ["string", "null"]})
def _judge(cx: Context, node: Node, _label: str) -> JudgeRef | None:
    """Read the path of the specification that judges closed-loop runs, relative to the file that names it.

    Returns None for the value null, and for an invalid path, which is reported.
    """
    text = None if isinstance(node, Scalar) and node.is_null else cx.reader.text(node, "`judge`")
    if text is None:
        return None
    if not text.endswith(SPECS):
        cx.reader.wrong(node, "`judge`", "the path of a specification", "write `../specs/driving_rules.stl`")
        return None
    return JudgeRef(Path(os.path.normpath(named_in(node.span.source, text))), text, node.span)


@reads(items_of({"type": "string"}))
def _uncertain(cx: Context, node: Node, label: str) -> tuple[str, ...]:
    """Read the names of uncertain constants; a vector is named as a whole, not by component.

    `label` names the list in messages. A name that does not belong to a constant is reported.
    """
    known = tuple(dict.fromkeys(map(base_name, cx.names.constants)))
    items = [item for item in cx.reader.items(node, label) if isinstance(item, Scalar)]
    for item in items:
        if item.text not in known:
            cx.reader.unknown(item, label, known)
    return tuple(item.text for item in items)


@dataclass(frozen=True, slots=True)
class TestDecl:
    """The section `test`: length, number of agents, replanning period and events of a deployment."""

    __test__ = False

    steps: int = key(STEPS, "length, as a time or in steps", 200)
    agents: int = key(integer(high=100_000), "agents", 20)
    replan: int = key(integer(), "steps between plans", 1)
    events: tuple[EventDecl, ...] = key(_events, "exogenous events, in order", ())
    metrics: tuple[str, ...] = key(list_of(word(METRICS), "a metric"), "metrics to report", ())
    world: WorldRef | None = key(_world, "`file.py:Class`: a world in Python, in place of events")
    uncertain: tuple[str, ...] | None = key(
        _uncertain, "constants that `parameters` perturbs; all of the dynamics unless given"
    )
    judge: JudgeRef | None = key(_judge, "specification that closed-loop runs are judged by")
    starts: Starts = key(word(get_args(Starts)), "initial states of agents", "any")


# --------------------------------------------------------------------------------- scenarios


@dataclass(frozen=True, slots=True)
class ErrorsDecl:
    """Errors of actuators, parameters and sensors in a scenario, as fractions (0.1 is 10 %).

    The error of a control that is a direction (`squash: angle`) is a fraction of one radian. Parameters are
    the numbers in the dynamics (see `stlc.dynamics.declaration.perturbable`). States with the unit second are
    clocks and have no error.
    """

    actuator_gain: float = key(fraction, "constant relative error of every control of an agent", 0.0)
    parameters: float = key(fraction, "constant relative error of every number in the dynamics", 0.0)
    actuator_noise: float = key(fraction, "standard deviation of noise on controls, of half their range", 0.0)
    sensor_noise: float = key(fraction, "standard deviation of noise on observed states, of their range", 0.0)


@reads(mapping_of(VECTOR))
def _constants(cx: Context, node: Node, label: str) -> Mapping[str, str]:
    """Read new values of constants: name of a constant -> text of its new value.

    `label` names the mapping in messages.
    """
    found: dict[str, str] = {}
    for entry in cx.reader.entries(node, label):
        name = entry.key.text
        if name not in cx.names.constants and f"{name}[0]" not in cx.names.constants:
            cx.reader.unknown(entry.key, label, tuple(cx.names.constants))
        elif cx.plain.here.numbers(entry.value, f"`{name}`") is not None:
            found[name] = written(entry.value) or entry.value.span.text
    return MappingProxyType(found)


@reads(mapping_of(VECTOR))
def _noise(cx: Context, node: Node, label: str) -> tuple[Assign, ...]:
    return read_sets(cx.amounts(), node, label)


@reads(mapping_of(VECTOR))
def _rates(cx: Context, node: Node, label: str) -> tuple[Assign, ...]:
    """Read a disturbance: terms that are added to the derivatives (or next values) of states.

    A term added to a derivative is in the unit of the state per second. `label` names the disturbance in
    messages.
    """
    found: list[Assign] = []
    for entry in cx.reader.entries(node, label):
        columns = states_of(entry, label, cx)
        if columns:
            unit = columns[0].unit if cx.discrete else rate_unit(columns[0].unit)
            found.extend(components(columns, entry.value, f"`{entry.key.text}`", unit, cx.amounts()))
    return tuple(found)


@dataclass(frozen=True, slots=True)
class ScenarioDecl:
    """An entry of `scenario`: a named set of changes to a deployment."""

    name: str
    doc: str = key(LINE, "one line for people", "")
    expect: str = key(word(("nominal", "ood")), "`ood`: states that training never drew", "nominal")
    constants: Mapping[str, str] = key(
        _constants, "other values of constants, in model and truth", {}, name="const"
    )
    override: tuple[Assign, ...] = key(SETS, "initial values, drawn after all others", ())
    events: tuple[EventDecl, ...] = key(_events, "events beside those of `test`", ())
    disturb: tuple[Assign, ...] = key(_rates, "additions to derivatives of the truth, not of the model", ())
    noise: tuple[Assign, ...] = key(_noise, "additions to the states that agents observe", ())
    mismatch: Mapping[str, str] = key(
        _constants, "constants of the truth that the model does not know", {}, name="model_mismatch"
    )
    errors: ErrorsDecl = key(part(ErrorsDecl), "errors, as shares", ErrorsDecl())
    world: WorldRef | None = key(_world, "world in place of that of `test`")
    prefer: tuple[Term, ...] = key(
        term_list, "performance terms that plans are ranked by, beside those of `objective`", ()
    )
    backup: BackupDecl | None = key(_BACKUP, "backup in place of that of the system")
    judge: JudgeRef | None = key(_judge, "specification in place of that of `test`")


def read_scenarios(node: Node | None, cx: Context) -> tuple[ScenarioDecl, ...]:
    """Read the section `scenario` and return all scenarios, in order.

    All of them are checked, although a simulation uses only one.
    """
    return tuple(
        ScenarioDecl(
            entry.key.text,
            **values_of(ScenarioDecl, cx.timed, entry.value, f"the scenario `{entry.key.text}`", OF),
        )
        for entry in cx.reader.entries(node, "`scenario`")
        if cx.reader.nameable(entry.key, "the name of a scenario")
    )
