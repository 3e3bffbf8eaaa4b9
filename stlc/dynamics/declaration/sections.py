"""The sections of a system file, read as one declaration, without torch; all errors are reported together."""

from __future__ import annotations

import os
from collections.abc import Mapping as MappingType
from collections.abc import Sequence as SequenceType
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType

from stlc.compile.ir import nodes as ir
from stlc.diagnostics import StlcError, SystemFileError
from stlc.dynamics.declaration.columns import (
    Clockwork,
    ControlKeys,
    ParamKeys,
    StateKeys,
    name_columns,
    read_constants,
    read_controls,
    read_definitions,
    read_params,
    read_states,
    read_time,
    read_timers,
)
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.dynamics.declaration.deployment import (
    BackupDecl,
    ScenarioDecl,
    TestDecl,
    read_backup,
    read_scenarios,
)
from stlc.dynamics.declaration.functions import FunctionDecl, FunctionKeys, read_functions
from stlc.dynamics.declaration.held import (
    DelayEntry,
    DelayKeys,
    HeldKeys,
    HeldSection,
    declare_held,
    read_held,
)
from stlc.dynamics.declaration.init import InitDecl, InitKeys, read_init
from stlc.dynamics.declaration.inputs import InputDecl, InputKeys, read_inputs
from stlc.dynamics.declaration.learning import ObjectiveDecl, PolicyDecl, TrainDecl
from stlc.dynamics.declaration.motion import (
    Assign,
    JumpDecl,
    read_flow,
    read_jumps,
    read_latches,
    shared_draws,
    state_assigns,
)
from stlc.dynamics.declaration.sampled import Sampled, in_order
from stlc.dynamics.declaration.schema.names import Context, Names, base_name
from stlc.dynamics.declaration.schema.reader import Reader, first_line
from stlc.dynamics.declaration.schema.record import (
    EXPRESSION,
    VECTOR,
    Json,
    items_of,
    json_schema,
    key,
    mapping_of,
    raw,
    read,
    section,
)
from stlc.dynamics.declaration.schema.yaml_nodes import (
    Entry,
    Mapping,
    Node,
    Scalar,
    Sequence,
    load_node,
    load_yaml,
)
from stlc.dynamics.declaration.tables import TableDecl, TableKeys, read_tables
from stlc.files import File, named_in
from stlc.signature import Signature
from stlc.source import Source

VERSION = 1
MAX_FILES = 8
"""Maximum depth of a chain of extended files."""
_EXTENDS = "extends"
_PLUGIN = "dynamics from a plugin"


@dataclass(repr=False, eq=False)
class SystemKeys:
    """The sections of a system file."""

    stlc: Node | None = key(raw({"const": VERSION}), "version of this format", required=True)
    name: Node | None = key(raw({"type": "string"}), "name of the system", required=True)
    doc: Node | None = key(raw({"type": "string"}), "one line for people")
    extends: Node | None = key(raw({"type": "string"}), "system file that this one begins as")
    spec: Node | None = key(raw({"type": "string"}), "default specification, relative to this file")
    time: Node | None = key(section(Clockwork), "time step and horizon", required=True)
    const: Node | None = key(raw(mapping_of(VECTOR)), "constants; later ones may use earlier ones")
    param: Node | None = key(
        raw(mapping_of({"anyOf": [EXPRESSION, json_schema(ParamKeys)]}), ParamKeys),
        "constants of a trajectory, drawn at its start",
    )
    state: Node | None = key(section(StateKeys, free=True), "states, in the order of the columns")
    inputs: Node | None = key(section(InputKeys, free=True), "input signals that no policy chooses")
    control: Node | None = key(section(ControlKeys, free=True), "controls")
    table: Node | None = key(section(TableKeys, free=True), "interpolation tables, called as functions")
    held: Node | None = key(section(HeldKeys, free=True), "values computed at samples and held in between")
    delay: Node | None = key(section(DelayKeys, free=True), "values some time ago")
    def_: Node | None = key(raw(mapping_of(EXPRESSION)), "named sub-expressions", name="def")
    flow: Node | None = key(raw(mapping_of(VECTOR)), "derivatives, or next values of a discrete system")
    jump: Node | None = key(raw(items_of(json_schema(JumpDecl)), JumpDecl), "guarded resets")
    init: Node | None = key(section(InitKeys), "initial states")
    objective: Node | None = key(section(ObjectiveDecl), "loss that training minimises")
    policy: Node | None = key(section(PolicyDecl), "network and its inputs")
    train: Node | None = key(section(TrainDecl), "training defaults")
    backup: Node | None = key(section(BackupDecl), "prefixes that the backup policy tries")
    test: Node | None = key(section(TestDecl), "deployment")
    scenario: Node | None = key(section(ScenarioDecl, free=True), "overlays of a deployment, by name")
    functions: Node | None = key(section(FunctionKeys, free=True), "functions from outside, by name")
    plugin: Node | None = key(raw({"type": "null"}), f"{_PLUGIN}: not supported yet")
    plot: Node | None = key(raw({}), "left to plots")


