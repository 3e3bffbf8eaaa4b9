"""The section `test`: a deployment, its events, and the world that may take their place."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path
from typing import Literal, cast, get_args

from stlc.compile.frontend.scope import Known
from stlc.compile.frontend.values import Number
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.deployment import EventDecl, JudgeRef, Starts, TestDecl, WorldRef
from stlc.dynamics.schema.expressions import SECOND, Expressions, written
from stlc.dynamics.schema.flow import read_sets
from stlc.dynamics.schema.names import Names, base_name
from stlc.dynamics.schema.reader import Reader, first_line
from stlc.dynamics.schema.yaml_nodes import Node, Scalar
from stlc.grammar import ast

TEST_KEYS = ("steps", "agents", "replan", "events", "metrics", "world", "uncertain", "judge", "starts")
EVENT_KEYS = ("name", "when", "at", "every", "set")
METRICS = ("stl_accuracy", "safety", "progress", "latency")
SPECS = (".stl", ".stlc")
Edge = Literal["rise", "fall"]
STARTS: tuple[Starts, ...] = get_args(Starts)


def read_test(node: Node | None, reader: Reader, names: Names, dt: Fraction) -> TestDecl:
    """The section `test`."""
    found = reader.fields(node, "`test`", TEST_KEYS)
    default = TestDecl()
    clock = Known(Number(ir.Signal("t"), SECOND), "seconds since the start of the deployment")
    here = names.expressions(reader).extended({"t": clock} if "t" not in names.places else {}, samplers=True)
    steps = here.steps(found["steps"], "`steps`", dt) if "steps" in found else None
    metrics = [
        reader.option(item, "a metric", METRICS) for item in reader.items(found.get("metrics"), "`metrics`")
    ]
    items = reader.items(found.get("events"), "`events`")
    return TestDecl(
        steps or default.steps,
        reader.integer(found.get("agents"), "`agents`", high=100_000) or default.agents,
        reader.integer(found.get("replan"), "`replan`") or default.replan,
        tuple(read_event(item, index, here, names, dt) for index, item in enumerate(items)),
        tuple(metric for metric in metrics if metric),
        read_world(found.get("world"), reader),
        _uncertain(found["uncertain"], reader, names) if "uncertain" in found else None,
        read_judge(found.get("judge"), reader),
        _starts(found.get("starts"), reader) or default.starts,
    )


def _starts(node: Node | None, reader: Reader) -> Starts | None:
    return None if node is None else cast("Starts | None", reader.option(node, "`starts`", STARTS))


def _uncertain(node: Node, reader: Reader, names: Names) -> tuple[str, ...]:
    """Constants, by name; a vector has one."""
    known = tuple(dict.fromkeys(map(base_name, names.constants)))
    items = [item for item in reader.items(node, "`uncertain`") if isinstance(item, Scalar)]
    for item in items:
        if item.text not in known:
            reader.unknown(item, "`uncertain`", known)
    return tuple(item.text for item in items)


def read_event(node: Node, index: int, here: Expressions, names: Names, dt: Fraction) -> EventDecl:
    """One event: exactly one of `when`, `at` and `every`."""
    reader = here.reader
    found = reader.fields(node, "an event", EVENT_KEYS, required=("set",))
    name = reader.name(found.get("name"), "`name` of an event") or f"event {index + 1}"
    triggers = [key for key in ("when", "at", "every") if key in found]
    if len(triggers) != 1:
        place = first_line(node.span)
        reader.report("S102", f"the event `{name}` needs exactly one of `when`, `at` and `every`", place)
    when, edge = _condition(found.get("when"), here)
    return EventDecl(
        name,
        read_sets(found.get("set"), "`set`", here, names),
        when,
        edge,
        _moment(found.get("at"), here, dt),
        here.steps(found["every"], "`every`", dt) if "every" in found else None,
    )


def _moment(node: Node | None, here: Expressions, dt: Fraction) -> int | None:
    """A step of the deployment; 0 is its start."""
    if node is None:
        return None
    if written(node) in {"0", "0 s", "0 steps"}:
        return 0
    return here.steps(node, "`at`", dt)


def _condition(node: Node | None, here: Expressions) -> tuple[ir.Formula | None, Edge | None]:
    """A state formula, or `rise(…)`, `fall(…)` of one."""
    expr = here.parse(node, "`when`") if node is not None else None
    match expr:
        case None:
            return None, None
        case ast.Call(_, ast.Name(_, "rise"), (ast.Arg(_, None, value),)):
            return here.formula_of(value), "rise"
        case ast.Call(_, ast.Name(_, "fall"), (ast.Arg(_, None, value),)):
            return here.formula_of(value), "fall"
        case _:
            return here.formula_of(expr), None


def read_world(node: Node | None, reader: Reader) -> WorldRef | None:
    """`file.py:Class`, relative to the system file."""
    if node is None or (isinstance(node, Scalar) and node.is_null):
        return None
    text = reader.text(node, "`world`")
    if text is None:
        return None
    file, _, name = text.rpartition(":")
    if not file.endswith(".py") or not name.isidentifier():
        reader.wrong(node, "`world`", "a Python file and a class", "write `traffic_grid.py:TrafficGrid`")
        return None
    return WorldRef(Path(node.span.source.name).parent / file, name, node.span)


def read_judge(node: Node | None, reader: Reader) -> JudgeRef | None:
    """A specification, relative to the file that names it."""
    if node is None or (isinstance(node, Scalar) and node.is_null):
        return None
    text = reader.text(node, "`judge`")
    if text is None:
        return None
    if not text.endswith(SPECS):
        reader.wrong(node, "`judge`", "the path of a specification", "write `../specs/driving_rules.stl`")
        return None
    folder = Path(node.span.source.name).parent
    return JudgeRef(Path(os.path.normpath(folder / text)), text, node.span)
