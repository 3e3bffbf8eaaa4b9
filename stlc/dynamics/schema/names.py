"""Names of a system file: time, constants, states, controls and definitions."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Mapping as MappingType
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import TYPE_CHECKING

from stlc.compile.frontend.arithmetic import absolute
from stlc.compile.frontend.scope import Definition, Entry, Known, Scope, constant_value, enforced
from stlc.compile.frontend.values import Number, VectorValue
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import Label, SystemFileError
from stlc.dynamics.model.integrators import INTEGRATORS
from stlc.dynamics.schema.expressions import SECOND, Expressions
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.record import FLAG, SECONDS, STEPS, integer, key, read, reads, word
from stlc.dynamics.schema.yaml_nodes import Mapping, Node, Scalar, Sequence
from stlc.grammar import ast
from stlc.signature import Column, Signature
from stlc.source import Span
from stlc.units import CELSIUS, Unit, means_celsius, parse_unit

if TYPE_CHECKING:
    from stlc.dynamics.declaration.columns import ControlDecl


@dataclass(frozen=True, slots=True)
class Clockwork:
    """The section `time`; a horizon of 0 means unknown."""

    dt: Fraction = key(SECONDS, "time step, exact", Fraction(1, 10), required=True)
    horizon: int = key(STEPS, "planning horizon, as a time or in steps", 0, required=True)
    integrator: str = key(word(INTEGRATORS.names), "integration method", "euler")
    substeps: int = key(integer(high=1000), "integration steps within one step", 1)
    discrete: bool = key(FLAG, "`flow` gives next values instead of derivatives", False)


def base_name(column: str) -> str:
    """Name of the vector that a column is a component of; else its own name."""
    return column.partition("[")[0]


def component_names(name: str, size: int | None) -> tuple[str, ...]:
    """Columns of a state or control: its name, or one for each component of a vector."""
    return (name,) if size is None else tuple(f"{name}[{index}]" for index in range(size))


@dataclass
class Names:
    """The names declared so far.

    Attributes:
        constants: name -> (value in SI units, unit).
        columns: the states, in order.
        controls: the inputs, in order.
        entries: all names for expressions.
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
        """Compiler of expressions that knows all declared names."""
        return Expressions(
            reader, Scope(dict(self.entries), error=SystemFileError, facts=enforced(self.columns))
        )

    def group(self, name: str) -> tuple[Column, ...]:
        """Columns of a state: one, or the components of a vector; empty for other names."""
        exact = tuple(column for column in self.columns if column.name == name)
        return exact or tuple(column for column in self.columns if base_name(column.name) == name)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states; one per vector."""
        return tuple(dict.fromkeys(base_name(column.name) for column in self.columns))

    def vector(self, name: str) -> bool:
        """True if the state is a vector."""
        return all(column.name != name for column in self.columns)

    def place_components(self, name: str, columns: Iterable[str]) -> None:
        """Record the source location of a vector for its components."""
        if name in self.places:
            self.places |= dict.fromkeys(columns, self.places[name])

    def declare(self, key: Scalar, what: str, reader: Reader) -> bool:
        """Declare a name; False, with a finding, if it is taken or not an identifier."""
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


@dataclass(frozen=True, slots=True)
class Context:
    """Context in which the values of a section are read.

    Attributes:
        reader: collects findings.
        names: all declared names.
        clock: the time step and horizon.
        here: compiler of this section's expressions.
    """

    reader: Reader
    names: Names
    clock: Clockwork
    here: Expressions

    @staticmethod
    def of(reader: Reader, names: Names, clock: Clockwork | None = None) -> Context:
        """Context of a section whose expressions read all names and draw nothing."""
        return Context(reader, names, clock or Clockwork(), names.expressions(reader))

    @property
    def plain(self) -> Context:
        """The context without the names that `here` adds."""
        return replace(self, here=self.names.expressions(self.reader))

    @property
    def timed(self) -> Context:
        """The context with samplers, and `t` as the time of a deployment."""
        clock = Known(Number(ir.Signal("t"), SECOND), "seconds since the start of the deployment")
        return self.drawing({} if "t" in self.names.places else {"t": clock})

    def drawing(self, entries: MappingType[str, Entry], ready: frozenset[str] | None = None) -> Context:
        """The context with samplers and more names; `ready`: columns with a value, None for all."""
        return replace(self, here=self.plain.here.extended(entries, samplers=True, ready=ready))

    def amounts(self) -> Context:
        """The context where numbers are increments of columns."""
        return replace(self, here=replace(self.here, amounts=True))


def read_time(node: Node | None, reader: Reader, names: Names) -> Clockwork:
    """Read the section `time`; `dt` becomes a name."""
    first = node.get("dt") if isinstance(node, Mapping) else None
    scratch = Expressions(Reader(reader.source), names.expressions(reader).scope)
    dt = scratch.duration(first, "`dt`") or Clockwork().dt
    clock = read(Clockwork, Context.of(reader, names, Clockwork(dt)), node, "`time`")
    names.entries["dt"] = Known(constant_value(float(clock.dt), SECOND), "the step")
    return clock


def read_constants(node: Node | None, reader: Reader, names: Names) -> None:
    """Read the section `const`: numbers and vectors with units; later ones may use earlier ones."""
    for entry in reader.entries(node, "`const`"):
        name = entry.key.text
        if not names.declare(entry.key, "constant", reader):
            continue
        where = f"the constant `{name}`"
        numbers = names.expressions(reader).numbers(entry.value, where)
        if numbers is None:
            names.entries[name] = Known(constant_value(1.0), "constant")
            continue
        vector = len(numbers) > 1 or isinstance(entry.value, Sequence)
        called = component_names(name, len(numbers) if vector else None)
        for component, number in zip(called, numbers, strict=True):
            if number.constant is None:
                reader.wrong(entry.value, where, "a number that is known now")
                break
            known = absolute(number).constant or 0.0
            names.constants[component] = (known, Unit() if number.bare else number.unit)
        names.place_components(name, called)
        value = VectorValue(numbers) if vector else numbers[0]
        names.entries[name] = Known(value, "constant", entry.key.span)


@reads({"type": "string"})
def unit_text(cx: Context, node: Node, _label: str) -> Unit | None:
    """Read a unit."""
    text = cx.reader.text(node, "`unit`")
    try:
        return None if text is None else parse_unit(text)
    except ValueError as error:
        advice = (
            CELSIUS if means_celsius(text or "") else "a unit is a product of powers, for example `m/s^2`"
        )
        cx.reader.report("S103", str(error), node.span, advice)
        return None


def read_definitions(node: Node | None, reader: Reader, names: Names) -> None:
    """Read the section `def`: named sub-expressions, numbers or formulas; unused ones are checked too."""
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
