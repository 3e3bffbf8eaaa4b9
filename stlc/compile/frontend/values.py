"""Values of expressions: numbers, vectors, regions, times, enum members and formulas."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Literal, NamedTuple, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.grammar import ast
from stlc.signature import Kind
from stlc.source import Span
from stlc.units import DIMENSIONLESS, Unit

Labels: TypeAlias = tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class Origin:
    """Declaration of a named value: its span, and the words for it ("line 5")."""

    span: Span | None
    text: str


@dataclass(frozen=True, slots=True)
class Number:
    """A scalar in SI units, counted from the zero of its unit: 20 degC is 20, a point of that scale.

    Attributes:
        num: how it is computed.
        unit: its physical unit, for checks and messages; `num` is in SI whatever the unit's scale. One with
            an offset makes the number a point.
        flexible: of unknown unit (nothing was declared, or a factor is a bare number): agrees with any unit.
        bare: made of bare numbers alone: takes the unit that is needed, with its scale (`psi < 30`).
        exact: the value of a constant that is rational.
        sense: `difference` of two points, which is compared with no point; `open`: a point less something in
            kelvin that varies, which is a difference where that is a temperature, or a multiple of a point.
        kind: `bool` stands for 0/1 and is a formula too; `enum` is one of `labels`.
        labels: (label, value) pairs of an enum.
        formula: of a choice between bools: the choice between formulas, with their margins.
        span: where it is written.
        origin: where its name was declared.
    """

    num: ir.Num
    unit: Unit = DIMENSIONLESS
    flexible: bool = False
    bare: bool = False
    exact: Fraction | None = None
    kind: Kind = "real"
    sense: Literal["", "difference", "open"] = ""
    labels: Labels = ()
    formula: typed.Formula | None = None
    span: Span | None = field(default=None, compare=False, repr=False)
    origin: Origin | None = field(default=None, compare=False, repr=False)

    @property
    def constant(self) -> float | None:
        """Its value in SI units from the zero of its unit, if it is known now."""
        return self.num.value if isinstance(self.num, ir.Const) else None


@dataclass(frozen=True, slots=True)
class Vector:
    """Scalars in order."""

    items: tuple[Number, ...]
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class EnumMember:
    """A member of one or several enums, told apart by what it is compared with."""

    name: str
    options: tuple[Labels, ...]
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class TimeExpr:
    """A time that needs the grid: `seconds + steps * dt + horizons * T`, or `end` (and `inf`)."""

    seconds: Fraction = Fraction(0)
    steps: Fraction = Fraction(0)
    horizons: Fraction = Fraction(0)
    end: bool = False
    span: Span | None = field(default=None, compare=False, repr=False)


class Operand(NamedTuple):
    """An operand as it is written, with its value."""

    expr: ast.Expr
    value: Value


@dataclass(frozen=True, slots=True)
class Swept:
    """`sweep(p)`: the segment from a point to where it is at the next sample."""

    point: Vector
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Ball:
    """Points at most `radius` from `center`; a circle in the plane."""

    center: Vector
    radius: Number
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Box:
    """Points between two corners, component by component."""

    lower: Vector
    upper: Vector
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Polygon:
    """A simple polygon of the plane, its corners known, in counter-clockwise order."""

    corners: tuple[Vector, ...]
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class HalfSpace:
    """Points with `normal . p <= offset`."""

    normal: Vector
    offset: Number
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Combined:
    """Union or intersection of at least one region."""

    op: Literal["union", "intersect"]
    parts: tuple[Region, ...]
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Dilated:
    """A region grown by `margin` (shrunk where it is negative)."""

    region: Region
    margin: Number
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Complement:
    """Everything outside a region."""

    region: Region
    span: Span | None = field(default=None, compare=False, repr=False)


Region: TypeAlias = Ball | Box | Polygon | HalfSpace | Combined | Dilated | Complement
REGION_TYPES = (Ball, Box, Polygon, HalfSpace, Combined, Dilated, Complement)
Value: TypeAlias = Number | Vector | Swept | EnumMember | TimeExpr | Region | typed.Formula


def is_formula(value: Value) -> bool:
    """True if it has margins of its own (the margin of a bool signal is always a half)."""
    return isinstance(value, typed.Node) or (isinstance(value, Number) and value.formula is not None)


def literal(value: Fraction | float | int, span: Span | None = None) -> Number:
    """A bare number."""
    exact = Fraction(value) if isinstance(value, Fraction | int) else None
    kind: Kind = "int" if exact is not None and exact.denominator == 1 else "real"
    return Number(ir.Const(float(value)), flexible=True, bare=True, exact=exact, kind=kind, span=span)


def at(value: Value, span: Span) -> Value:
    """The same value, written at `span` (a formula keeps its own places)."""
    return value if isinstance(value, typed.Node) else replace(value, span=span)


def unit_text(number: Number) -> str:
    """`[m/s]`, or "" for a number without a unit."""
    return "" if number.unit.dimensionless and not number.unit.text else f"[{number.unit}]"


def describe(value: Value) -> str:
    """Its sort in words, for messages: `real [m]`, `vector of 3`, `formula`, `region`."""
    match value:
        case Number():
            return f"{value.kind} {unit_text(value)}".rstrip()
        case Vector():
            unit = unit_text(value.items[0]) if value.items else ""
            return f"vector of {len(value.items)} {unit}".rstrip()
        case Swept():
            return "segment"
        case EnumMember():
            return "enum member"
        case TimeExpr():
            return "time"
        case typed.Node():
            return "formula"
        case _:
            return "region"


def noun(value: Value) -> str:
    """With its article: `a number [m]`, `a formula`."""
    match value:
        case Number():
            return f"a number {unit_text(value)}".rstrip()
        case EnumMember():
            return "an enum member"
        case _:
            return f"a {describe(value)}"
