"""What the names of a system file are: time, constants, states, controls, definitions."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import get_args

from stlc.compile.scope import (
    Definition,
    Entry,
    Known,
    Scope,
    column_entries,
    constant_entries,
    constant_value,
    enforced,
    member_entries,
)
from stlc.diagnostics import Label, SystemFileError
from stlc.dynamics.decl import ControlDecl, Squash
from stlc.dynamics.schema_expressions import SECOND, Expressions
from stlc.dynamics.schema_reader import Reader, first_line
from stlc.dynamics.yaml_nodes import Mapping, Node, Scalar, Sequence
from stlc.grammar import ast
from stlc.signature import Column, Role, Signature
from stlc.source import Span
from stlc.units import Unit, parse_unit

TIME_KEYS = ("dt", "horizon", "integrator", "substeps", "discrete")
INTEGRATORS = ("euler", "heun", "rk4")
STATE_KEYS = ("unit", "range", "clamp", "role", "enum", "bool", "size", "timer", "run", "reset_when", "to")
CONTROL_KEYS = ("unit", "range", "squash", "levels", "size")
BOOL_LABELS = ()


@dataclass(frozen=True, slots=True)
class Clockwork:
    """The section `time`; a horizon of 0 is not known."""

    dt: Fraction = Fraction(1, 10)
    horizon: int = 0
    substeps: int = 1
    integrator: str = "euler"
    discrete: bool = False


@dataclass
class Names:
    """What has been declared so far.

    Attributes:
        constants: name -> (value in SI units, unit).
        columns: the states, in order.
        controls: the inputs, in order.
        entries: everything that expressions may name.
        places: name -> where it is declared.
    """

    constants: dict[str, tuple[float, Unit]] = field(default_factory=dict)
    columns: list[Column] = field(default_factory=list)
    controls: list[ControlDecl] = field(default_factory=list)
    entries: dict[str, Entry] = field(default_factory=dict)
    places: dict[str, Span] = field(default_factory=dict)

    @property
    def signature(self) -> Signature:
        """The state columns."""
        return Signature(tuple(self.columns))

    def expressions(self, reader: Reader) -> Expressions:
        """A compiler of expressions that knows all of it."""
        return Expressions(
            reader, Scope(dict(self.entries), error=SystemFileError, facts=enforced(self.columns))
        )

    def declare(self, key: Scalar, what: str, reader: Reader) -> bool:
        """Whether `key` may become a name; says why not."""
        first = self.places.get(key.text)
        if first is not None:
            reader.report(
                "E102",
                f"`{key.text}` is declared twice",
                key.span,
                "rename one of the two",
                label=f"{what} here",
                labels=(Label(first, "declared first"),),
            )
            return False
        if not key.text.isidentifier() or key.text == "dt":
            reader.report(
                "S103", f"`{key.text}` cannot be the name of a {what}", key.span, "choose another name"
            )
            return False
        self.places[key.text] = key.span
        return True


def read_time(node: Node | None, reader: Reader, names: Names) -> Clockwork:
    """The section `time`; `dt` becomes a name."""
    found = reader.fields(node, "`time`", TIME_KEYS, required=("dt", "horizon"))
    here = names.expressions(reader)
    default = Clockwork()
    dt = here.duration(found.get("dt"), "`dt`") or default.dt
    names.entries["dt"] = Known(constant_value(float(dt), SECOND), "the step")
    return Clockwork(
        dt,
        here.steps(found.get("horizon"), "`horizon`", dt) or default.horizon,
        reader.integer(found.get("substeps"), "`substeps`", high=1000) or default.substeps,
        reader.option(found.get("integrator"), "`integrator`", INTEGRATORS) or default.integrator,
        reader.flag(found.get("discrete"), "`discrete`") or default.discrete,
    )


def read_constants(node: Node | None, reader: Reader, names: Names) -> None:
    """The section `const`: numbers with units; later ones may use earlier ones."""
    for entry in reader.entries(node, "`const`"):
        name = entry.key.text
        if not names.declare(entry.key, "constant", reader):
            continue
        number = names.expressions(reader).number(entry.value, f"the constant `{name}`")
        if number is None:
            names.entries[name] = Known(constant_value(1.0), "constant")
        elif number.constant is None:
            reader.wrong(entry.value, f"the constant `{name}`", "a number that is known now")
        else:
            unit = number.unit if not number.bare else Unit()
            names.constants[name] = (number.constant, unit)
            known = constant_entries({name: names.constants[name]}, about="constant")[name]
            names.entries[name] = Known(number, known.about, entry.key.span)


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
        if "size" in found:
            later(reader, found["size"], "a state of several components")
        names.columns.append(_column(entry.key.text, found, where, reader, names))
    names.entries |= column_entries(names.columns, about="state")
    names.entries |= member_entries(column.labels for column in names.columns if column.kind == "enum")
    return described


def _column(name: str, found: dict[str, Node], where: str, reader: Reader, names: Names) -> Column:
    """One state."""
    unit = read_unit(found.get("unit"), reader)
    role = reader.option(found.get("role"), f"`role` of {where}", ("state", "env")) or "state"
    clamp = bool(reader.flag(found.get("clamp"), f"`clamp` of {where}"))
    shown: Role = "env" if role == "env" else "state"
    if "enum" in found:
        labels = _members(found["enum"], where, reader)
        values = [value for _, value in labels] or [0.0]
        return Column(name, unit, "enum", shown, min(values), max(values), labels, fact=True)
    if reader.flag(found.get("bool"), f"`bool` of {where}"):
        return Column(name, unit, "bool", shown, 0.0, 1.0, BOOL_LABELS, fact=True)
    low, high = read_range(found.get("range"), where, unit, names.expressions(reader)) or (None, None)
    if clamp and "range" not in found:
        reader.report(
            "S204", f"{where} is clamped but has no range", found["clamp"].span, "add `range: [low, high]`"
        )
    return Column(name, unit, "real", shown, low, high, (), fact=clamp)


def _members(node: Node, where: str, reader: Reader) -> tuple[tuple[str, float], ...]:
    """`{stop: 0, light: 1}` or `[stop, light]`."""
    members: list[tuple[str, float]] = []
    if isinstance(node, Sequence):
        words = [reader.text(item, f"a member of {where}") for item in reader.items(node, where)]
        members = [(word, float(value)) for value, word in enumerate(words) if word]
    else:
        for entry in reader.entries(node, f"`enum` of {where}"):
            value = reader.integer(entry.value, f"the member `{entry.key.text}`", low=-1_000_000)
            if value is not None:
                members.append((entry.key.text, float(value)))
    if len(dict(members)) < max(len(members), 1) or len({value for _, value in members}) < len(members):
        help_ = "{enum: {stop: 0, go: 1}}"
        reader.report(
            "S103", f"{where} needs members, each with a name and a value of its own", node.span, help_
        )
    return tuple(members)


def read_unit(node: Node | None, reader: Reader) -> Unit:
    """The unit of a field; nothing written is a unit too."""
    text = reader.text(node, "`unit`")
    if node is None or text is None:
        return Unit()
    try:
        return parse_unit(text)
    except ValueError as error:
        reader.report("S103", str(error), node.span, "a unit is a product of powers, for example `m/s^2`")
        return Unit()


def read_range(node: Node | None, where: str, unit: Unit, here: Expressions) -> tuple[float, float] | None:
    """`[low, high]`, in `unit`."""
    if node is None:
        return None
    items = here.reader.items(node, f"`range` of {where}")
    if len(items) != 2:
        if items or (isinstance(node, Sequence) and not node.items):
            here.reader.wrong(node, f"`range` of {where}", "two numbers `[low, high]`")
        return None
    low = here.constant(items[0], f"the lower bound of {where}", unit)
    high = here.constant(items[1], f"the upper bound of {where}", unit)
    if low is None or high is None:
        return None
    if not low < high:
        here.reader.report(
            "S204", f"the range of {where} ends before it starts", node.span, f"[{high:g}, {low:g}]"
        )
        return None
    return low, high


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
        if "size" in found:
            later(reader, found["size"], "a control of several components")
        if "range" not in found:
            reader.report(
                "S204",
                f"{where} has no range",
                entry.key.span,
                f"{name}: {{range: [-1, 1]}}",
                label="needs bounds",
            )
        names.controls.append(_control(name, found, where, names.expressions(reader)))
    columns = [Column(c.name, c.unit, "real", "input", c.low, c.high, (), fact=True) for c in names.controls]
    names.entries |= column_entries(columns, about="control")


def _control(name: str, found: dict[str, Node], where: str, here: Expressions) -> ControlDecl:
    """One control."""
    reader = here.reader
    unit = read_unit(found.get("unit"), reader)
    low, high = read_range(found.get("range"), where, unit, here) or (-1.0, 1.0)
    word = reader.option(found.get("squash"), f"`squash` of {where}", get_args(Squash)) or "tanh"
    squash: Squash = "clip" if word == "clip" else "angle" if word == "angle" else "tanh"
    items = reader.items(found.get("levels"), f"`levels` of {where}")
    levels = [here.constant(item, f"a level of {where}", unit) for item in items]
    kept = tuple(level for level in levels if level is not None)
    for item, level in zip(items, levels, strict=True):
        if level is not None and not low <= level <= high:
            reader.report(
                "S204",
                f"a level of {where} is outside its range",
                item.span,
                f"the range is [{low:g}, {high:g}]",
            )
    return ControlDecl(name, unit, low, high, squash, kept)


def read_definitions(node: Node | None, reader: Reader, names: Names) -> None:
    """The section `def`: named sub-expressions, numbers or formulas; checked even where nothing uses them."""
    written: list[ast.Expr] = []
    for entry in reader.entries(node, "`def`"):
        if not names.declare(entry.key, "definition", reader):
            continue
        expr = names.expressions(reader).parse(entry.value, f"the definition `{entry.key.text}`")
        if expr is not None:
            written.append(expr)
            names.entries[entry.key.text] = Definition(
                entry.key.text, expr, about="definition", span=entry.key.span
            )
    here = names.expressions(reader)
    for expr in written:
        here.check(expr)


def later(reader: Reader, node: Node, what: str) -> None:
    """Report a key whose meaning this version does not act on."""
    place = first_line(node.span)
    reader.report(
        "E015", f"{what} is not supported by this version", place, label="not acted on, so it is refused"
    )


def empty(node: Node | None) -> bool:
    """Whether a section says nothing."""
    match node:
        case None:
            return True
        case Scalar():
            return node.is_null
        case Mapping(entries=entries):
            return not entries
        case Sequence(items=items):
            return not items
