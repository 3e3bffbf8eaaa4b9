"""A system file as a declaration: every section read, every finding reported at once. No torch."""

from __future__ import annotations

import os
from collections.abc import Mapping as MappingType
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TypeAlias

from stlc.compile.ir.support import columns as columns_of_formula
from stlc.compile.ir.support import columns_of
from stlc.diagnostics import Diagnostic, SystemFileError
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.model import Assign, FunctionDecl, JumpDecl
from stlc.dynamics.schema.columns import name_columns, read_controls, read_states
from stlc.dynamics.schema.deploy import read_test
from stlc.dynamics.schema.extends import extended
from stlc.dynamics.schema.flow import read_flow, read_jumps, read_latches, read_timers
from stlc.dynamics.schema.functions import read_functions
from stlc.dynamics.schema.init import read_init
from stlc.dynamics.schema.names import (
    Clockwork,
    Names,
    base_name,
    empty,
    later,
    read_constants,
    read_definitions,
    read_time,
)
from stlc.dynamics.schema.overrides import given_states, overridden
from stlc.dynamics.schema.params import read_params
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.scenario import read_scenarios
from stlc.dynamics.schema.settings import read_backup, read_objective, read_policy, read_train
from stlc.dynamics.schema.yaml_nodes import Node, load_yaml
from stlc.files import read_source
from stlc.source import Source

_Named: TypeAlias = (
    "tuple[Names, Clockwork, dict[str, dict[str, Node]], tuple[Assign, ...], tuple[FunctionDecl, ...]]"
)
VERSION = 1
TOP_KEYS = [
    "stlc",
    "name",
    "doc",
    "extends",
    "spec",
    "time",
    "const",
    "param",
    "state",
    "control",
    "def",
    "flow",
    "jump",
    "init",
    "objective",
    "policy",
    "train",
    "backup",
    "test",
    "scenario",
    "functions",
    "plugin",
    "plot",
]
LATER = {
    "plugin": "dynamics from a plugin",
}


def load_system_decl(path: Path | str, overrides: MappingType[str, str] | None = None) -> SystemDecl:
    """The declaration that a system file holds.

    Args:
        path: of the file.
        overrides: values by dotted key (`train.lr`), or by the name of a constant; a plain name that is no
            constant of this file is left to the specification.

    Raises:
        UsageError: there is no such file.
        SpecError: the file is not text.
        SystemFileError: with all findings.
    """
    return parse_system(read_source(path), Path(path), overrides or {})


def parse_system(source: Source, path: Path, overrides: MappingType[str, str] | None = None) -> SystemDecl:
    """The declaration that a text holds; `path` says what its relative paths start from."""
    reader = Reader(source)
    root = load_yaml(source, sink=reader.findings)
    root, bases = extended(root, reader)
    root = overridden(root, overrides or {}, reader)
    found = reader.fields(root, "a system file", TOP_KEYS, required=("stlc", "name", "time"))
    _version(found.get("stlc"), reader)
    for key, what in LATER.items():
        if not empty(found.get(key)):
            later(reader, found[key], what)
    decl = _declaration(found, reader, source, path, overrides or {})
    reader.close()
    return _with_feedback(replace(decl, bases=bases))


def _with_feedback(decl: SystemDecl) -> SystemDecl:
    """The declaration with the feedback beneath its plans that it asks for. Raises SystemFileError (S205)."""
    asked = decl.policy.feedback
    if asked is None:
        return decl
    from stlc.dynamics.model.feedback import NoFeedbackError, closed

    try:
        return closed(decl, asked)
    except NoFeedbackError as error:
        advice = "give a `gain`, another point of operation (`around`), or leave `feedback` out"
        finding = Diagnostic(
            "S205", f"no feedback can be had: {error}", decl.policy.feedback_span, help=(advice,)
        )
        raise SystemFileError(finding) from None


def _version(node: Node | None, reader: Reader) -> None:
    version = reader.integer(node, "`stlc`")
    if node is not None and version is not None and version != VERSION:
        reader.report(
            "S103",
            f"schema version {version} is not known",
            node.span,
            f"this release reads `stlc: {VERSION}`",
        )


