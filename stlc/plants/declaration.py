"""Plant files: the declaration of a black box, read without running anything that it names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, make_dataclass, replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any, get_args

from stlc.dynamics.declaration.columns import unit_text
from stlc.dynamics.declaration.inputs import InputDecl, Interpolate
from stlc.dynamics.declaration.schema.names import Context, Names
from stlc.dynamics.declaration.schema.reader import Reader, first_line
from stlc.dynamics.declaration.schema.record import (
    EXPRESSION,
    FLAG,
    LINE,
    NAME,
    OF,
    SECONDS,
    TEXT,
    Json,
    Kind,
    integer,
    json_schema,
    key,
    list_of,
    mapping_of,
    part,
    raw,
    read,
    values_of,
    word,
)
from stlc.dynamics.declaration.schema.yaml_nodes import Entry, Node, Scalar, Sequence, load_yaml
from stlc.dynamics.declaration.schema.yaml_nodes import Mapping as MappingNode
from stlc.files import File
from stlc.plants.kind import KINDS, ControllerLayout, Layout, PlantKind, Port
from stlc.source import Source, Span
from stlc.trace import Trace
from stlc.units import Unit

VERSION = 1
MOST_STEPS = 10**9
_MEGABYTE = 1_000_000


# -------------------------------------------------------------------------------------- keys


@dataclass(frozen=True, slots=True)
class TimeKeys:
    """The section `time` of a plant file."""

    dt: Fraction = key(
        SECONDS, "time step, at which outputs are recorded and inputs change", Fraction(1, 10), required=True
    )
    duration: Fraction = key(
        SECONDS, "length of a simulation, a multiple of `dt`", Fraction(1), required=True
    )
    halves: bool = key(FLAG, "`falsify` may simulate at half of `dt`, to confirm counterexamples", False)


@dataclass(repr=False, eq=False)
class VariableKeys:
    """The keys of a start value or of a parameter."""

    unit: Unit = key(unit_text, "unit of the numbers", Unit())
    ends: Node | None = key(
        raw({"type": "array"}), "`[low, high]`: the values that it may have", name="range"
    )
    value: Node | None = key(raw(EXPRESSION), "its value, if it is always the same")
    source: str | None = key(TEXT, "its name in the plant, if that is another one", name="from")


@dataclass(repr=False, eq=False)
class PlantInputKeys(VariableKeys):
    """The keys of an input signal."""

    pieces: int = key(integer(high=10_000), "number of pieces of the signal", 1)
    interpolate: Interpolate = key(
        word(get_args(Interpolate)), "course of the signal between its values", "hold"
    )
    times: str = key(word(("fixed", "free")), "`free`: the ends of pieces are varied, too", "fixed")


@dataclass(repr=False, eq=False)
class OutputKeys:
    """The keys of an output signal."""

    unit: Unit = key(unit_text, "unit of the numbers", Unit())
    source: str | None = key(TEXT, "its name in the plant, if that is another one", name="from")


_REAL = Kind(lambda cx, node, label: cx.here.constant(node, label, Unit.ONE), EXPRESSION)


@dataclass(frozen=True, slots=True)
class ControllerKeys:
    """The section `controller` of a plant file: a neural network in the loop with the plant."""

    onnx: str | None = key(TEXT, "file of the network, relative to the plant file", required=True)
    reads: tuple[str, ...] = key(
        list_of(NAME, "a name in `reads`"),
        "outputs, free inputs and parameters that it reads",
        (),
        required=True,
    )
    writes: tuple[str, ...] = key(
        list_of(NAME, "a name in `writes`"), "inputs that it writes", (), required=True
    )
    period: Fraction | None = key(
        SECONDS, "time between two evaluations, a multiple of `dt`; unless given, `dt`"
    )
    scale: float = key(_REAL, "factor of what it gives", 1.0)
    offset: float = key(_REAL, "added afterwards", 0.0)


@dataclass(frozen=True, slots=True)
class LimitKeys:
    """The section `limit` of a plant file."""

    time: Fraction = key(SECONDS, "of one simulation, on the clock; 30 s unless given", Fraction(30))
    memory: int = key(integer(64), "address space of a process in megabytes", 4096)
    fresh: bool = key(FLAG, "a new process for every simulation", False)


def _free(record: type) -> Kind:
    """Kind of a section whose entries are values, or mappings with the keys of `record`."""
    return raw(mapping_of({"anyOf": [EXPRESSION, json_schema(record)]}), record)


def _plant(name: str) -> Kind:
    """Kind of the key that names a plant: a text, or a mapping."""
    record = KINDS.get(name).record
    return raw({"anyOf": [{"type": "string"}, json_schema(record)]}, record)


@dataclass(repr=False, eq=False)
class PlantKeys:
    """The keys of a plant file."""

    plant: Node | None = key(raw({"const": VERSION}), "version of this format", required=True)
    name: str | None = key(NAME, "name of the plant", required=True)
    doc: str = key(LINE, "one line for people", "")
    python: Node | None = key(_plant("python"), "a class or function in Python")
    fmu: Node | None = key(_plant("fmu"), "a functional mock-up unit, FMI 2 or 3")
    gym: Node | None = key(_plant("gym"), "a gymnasium environment")
    time: TimeKeys = key(part(TimeKeys), "time step and duration", TimeKeys(), required=True)
    initial: Node | None = key(_free(VariableKeys), "start values")
    param: Node | None = key(_free(VariableKeys), "parameters, constant during a simulation")
    input: Node | None = key(_free(PlantInputKeys), "input signals")
    output: Node | None = key(
        raw(mapping_of(json_schema(OutputKeys)), OutputKeys), "output signals", required=True
    )
    controller: Node | None = key(raw(json_schema(ControllerKeys), ControllerKeys), "controller in the loop")
    limit: LimitKeys = key(part(LimitKeys), "limits of the processes in which the plant runs", LimitKeys())


def plant_schema() -> Json:
    """JSON Schema of plant files, for editors; it has the kinds of plants of installed packages."""
    return json_schema(_keys_with(KINDS.installed))


@cache
def _keys_with(kinds: tuple[str, ...]) -> type[PlantKeys]:
    """Return `PlantKeys` with a key for each of the kinds of plants that has none yet."""
    new = [name for name in kinds if name not in PlantKeys.__dataclass_fields__]
    keys = [(name, Node | None, key(_plant(name), f"a plant of the kind `{name}`")) for name in new]
    return make_dataclass("PlantKeys", keys, bases=(PlantKeys,), repr=False, eq=False) if new else PlantKeys


# ------------------------------------------------------------------------------- declaration


@dataclass(frozen=True, slots=True)
class VariableDecl:
    """A start value or a parameter.

    Attributes:
        name: name in the plant file.
        unit: unit of its values.
        source: name in the plant.
        low: lower end of its range, in `unit`.
        high: upper end of its range; equal to `low` if the value is fixed.
    """

    name: str
    unit: Unit
    source: str
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class OutputDecl:
    """An output signal: its name in specifications, its unit, and its name in the plant (`source`)."""

    name: str
    unit: Unit
    source: str


@dataclass(frozen=True, slots=True)
class PlantInput:
    """An input signal of a plant.

    Attributes:
        name: name in specifications.
        unit: unit of its values.
        source: name in the plant.
        low: lower end of its range, in `unit`; None if a controller writes it without limits.
        high: upper end of its range; equal to `low` if the value is fixed.
        signal: the function of time; None if a controller writes the input.
    """

    name: str
    unit: Unit
    source: str
    low: float | None
    high: float | None
    signal: InputDecl | None


@dataclass(frozen=True)
class PlantDecl:
    """A plant file, read and validated.

    Attributes:
        name: name of the plant.
        doc: description in one line.
        path: path of the plant file.
        source: text of the plant file.
        kind: kind of plant, an entry of `stlc.plants.kind.KINDS`.
        options: keys and values under the name of the kind in the plant file.
        dt: time step in seconds.
        steps: time steps of a simulation.
        halves: whether the plant may also be simulated at half the time step.
        initial: start values.
        param: parameters.
        inputs: input signals; those that the controller writes come last.
        outputs: output signals.
        controller: controller in the loop, or None.
        limits: limits of the processes.
        places: dotted key -> source location, for messages about the plant.
    """

    name: str
    doc: str
    path: Path
    source: Source = field(repr=False)
    kind: str
    options: Mapping[str, Any]
    dt: Fraction
    steps: int
    halves: bool
    initial: tuple[VariableDecl, ...]
    param: tuple[VariableDecl, ...]
    inputs: tuple[PlantInput, ...]
    outputs: tuple[OutputDecl, ...]
    controller: ControllerLayout | None
    limits: LimitKeys
    places: Mapping[str, Span] = field(default_factory=dict, repr=False)

    @property
    def duration(self) -> Fraction:
        """Length of a simulation in seconds."""
        return self.dt * self.steps

    @property
    def free(self) -> tuple[InputDecl, ...]:
        """The input signals that no controller writes."""
        return tuple(each.signal for each in self.inputs if each.signal is not None)

    def at_half_step(self) -> PlantDecl:
        """Return the same plant at half the time step, with twice as many samples.

        Inputs are the same functions of time, sampled twice as often. The period of the controller stays.
        """
        controller = self.controller
        if controller is not None:
            controller = replace(controller, period=2 * controller.period)
        return replace(self, dt=self.dt / 2, steps=2 * self.steps, controller=controller)

    @property
    def files(self) -> dict[str, Path]:
        """Files of which the plant consists, with its controller: name -> path. Nothing is run for that."""
        kind: PlantKind = KINDS.get(self.kind)
        folder = self.path.parent.resolve()
        found = dict(kind.files(self.options, folder))
        if self.controller is not None:
            found[self.controller.path] = folder / self.controller.path
        return found

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages that simulate the plant."""
        kind: PlantKind = KINDS.get(self.kind)
        return (*kind.packages, *(() if self.controller is None else ("onnxruntime",)))

    def layout(self, scratch: str) -> Layout:
        """Return the data with which the process of the plant starts; `scratch`: its temporary folder."""
        return Layout(
            kind=self.kind,
            options=self.options,
            folder=str(self.path.parent.resolve()),
            scratch=scratch,
            dt=float(self.dt),
            duration=float(self.duration),
            memory=self.limits.memory * _MEGABYTE,
            halves=self.halves,
            initial=tuple(_port(each) for each in self.initial),
            param=tuple(_port(each) for each in self.param),
            inputs=tuple(Port(each.name, each.source, each.low, each.high) for each in self.inputs),
            outputs=tuple(Port(each.name, each.source) for each in self.outputs),
            controller=self.controller,
        )


