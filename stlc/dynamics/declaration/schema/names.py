"""Declared names of a system file, and the context in which the values of a section are read."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from collections.abc import Mapping as MappingType
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import ClassVar, Literal, TypeAlias

from stlc.compile.frontend.scope import Entry, Known, Scope
from stlc.compile.frontend.values import Number, VectorValue
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import SystemFileError
from stlc.dynamics.declaration.schema.expressions import SECOND, Expressions
from stlc.dynamics.declaration.schema.reader import Reader
from stlc.dynamics.declaration.schema.yaml_nodes import Scalar
from stlc.grammar import ast
from stlc.jsontext import Num
from stlc.signature import Column, Signature
from stlc.source import Span
from stlc.units import Unit

Squash: TypeAlias = Literal["tanh", "clip", "angle"]


@dataclass(frozen=True, slots=True)
class ControlDecl:
    """One control input, or one component of a vector of control inputs.

    Attributes:
        name: name in the system file.
        unit: unit of its values.
        low: lower end of the range, in `unit`.
        high: upper end of the range, in `unit`.
        squash: name of the map from a network output to a value in the range.
        levels: values that a search may try; if empty, values spread evenly over the range.
    """

    JSON: ClassVar = "name low high unit=unit.shown"

    name: str
    unit: Unit
    low: Num
    high: Num
    squash: Squash = "tanh"
    levels: tuple[float, ...] = ()


def each_number(entry: Entry, change: Callable[[Number], Number]) -> Entry:
    """Return the entry of a name with `change` applied to its number, or to each component of its vector.

    An entry that stands for something else, such as a function, is returned unchanged.
    """
    match entry:
        case Known(value=Number() as number):
            return replace(entry, value=change(number))
        case Known(value=VectorValue(items) as vector):
            return replace(entry, value=replace(vector, items=tuple(map(change, items))))
        case _:
            return entry


def base_name(column: str) -> str:
    """Return the name of a column without its index: `p` for the component `p[0]`, `x` for `x`."""
    return column.partition("[")[0]


def component_names(name: str, size: int | None) -> tuple[str, ...]:
    """Return the column names of a state or control: `x` itself, or `x[0]`, `x[1]`, … for a vector."""
    return (name,) if size is None else tuple(f"{name}[{index}]" for index in range(size))


@dataclass(frozen=True, slots=True)
class NumberChanges:
    """Changes of the numbers that the dynamics compute with, while a file is read again.

    Attributes:
        constant: function from the name and the entry of a constant to the changed entry.
        rewrite: function applied to every parsed expression of the dynamics; None changes nothing.
        constants: the changed entries of the constants, and further ones; filled while the file is read.
    """

    constant: Callable[[str, Known], Entry]
    rewrite: Callable[[ast.Expr], ast.Expr] | None = None
    constants: dict[str, Entry] = field(default_factory=dict)


@dataclass
class Names:
    """Names declared in a system file; filled while its sections are read.

    Attributes:
        constants: name -> (value in SI units, unit).
        columns: state columns (scalar states and components of vectors), in order.
        controls: control inputs, in order.
        entries: everything that a name can stand for in an expression.
        places: name -> source location of its declaration.
        changes: other numbers for the dynamics; None for those of the file.
    """

    constants: dict[str, tuple[float, Unit]] = field(default_factory=dict)
    columns: list[Column] = field(default_factory=list)
    controls: list[ControlDecl] = field(default_factory=list)
    entries: dict[str, Entry] = field(default_factory=dict)
    places: dict[str, Span] = field(default_factory=dict)
    changes: NumberChanges | None = None

    def expressions(self, reader: Reader) -> Expressions:
        """Return a compiler of expressions that knows all names declared up to now."""
        ranges = Signature(tuple(self.columns)).enforced
        scope = Scope(dict(self.entries), error=SystemFileError, ranges=ranges)
        return Expressions(reader, scope)

    def group(self, name: str) -> tuple[Column, ...]:
        """Return the columns of the state `name`: one, or one per component; () for an unknown name."""
        exact = tuple(column for column in self.columns if column.name == name)
        return exact or tuple(column for column in self.columns if base_name(column.name) == name)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states; a vector counts once."""
        return tuple(dict.fromkeys(base_name(column.name) for column in self.columns))

    def vector(self, name: str) -> bool:
        """True if the state `name` is a vector."""
        return all(column.name != name for column in self.columns)

    def place_components(self, name: str, columns: Iterable[str]) -> None:
        """Record that the component columns of the vector `name` are declared where the vector is."""
        if name in self.places:
            self.places |= dict.fromkeys(columns, self.places[name])

    def declare(self, key: Scalar, what: str, reader: Reader) -> bool:
        """Declare the name in `key`; `what` describes the thing in messages, such as "parameter".

        Returns True if the name is free and is an identifier. Otherwise a finding is reported, and the result
        is False.
        """
        first = self.places.get(key.text)
        if first is not None:
            message, advice = f"`{key.text}` is declared twice", "rename one of the two"
            labels = (first.label("declared first"),)
            reader.report("E102", message, key.span, advice, label=f"{what} here", labels=labels)
            return False
        if not key.text.isidentifier() or key.text == "dt":
            message = f"`{key.text}` cannot be the name of a {what}"
            reader.report("S103", message, key.span, "choose another name")
            return False
        self.places[key.text] = key.span
        return True


@dataclass(frozen=True, slots=True)
class Context:
    """Context in which the values of a section are read.

    Attributes:
        reader: collects findings.
        names: all names declared before.
        here: compiler of the expressions of this section.
        dt: time step in seconds.
        horizon: planning horizon in steps; 0 if it is unknown.
        discrete: whether `flow` gives next values of the states instead of derivatives.
    """

    reader: Reader
    names: Names
    here: Expressions
    dt: Fraction = Fraction(1, 10)
    horizon: int = 0
    discrete: bool = False

    @staticmethod
    def of(reader: Reader, names: Names) -> Context:
        """Return the context of a section whose expressions may read all names but draw no random numbers."""
        return Context(reader, names, names.expressions(reader))

    @property
    def plain(self) -> Context:
        """This context without local names and without random numbers (samplers such as `uniform`).

        All names declared in the system file up to now can be read.
        """
        return replace(self, here=self.names.expressions(self.reader))

    @property
    def moving(self) -> Context:
        """The context `plain` of the dynamics, with the changed numbers."""
        here, changes = self.names.expressions(self.reader), self.names.changes
        if changes is None:
            return replace(self, here=here)
        return replace(self, here=replace(here.extended(changes.constants), rewrite=changes.rewrite))

    @property
    def timed(self) -> Context:
        """This context with functions such as `uniform`, which draw random numbers, and with the name `t`.

        `t` is the time since the start of a deployment, in seconds.
        """
        clock = Known(Number(ir.Signal("t"), SECOND), "seconds since the start of the deployment")
        return self.drawing({} if "t" in self.names.places else {"t": clock})

    def drawing(self, entries: MappingType[str, Entry], ready: frozenset[str] | None = None) -> Context:
        """Return this context with functions such as `uniform`, and with the additional names `entries`.

        `ready` are the names (of states, parameters or local names) that already have a value, and may
        therefore be read; None means all.
        """
        return replace(self, here=self.plain.here.extended(entries, samplers=True, ready=ready))

    def amounts(self) -> Context:
        """Return this context for reading numbers that are added to columns, as in a disturbance.

        5 degC is then a temperature difference, not a temperature.
        """
        return replace(self, here=replace(self.here, amounts=True))