def system_schema() -> Json:
    """JSON Schema of system files, for editors.

    No key is required in a file that extends another one.
    """
    found = json_schema(SystemKeys)
    required = found.pop("required")
    return {**found, "anyOf": [{"required": required}, {"required": [_EXTENDS]}]}


def read_system(source: Source, path: Path, overrides: MappingType[str, str]) -> SystemDecl:
    """Read the text of a system file; its feedback is declared, not yet applied. See `stlc.dynamics.load`."""
    reader = Reader(source)
    found, bases = _sections(source, overrides, reader)
    version = reader.integer(found.stlc, "`stlc`")
    if found.stlc is not None and version not in (None, VERSION):
        message, advice = f"schema version {version} is not known", f"this release reads `stlc: {VERSION}`"
        reader.report("S103", message, found.stlc.span, advice)
    plugin = found.plugin
    if plugin is not None and (plugin.size > 1 or (isinstance(plugin, Scalar) and not plugin.is_null)):
        message, label = f"{_PLUGIN} is not supported by this version", "not acted on, so it is refused"
        reader.report("E015", message, first_line(plugin.span), label=label)
    decl = _declaration(found, reader, path, overrides)
    reader.close()
    return replace(decl, bases=bases)


def _sections(
    source: Source, overrides: MappingType[str, str], reader: Reader
) -> tuple[SystemKeys, tuple[Source, ...]]:
    """Read the sections of a file, merged with the files that it extends and with `overrides`.

    Also returns the texts of the extended files.
    """
    root, bases = extended(load_yaml(source, sink=reader.findings), reader)
    root = overridden(root, overrides, reader)
    return read(SystemKeys, Context.of(reader, Names()), root, "a system file"), bases