def _port(variable: VariableDecl) -> Port:
    return Port(variable.name, variable.source, variable.low, variable.high)


# ----------------------------------------------------------------------------------- reading


def load_plant_decl(path: Path | str) -> PlantDecl:
    """Read a plant file.

    Raises:
        UsageError: U102, the file does not exist.
        SpecError: the file is not text.
        SystemFileError: the file is invalid; carries all findings.
    """
    return parse_plant(File(path).read(), Path(path))


def parse_plant(source: Source, path: Path) -> PlantDecl:
    """Read the text of a plant file. Relative paths in it start from the folder of `path`."""
    reader = Reader(source)
    found = _Reading(reader, load_yaml(source, sink=reader.findings))
    decl = found.declaration(path)
    reader.close()
    return decl


class _Reading:
    def __init__(self, reader: Reader, root: MappingNode) -> None:
        self.reader, self.root = reader, root
        self.cx = Context.of(reader, Names())
        kinds = tuple(entry.key.text for entry in root.entries if entry.key.text in KINDS)
        self.keys = read(_keys_with(kinds), self.cx, root, "a plant file")
        self.places = dict(_places(root, ""))
        self.kind, self.options = self._chosen()

    def declaration(self, path: Path) -> PlantDecl:
        """Return the declaration; errors are reported to the reader."""
        version = self.reader.integer(self.keys.plant, "`plant`")
        if self.keys.plant is not None and version not in (None, VERSION):
            advice = f"this release reads `plant: {VERSION}`"
            self.reader.report("S103", f"version {version} is not known", self.keys.plant.span, advice)
        dt, duration = self.keys.time.dt, self.keys.time.duration
        steps = duration / dt
        if steps.denominator != 1 or not 1 <= steps <= MOST_STEPS:
            self._complain("S103", "`duration` must be a multiple of `dt`, and not too many", "time.duration")
        if self.keys.time.halves and KINDS.get(self.kind).own_step:
            message = f"a plant of the kind `{self.kind}` has a time step of its own"
            self._complain("S103", message, "time.halves", "leave `halves` out")
        controller = self._controller(dt)
        written = () if controller is None else controller.writes
        initial = self._variables(self.keys.initial, "initial")
        param = self._variables(self.keys.param, "param")
        inputs = self._inputs(self.keys.input, written, duration)
        outputs = self._outputs()
        columns: tuple[VariableDecl | PlantInput | OutputDecl, ...] = (*param, *inputs, *outputs)
        self._distinct(initial, columns, [each.name for each in columns[: len(param) + len(inputs)]])
        if controller is not None:
            self._connected(controller, inputs, [each.name for each in columns])
            order = {name: index for index, name in enumerate(written)}
            inputs = tuple(sorted(inputs, key=lambda each: order.get(each.name, -1)))
        return PlantDecl(
            name=self.keys.name or path.stem,
            doc=self.keys.doc,
            path=path,
            source=self.reader.source,
            kind=self.kind,
            options=self.options,
            dt=dt,
            steps=int(steps),
            halves=self.keys.time.halves,
            initial=initial,
            param=param,
            inputs=inputs,
            outputs=outputs,
            controller=controller,
            limits=self.keys.limit,
            places=self.places,
        )

    def _complain(self, code: str, message: str, place: str, *advice: str) -> None:
        span = self.places.get(place) or self.root.span
        self.reader.report(code, message, first_line(span), *advice)

    def _chosen(self) -> tuple[str, dict[str, Any]]:
        given = {name: node for name in KINDS if (node := getattr(self.keys, name, None)) is not None}
        if len(given) != 1:
            wanted = ", ".join(f"`{name}`" for name in KINDS)
            place = list(given)[1] if given else ""
            code = "S103" if given else "S102"
            self._complain(code, f"a plant file needs exactly one of the keys {wanted}", place)
            return KINDS.default, {}
        ((name, node),) = given.items()
        kind: PlantKind = KINDS.get(name)
        if isinstance(node, Scalar):
            text = self.reader.text(node, f"`{name}`")
            node = MappingNode(node.span, (Entry(Scalar(node.span, kind.main), node),), 2)
            if text is None:
                return name, {}
        keys: Any = read(kind.record, self.cx, node, f"`{name}`", OF)
        return name, {each.name: _plain(getattr(keys, each.name)) for each in fields(kind.record)}

    # ------------------------------------------------------------------------------ sections

    def _entries(self, node: Node | None, section: str) -> Iterator[tuple[int, Entry]]:
        """Yield the entries of a section that have valid names, with their positions."""
        names = Names()
        for index, entry in enumerate(self.reader.entries(node, f"`{section}`")):
            name = entry.key.text
            if name in Trace.RESERVED:
                message = f"`{name}` cannot be the name of a signal: traces use it"
                self.reader.report("S103", message, entry.key.span, "choose another name, and give `from`")
            elif names.declare(entry.key, f"name in `{section}`", self.reader):
                yield index, entry

    def _source(self, section: str, index: int, name: str, given: str | None) -> str:
        kind: PlantKind = KINDS.get(self.kind)
        return given or kind.sources(section, index, name)

    def _values(self, entry: Entry, section: str, record: type) -> dict[str, Any]:
        """Read the keys of an entry; a plain value is the key `value`."""
        where = f"`{section}.{entry.key.text}`"
        if isinstance(entry.value, Scalar):
            return {"value": entry.value}
        return values_of(record, self.cx, entry.value, where, OF)

    def _variables(self, node: Node | None, section: str) -> tuple[VariableDecl, ...]:
        found = []
        for index, entry in self._entries(node, section):
            name, keys = entry.key.text, VariableKeys(**self._values(entry, section, VariableKeys))
            low, high = self._range(entry, section, keys) or (0.0, 0.0)
            source = self._source(section, index, name, keys.source)
            unit = self._unit(entry, keys)
            found.append(VariableDecl(name, unit, source, low, high))
        return tuple(found)

    def _unit(self, entry: Entry, keys: VariableKeys) -> Unit:
        """Unit of a variable: the declared one, or that of a plain value such as `1 m`."""
        if isinstance(entry.value, Scalar):
            number = self.cx.here.number(entry.value, f"`{entry.key.text}`")
            return Unit() if number is None or number.bare else number.unit
        return keys.unit

    def _range(self, entry: Entry, section: str, keys: VariableKeys) -> tuple[float, float] | None:
        """Return the ends of the values of a variable; None if they are missing or invalid."""
        where = f"`{section}.{entry.key.text}`"
        if keys.ends is not None and keys.value is not None:
            self.reader.report("S103", f"{where} has a `range` and a `value`", first_line(entry.value.span))
            return None
        if keys.value is not None:
            value = self.cx.here.constant(keys.value, where, self._unit(entry, keys))
            return None if value is None else (value, value)
        if keys.ends is None:
            self.reader.report("S102", f"{where} lacks `range` or `value`", first_line(entry.value.span))
            return None
        items = self.reader.items(keys.ends, f"`range` of {where}")
        if len(items) != 2:
            if items or isinstance(keys.ends, Sequence):
                self.reader.wrong(keys.ends, f"`range` of {where}", "two numbers `[low, high]`")
            return None
        ends = [self.cx.here.constant(item, f"an end of {where}", keys.unit) for item in items]
        low, high = ends
        if low is None or high is None:
            return None
        if not low < high:
            message = f"the range of {where} ends before it starts"
            self.reader.report("S204", message, keys.ends.span, f"[{high:g}, {low:g}]")
            return None
        return low, high

    def _inputs(
        self, node: Node | None, written: tuple[str, ...], duration: Fraction
    ) -> tuple[PlantInput, ...]:
        found = []
        for index, entry in self._entries(node, "input"):
            name, keys = entry.key.text, PlantInputKeys(**self._values(entry, "input", PlantInputKeys))
            source = self._source("input", index, name, keys.source)
            unit = self._unit(entry, keys)
            if name in written:
                ends = self._limits(entry, keys)
                found.append(PlantInput(name, unit, source, *ends, None))
                continue
            low, high = self._range(entry, "input", keys) or (0.0, 0.0)
            signal = InputDecl(
                name, unit, low, high, keys.pieces, keys.interpolate, duration, keys.times == "free"
            )
            found.append(PlantInput(name, unit, source, low, high, signal))
        return tuple(found)

    def _limits(self, entry: Entry, keys: PlantInputKeys) -> tuple[float | None, float | None]:
        """Return the range of an input that a controller writes, which may be missing."""
        given = entry.value.entries if isinstance(entry.value, MappingNode) else ()
        for each in given:
            if each.key.text in ("value", "pieces", "interpolate", "times"):
                message = f"the controller writes `{entry.key.text}`: it has no `{each.key.text}`"
                self.reader.report("S103", message, each.key.span)
        if isinstance(entry.value, Scalar) and not entry.value.is_null:
            self.reader.wrong(entry.value, f"`input.{entry.key.text}`", "a mapping: the controller writes it")
        if keys.ends is None:
            return None, None
        return self._range(entry, "input", replace(keys, value=None)) or (None, None)

    def _outputs(self) -> tuple[OutputDecl, ...]:
        found = []
        for index, entry in self._entries(self.keys.output, "output"):
            name = entry.key.text
            empty = isinstance(entry.value, Scalar) and entry.value.is_null
            values = {} if empty else values_of(OutputKeys, self.cx, entry.value, f"`output.{name}`", OF)
            keys = OutputKeys(**values)
            found.append(OutputDecl(name, keys.unit, self._source("output", index, name, keys.source)))
        if self.keys.output is not None and not found:
            self._complain("S102", "`output` names no signal", "output")
        return tuple(found)

    def _controller(self, dt: Fraction) -> ControllerLayout | None:
        if self.keys.controller is None:
            return None
        keys = read(ControllerKeys, self.cx, self.keys.controller, "`controller`", OF)
        steps = (keys.period or dt) / dt
        if steps.denominator != 1:
            self._complain(
                "S103", f"`period` must be a multiple of `dt`, {float(dt):g} s", "controller.period"
            )
        if keys.onnx is None or not keys.writes or not keys.reads:
            for name in ("reads", "writes"):
                if not getattr(keys, name) and f"controller.{name}" in self.places:
                    self._complain("S103", f"`{name}` is empty", f"controller.{name}")
            return None
        return ControllerLayout(keys.onnx, keys.reads, keys.writes, int(steps), keys.scale, keys.offset)

    def _connected(
        self, controller: ControllerLayout, inputs: tuple[PlantInput, ...], names: list[str]
    ) -> None:
        free = [name for name in names if name not in controller.writes]
        own = [each.name for each in inputs]
        for section, used, known in (("reads", controller.reads, free), ("writes", controller.writes, own)):
            keys = self.keys.controller
            node = keys.get(section) if isinstance(keys, MappingNode) else None
            nodes = node.items if isinstance(node, Sequence) else ()
            for index, name in enumerate(used):
                span = nodes[index].span if index < len(nodes) else self.root.span
                if name not in known:
                    listed = f"there is: {', '.join(known)}" if known else ""
                    self.reader.report("S103", f"`{name}` is no name that `{section}` can have", span, listed)
                elif name in used[:index]:
                    self.reader.report("S103", f"`{name}` is named twice in `{section}`", span)

    def _distinct(
        self,
        initial: tuple[VariableDecl, ...],
        columns: tuple[VariableDecl | PlantInput | OutputDecl, ...],
        varied: list[str],
    ) -> None:
        """Report names that stand for two columns of a trace, or for two variables."""
        sections: dict[type, str] = {VariableDecl: "param", PlantInput: "input", OutputDecl: "output"}
        first: dict[str, str] = {}
        for each in columns:
            place = f"{sections[type(each)]}.{each.name}"
            if each.name in first:
                self._twice(each.name, place, first[each.name])
            first.setdefault(each.name, place)
        for variable in initial:
            if variable.name in varied:
                self._twice(variable.name, f"initial.{variable.name}", first[variable.name])

    def _twice(self, name: str, place: str, before: str) -> None:
        labels = (first_line(self.places[before]).label("declared first"),)
        span = first_line(self.places[place])
        self.reader.report(
            "E102", f"`{name}` is declared twice", span, "rename one of the two", labels=labels
        )


def _places(node: MappingNode, before: str) -> Iterator[tuple[str, Span]]:
    """Yield the dotted keys of a mapping with the source locations of their values, two levels deep."""
    for entry in node.entries:
        name = f"{before}{entry.key.text}"
        yield name, entry.value.span if entry.value.span.text else entry.key.span
        if isinstance(entry.value, MappingNode) and before.count(".") < 2:
            yield from _places(entry.value, f"{name}.")


def _plain(value: Any) -> Any:
    """Return a value of the options as JSON data; a mapping that was kept as a YAML node is converted."""
    match value:
        case MappingNode():
            return {entry.key.text: _plain(entry.value) for entry in value.entries}
        case Sequence():
            return [_plain(item) for item in value.items]
        case Scalar():
            for meaning in (value.boolean, value.integer, value.number):
                if meaning is not None:
                    return meaning
            return None if value.is_null else value.text
        case Mapping():
            return {name: _plain(item) for name, item in value.items()}
    return value
