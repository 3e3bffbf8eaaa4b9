"""Declared names of a system file, and the context in which its values are read."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from collections.abc import Mapping as MappingType
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Literal, TypeAlias

from stlc.compile.frontend.scope import Entry, Known, Scope, enforced
from stlc.compile.frontend.values import Number, VectorValue
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import Label, SystemFileError
from stlc.dynamics.schema.expressions import SECOND, Expressions
from stlc.dynamics.schema.reader import Reader
from stlc.dynamics.schema.yaml_nodes import Scalar
from stlc.grammar import ast
from stlc.signature import Column
from stlc.source import Span
from stlc.units import Unit

Squash: TypeAlias = Literal["tanh", "clip", "angle"]


@dataclass(frozen=True, slots=True)
class ControlDecl:
    """One control input, or one component of a vector of them.

    Attributes:
        name: as written.
        unit: of the stored numbers.
        low: lower end of the range, in `unit`.
        high: upper end of the range.
        squash: map from a network output to a value in the range.
        levels: values for searches; if empty, the range is sampled evenly.
    """

    name: str
    unit: Unit
    low: float
    high: float
    squash: Squash = "tanh"
    levels: tuple[float, ...] = ()


def each_number(entry: Entry, change: Callable[[Number], Number]) -> Entry:
    """A name with its number, or every component of its vector, changed."""
    match entry:
        case Known(value=Number() as number):
            return replace(entry, value=change(number))
        case Known(value=VectorValue(items) as vector):
            return replace(entry, value=replace(vector, items=tuple(map(change, items))))
        case _:
            return entry


def base_name(column: str) -> str:
    """Name of the vector that a column is a component of; for other columns their own name."""
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
        rewrite: change of every parsed expression before it is resolved; None leaves it as written.
    """

    constants: dict[str, tuple[float, Unit]] = field(default_factory=dict)
    columns: list[Column] = field(default_factory=list)
    controls: list[ControlDecl] = field(default_factory=list)
    entries: dict[str, Entry] = field(default_factory=dict)
    places: dict[str, Span] = field(default_factory=dict)
    rewrite: Callable[[ast.Expr], ast.Expr] | None = None

    def expressions(self, reader: Reader) -> Expressions:
        """Compiler of expressions that knows all declared names."""
        scope = Scope(dict(self.entries), error=SystemFileError, facts=enforced(self.columns))
        return Expressions(reader, scope, rewrite=self.rewrite)

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
            message, advice = f"`{key.text}` is declared twice", "rename one of the two"
            labels = (Label(first, "declared first"),)
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
        names: all declared names.
        here: compiler of the section's expressions.
        dt: time step, s.
        horizon: planning horizon in steps; 0 where it is unknown.
        discrete: whether `flow` holds next values instead of derivatives.
    """

    reader: Reader
    names: Names
    here: Expressions
    dt: Fraction = Fraction(1, 10)
    horizon: int = 0
    discrete: bool = False

    @staticmethod
    def of(reader: Reader, names: Names) -> Context:
        """Context of a section whose expressions read all names and draw nothing."""
        return Context(reader, names, names.expressions(reader))

    @property
    def plain(self) -> Context:
        """The context with the names declared by now, and no others."""
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