def _declaration(
    found: SystemKeys, reader: Reader, path: Path, overrides: MappingType[str, str]
) -> SystemDecl:
    """Return the declaration of a system, read from its sections (`found`).

    Sections that declare names are read first.
    """
    named = _named(found, reader, Names())
    names, cx = named.cx.names, named.cx
    motion = _motion(found, named)
    sampled, flow, jumps = motion.sampled, motion.flow, motion.jumps
    computed = {each.name for each in sampled.updates}
    assigns = (*flow, *(each for jump in jumps for each in jump.resets))
    for name in dict.fromkeys(base_name(each.name) for each in assigns if each.name in computed):
        message = f"`{name}` is computed at every sample, so that `flow` and jumps cannot set it"
        reader.report("S202", message, names.places[name])
    flow += sampled.flow
    _report_idle(found.control, cx, flow, jumps)
    spec = reader.text(found.spec, "`spec`")
    clamped = [each for each in names.columns if each.kind == "real" and each.fact]
    return SystemDecl(
        name=reader.name(found.name, "`name`") or path.stem,
        doc=" ".join((reader.text(found.doc, "`doc`") or "").split()),
        path=path,
        source=reader.source,
        spec=Path(os.path.normpath(named_in(found.spec.span.source, spec))) if found.spec and spec else None,
        **asdict(named.clock),
        constants=MappingProxyType(names.constants),
        signature=Signature(tuple(names.columns)),
        controls=tuple(names.controls),
        flow=flow,
        jumps=jumps,
        clamps=MappingProxyType(
            {c.name: (c.low, c.high) for c in clamped if c.low is not None and c.high is not None}
        ),
        init=_given_states(
            read_init(found.init, cx, named.drawn + sampled.drawn, motion.initial), overrides, named
        ),
        objective=read(ObjectiveDecl, cx, found.objective, "`objective`"),
        policy=_observing(read(PolicyDecl, cx, found.policy, "`policy`"), sampled.hidden, cx),
        train=read(TrainDecl, cx, found.train, "`train`"),
        backup=read_backup(cx, found.backup, "`backup`"),
        test=read(TestDecl, cx.timed, found.test, "`test`"),
        scenarios=read_scenarios(found.scenario, cx),
        functions=named.functions,
        overrides=MappingProxyType(dict(overrides)),
        places=MappingProxyType(names.places),
        warnings=tuple(finding for finding in reader.findings if finding.severity == "warning"),
        inputs=named.inputs,
        tables=named.tables,
        updates=motion.updates,
        hidden=sampled.hidden,
    )


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of the states of a system.

    Attributes:
        flow: derivatives or next values, without those of columns that are computed at samples.
        jumps: discrete transitions.
        sampled: columns that are computed at samples.
        initial: values of these columns at the start, each after those that it reads.
        updates: their values at every later sample, likewise.
        delays: the entries of the section `delay`.
    """

    flow: tuple[Assign, ...]
    jumps: tuple[JumpDecl, ...]
    sampled: Sampled
    initial: tuple[Assign, ...]
    updates: tuple[Assign, ...]
    delays: tuple[DelayEntry, ...]


def _motion(found: SystemKeys, named: _Named) -> Motion:
    """Read the sections `held`, `delay`, `flow` and `jump`, and the motion of timers."""
    cx = named.cx.moving
    sampled = named.sampled + read_held(named.held, cx)
    timer_flow, timer_jumps = read_timers(named.states, replace(cx, here=replace(cx.here, rewrite=None)))
    return Motion(
        (*timer_flow, *read_flow(found.flow, cx)),
        (*read_jumps(found.jump, cx), *timer_jumps),
        sampled,
        in_order(sampled.initial, cx),
        in_order(sampled.updates, cx),
        named.held.delays,
    )


def _observing(policy: PolicyDecl, hidden: tuple[str, ...], cx: Context) -> PolicyDecl:
    """Return `policy`; by default it observes no hidden columns, such as future values of input signals."""
    if policy.observe or not hidden:
        return policy
    seen = (column.name for column in cx.names.columns if column.name not in hidden)
    return replace(policy, observe=tuple(map(ir.Signal, seen)))


def _report_idle(
    node: Node | None, cx: Context, flow: SequenceType[Assign], jumps: SequenceType[JumpDecl]
) -> None:
    """Report W603 for controls that neither `flow` nor a jump reads; `node` is the section `control`."""
    moved = [assign.value for assign in (*flow, *(reset for jump in jumps for reset in jump.resets))]
    used = {name for num in (*moved, *(jump.guard for jump in jumps)) for name in num.columns}
    known = {entry.key.text: entry.key.span for entry in cx.reader.entries(node, "`control`")}
    for control in cx.names.controls:
        base = base_name(control.name)
        span = known.get(control.name) or known.get(base)
        if control.name not in used and span is not None:
            message = f"the control `{control.name}` has no effect: no flow and no jump reads it"
            advice = f"`{base}: ~` takes one away that an extended file has"
            cx.reader.report("W603", message, span, advice)


@dataclass(frozen=True, slots=True)
class _Named:
    """Contents of the sections that declare names.

    Attributes:
        cx: context that knows all declared names, and the time step.
        clock: the section `time`.
        states: keys of each state, timers included.
        drawn: assignments that are made before the other states are drawn. They draw the parameters, and set
            to false the bool states that record which jumps with `once` have happened.
        functions: external functions.
        inputs: input signals.
        sampled: columns of input signals.
        held: names and keys of the sections `held` and `delay`.
        tables: interpolation tables.
    """

    cx: Context
    clock: Clockwork
    states: dict[str, StateKeys]
    drawn: tuple[Assign, ...]
    functions: tuple[FunctionDecl, ...]
    inputs: tuple[InputDecl, ...]
    sampled: Sampled
    held: HeldSection
    tables: tuple[TableDecl, ...]


def _named(found: SystemKeys, reader: Reader, names: Names) -> _Named:
    """Read the sections that declare `names`, each before the sections that may use its names."""
    cx = Context.of(reader, names)
    read_constants(found.const, cx)
    clock = read_time(found.time, cx.plain)
    cx = replace(cx, dt=clock.dt, horizon=clock.horizon, discrete=clock.discrete)
    states = read_states(found.state, cx)
    drawn = read_params(found.param, cx) + read_latches(found.jump, cx)
    name_columns(cx.names, "state")
    inputs = read_inputs(found.inputs, cx)
    read_controls(found.control, cx)
    functions = read_functions(found.functions, cx.plain)
    tables = read_tables(found.table, cx.plain)
    held = declare_held(found.held, found.delay, cx)
    read_definitions(found.def_, cx)
    return _Named(cx.plain, clock, states, drawn, functions, inputs.signals, inputs.sampled, held, tables)


def sections_of(decl: SystemDecl) -> SystemKeys:
    """Return the sections of the file of a system, with the values of `--set`."""
    return _sections(decl.source, decl.overrides, Reader(decl.source))[0]


def motion_of(found: SystemKeys, decl: SystemDecl, names: Names) -> Motion:
    """Read the motion of a valid system again, from its sections, with the numbers that `names` changes.

    Raises:
        SystemFileError: a changed expression is invalid.
    """
    reader = Reader(decl.source)
    motion = _motion(found, _named(found, reader, names))
    reader.close()
    return motion


# ---------------------------------------------------------------------------------- extends


def extended(root: Mapping, reader: Reader) -> tuple[Mapping, tuple[Source, ...]]:
    """Merge a system file (as YAML mapping) with the files that it extends; return also their texts.

    Sections that are mappings are merged entry by entry, and the extending file takes precedence. A null
    entry (`~`) removes the entry of the extended file; any other value replaces it. Every value keeps its
    source location. S209 is reported if a file cannot be read or extends itself.
    """
    sources: list[Source] = []
    seen = {File(reader.source.name).real}
    chain = [root]
    while (node := chain[-1].get(_EXTENDS)) is not None:
        text = reader.text(node, f"`{_EXTENDS}`")
        if text is None:
            break
        path = named_in(node.span.source, text, copied=True)
        again = File(path).real in seen
        if again or len(chain) > MAX_FILES:
            why = "leads back to itself" if again else f"goes through more than {MAX_FILES} files"
            reader.report("S209", f"`{_EXTENDS}: {text}` {why}", node.span, label="named here")
            break
        seen.add(File(path).real)
        try:
            source = File(path).read(node.span.source.root)
            chain.append(load_yaml(source, sink=reader.findings))
        except StlcError as error:
            reader.report("S209", f"`{text}` cannot be read", node.span, error.diagnostics[0].message)
            break
        sources.append(source)
    merged = chain[-1]
    for document in reversed(chain[:-1]):
        merged = _merged(merged, document)
    return merged, tuple(sources)


def _merged(base: Mapping, own: Mapping, *, sections: bool = True) -> Mapping:
    """Merge the mapping `own` over the mapping `base`: entries of `own` replace those with the same key.

    A null entry of `own` removes the entry with the same key. If `sections`, two mappings under the same key
    are merged in the same way, one level deep.
    """
    result = Mapping(own.span, base.entries, base.size)
    for entry in own.entries:
        key, value, old = entry.key, entry.value, base.get(entry.key.text)
        if old is not None and isinstance(value, Scalar) and value.is_null:
            result = result.without(key.text)
        elif sections and isinstance(old, Mapping) and isinstance(value, Mapping):
            result = result.replaced(key, _merged(old, value, sections=False))
        else:
            result = result.replaced(key, value)
    return result


# -------------------------------------------------------------------------------- overrides


def overridden(root: Mapping, overrides: MappingType[str, str], reader: Reader) -> Mapping:
    """Replace the fields of a system file (as YAML mapping) that `overrides` names.

    A key with dots names a field (`train.lr`, `init.mixture.0.weight`). A key without dots names a constant,
    a parameter, or a top-level field with a single value; if it names none of these, it is skipped, because
    it may belong to the specification.
    """
    known, params = _keys(root.get("const")), _keys(root.get("param"))
    for name, text in overrides.items():
        value = _value(name, text, reader)
        path = name.split(".")
        if value is None:
            continue
        if len(path) == 1:
            if name in known:
                path = ["const", name]
            elif name in params:
                path = ["param", name, *(["draw"] if isinstance(params[name], Mapping) else [])]
            elif not isinstance(root.get(name), Scalar):
                continue
        changed = _replaced(root, path, value, name, reader)
        root = changed if isinstance(changed, Mapping) else root
    return root


def _keys(node: Node | None) -> dict[str, Node]:
    """Return the values of a section by key; empty if the section is missing."""
    return {entry.key.text: entry.value for entry in node.entries} if isinstance(node, Mapping) else {}


def _value(key: str, text: str, reader: Reader) -> Node | None:
    """Parse `text`, the new value of the field `key`, as YAML; None if it is invalid."""
    source = Source(f"--set {key}", text)
    try:
        return load_node(source, sink=reader.findings)
    except SystemFileError as error:
        reader.add(*error.diagnostics)
        return None


def _replaced(node: Node, path: list[str], value: Node, key: str, reader: Reader) -> Node:
    """Return `node` with the value at `path` replaced by `value`; missing keys are added.

    `path` is the list of keys from `node` down to the value, and `key` the whole dotted key of the option
    `--set`, for messages.
    """
    head, rest = path[0], path[1:]
    match node:
        case Sequence(items=items) if head.isdigit() and int(head) < len(items):
            index = int(head)
            inner = _replaced(items[index], rest, value, key, reader) if rest else value
            return Sequence(node.span, (*items[:index], inner, *items[index + 1 :]), node.size + value.size)
        case Mapping():
            old = node.get(head) or Mapping(value.span, (), 1)
            inner = _replaced(old, rest, value, key, reader) if rest else value
            return node.replaced(Scalar(value.span, head), inner)
        case _:
            reader.report("S101", f"`--set {key}`: there is no `{head}` in the system file", value.span)
            return node


def _given_states(init: InitDecl, overrides: MappingType[str, str], named: _Named) -> InitDecl:
    """Return `init`, with values from `overrides` in place of the initial values of some states.

    An entry such as `x=3m`, or `x` with a distribution, replaces the value that is drawn for `x`.
    """
    cx, signals = named.cx, {name for each in named.inputs for name in each.columns}
    params = {base_name(assign.name) for assign in init.params if assign.name not in signals}
    computed = {assign.name for assign in init.computed}
    found: list[Assign] = []
    for name, text in overrides.items():
        if cx.names.group(name) and name not in params:
            node = _value(name, text, cx.reader)
            if node is not None and name in computed:
                advice = f"give `{name}_values`" if any(each.name == name for each in named.inputs) else ""
                cx.reader.report("S202", f"`{name}` follows from the other states", node.span, advice)
            elif node is not None:
                entry = Entry(Scalar(node.span, name), node)
                found.extend(shared_draws(state_assigns(entry, "`--set`", cx.drawing({}))))
    return replace(init, override=(*init.override, *found))