def _declaration(
    found: dict[str, Node], reader: Reader, source: Source, path: Path, overrides: MappingType[str, str]
) -> SystemDecl:
    """All sections, in the order in which names are declared."""
    names, clock, states, params, functions = _named(found, reader)
    timer_flow, timer_jumps = read_timers(states, reader, names, clock)
    flow = read_flow(found.get("flow"), reader, names, clock)
    jumps = (*read_jumps(found.get("jump"), reader, names), *timer_jumps)
    _report_idle(found.get("control"), reader, names, (*timer_flow, *flow), jumps)
    spec = reader.text(found.get("spec"), "`spec`")
    return SystemDecl(
        name=reader.name(found.get("name"), "`name`") or path.stem,
        doc=" ".join((reader.text(found.get("doc"), "`doc`") or "").split()),
        path=path,
        source=source,
        spec=Path(os.path.normpath(_folder(found["spec"], source, path) / spec)) if spec else None,
        dt=clock.dt,
        horizon=clock.horizon,
        substeps=clock.substeps,
        integrator=clock.integrator,
        discrete=clock.discrete,
        constants=MappingProxyType(names.constants),
        signature=names.signature,
        controls=tuple(names.controls),
        flow=(*timer_flow, *flow),
        jumps=jumps,
        clamps=MappingProxyType(
            {
                c.name: (c.low, c.high)
                for c in names.columns
                if c.kind == "real" and c.fact and c.low is not None and c.high is not None
            }
        ),
        init=given_states(read_init(found.get("init"), reader, names, params), overrides, reader, names),
        objective=read_objective(found.get("objective"), reader, names),
        policy=read_policy(found.get("policy"), reader, names),
        train=read_train(found.get("train"), reader, names),
        backup=read_backup(found.get("backup"), reader, names, clock.horizon),
        test=read_test(found.get("test"), reader, names, clock.dt),
        scenarios=read_scenarios(found.get("scenario"), reader, names, clock),
        functions=functions,
        overrides=MappingProxyType(dict(overrides)),
        places=MappingProxyType(names.places),
        warnings=tuple(finding for finding in reader.findings if finding.severity == "warning"),
    )


def _report_idle(
    node: Node | None, reader: Reader, names: Names, flow: Sequence[Assign], jumps: Sequence[JumpDecl]
) -> None:
    """W603 for controls that move nothing."""
    moved = [assign.value for assign in (*flow, *(reset for jump in jumps for reset in jump.resets))]
    read = {name for num in moved for name in columns_of(num)}
    read |= {name for jump in jumps for name in columns_of_formula(jump.guard)}
    known = {entry.key.text: entry.key.span for entry in reader.entries(node, "`control`")}
    for control in names.controls:
        span = known.get(control.name) or known.get(base_name(control.name))
        if control.name not in read and span is not None:
            message = f"the control `{control.name}` has no effect: no flow and no jump reads it"
            advice = f"`{base_name(control.name)}: ~` takes one away that an extended file has"
            reader.report("W603", message, span, advice)


def _named(found: dict[str, Node], reader: Reader) -> _Named:
    """The sections that declare names, in order; the timers among the states and what is drawn later."""
    names = Names()
    read_constants(found.get("const"), reader, names)
    clock = read_time(found.get("time"), reader, names) if "time" in found else Clockwork()
    states = read_states(found.get("state"), reader, names)
    params = read_params(found.get("param"), reader, names)
    params += read_latches(found.get("jump"), reader, names)
    name_columns(names, "state")
    read_controls(found.get("control"), reader, names)
    functions = read_functions(found.get("functions"), reader, names)
    read_definitions(found.get("def"), reader, names)
    return names, clock, states, params, functions


def moving_parts(decl: SystemDecl) -> tuple[Names, Clockwork, Node | None, Node | None]:
    """What a valid declaration was made from: its names, its time, and the sections `flow` and `jump`."""
    reader = Reader(decl.source)
    root, _ = extended(load_yaml(decl.source, sink=reader.findings), reader)
    found = reader.fields(overridden(root, decl.overrides, reader), "a system file", TOP_KEYS)
    names, clock, *_ = _named(found, reader)
    return names, clock, found.get("flow"), found.get("jump")


def _folder(node: Node, source: Source, path: Path) -> Path:
    """Where relative paths of a value start from: the folder of the file that it stands in."""
    return path.parent if node.span.source == source else Path(node.span.source.name).parent
