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
    """Declaration of a named value: its span, and its description ("line 5")."""

    span: Span | None
    text: str


@dataclass(frozen=True, slots=True)
class Number:
    """Scalar in SI units relative to the offset of its unit: 20 degC is 20, a point of that scale.

    Attributes:
        num: the number in the IR.
        unit: physical unit, for checks and messages; `num` is in SI whatever the unit's scale. With an
            offset the number is a point.
        flexible: of unknown unit (none declared, or a factor is a bare number): agrees with any unit.
        bare: made of bare numbers alone: takes the required unit, with its scale (`psi < 30`).
        exact: exact value of a rational constant.
        sense: `difference` of two points, not comparable with a point; `open`: a point minus a varying
            number in kelvin (a difference if that is a temperature), or a multiple of a point.
        kind: `bool` is 0 or 1 and also a formula; `enum` is one of `labels`.
        labels: (label, value) pairs of an enum.
        formula: for a choice between bools, the choice between formulas, with their margins.
        span: in the source.
        origin: declaration of its name.
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
        """Value in SI units relative to the offset of its unit, if constant."""
        return self.num.value if isinstance(self.num, ir.Const) else None


@dataclass(frozen=True, slots=True)
class VectorValue:
    """Scalars in order."""

    items: tuple[Number, ...]
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class EnumMember:
    """Member of one or several enums, resolved by the other operand of a comparison."""

    name: str
    options: tuple[Labels, ...]
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class TimeExpr:
    """Time on the grid: `seconds + steps * dt + horizons * T`, or `end` (and `inf`)."""

    seconds: Fraction = Fraction(0)
    steps: Fraction = Fraction(0)
    horizons: Fraction = Fraction(0)
    end: bool = False
    span: Span | None = field(default=None, compare=False, repr=False)

    def plus(self, other: TimeExpr, factor: int) -> TimeExpr:
        """Return the sum with `factor` times another time; `end` and the span are dropped."""
        return TimeExpr(
            self.seconds + factor * other.seconds,
            self.steps + factor * other.steps,
            self.horizons + factor * other.horizons,
        )

    def times(self, factor: Fraction) -> TimeExpr:
        """Return the multiple; `end` and the span are dropped."""
        return TimeExpr(self.seconds * factor, self.steps * factor, self.horizons * factor)

    def on(self, span: Span | None) -> typed.Time:
        """Return the time as a bound written at `span`."""
        return typed.Time(self.seconds, self.steps, self.horizons, span)


class Operand(NamedTuple):
    """Operand as written, with its value."""

    expr: ast.Expr
    value: Value


@dataclass(frozen=True, slots=True)
class Swept:
    """`sweep(p)`: segment from a point to its position at the next sample."""

    point: VectorValue
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class NormBall:
    """Points at most `radius` from `center`; a disc in 2D."""

    center: VectorValue
    radius: Number
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Box:
    """Points between two corners, component by component."""

    lower: VectorValue
    upper: VectorValue
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Polygon:
    """Simple polygon in 2D with constant corners in counter-clockwise order."""

    corners: tuple[VectorValue, ...]
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class HalfSpace:
    """Points with `normal . p <= offset`."""

    normal: VectorValue
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
    """Region dilated by `margin` (eroded where it is negative)."""

    region: Region
    margin: Number
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Complement:
    """Complement of a region."""

    region: Region
    span: Span | None = field(default=None, compare=False, repr=False)


Region: TypeAlias = NormBall | Box | Polygon | HalfSpace | Combined | Dilated | Complement
REGION_TYPES = (NormBall, Box, Polygon, HalfSpace, Combined, Dilated, Complement)
Value: TypeAlias = Number | VectorValue | Swept | EnumMember | TimeExpr | Region | typed.Formula


def is_formula(value: Value) -> bool:
    """True if the value is a formula with margins (not a bool signal, whose margin is always 1/2)."""
    return isinstance(value, typed.Node) or (isinstance(value, Number) and value.formula is not None)


def literal(value: Fraction | float | int, span: Span | None = None) -> Number:
    """A bare number."""
    exact = Fraction(value) if isinstance(value, Fraction | int) else None
    kind: Kind = "int" if exact is not None and exact.denominator == 1 else "real"
    return Number(ir.Const(float(value)), flexible=True, bare=True, exact=exact, kind=kind, span=span)


def at(value: Value, span: Span) -> Value:
    """Return the value with another `span` (a formula keeps its own spans)."""
    return value if isinstance(value, typed.Node) else replace(value, span=span)


def unit_text(number: Number) -> str:
    """`[m/s]`, or "" for a number without a unit."""
    return "" if number.unit.dimensionless and not number.unit.text else f"[{number.unit}]"


def describe(value: Value) -> str:
    """Return the sort for messages: `real [m]`, `vector of 3`, `formula`, `region`."""
    match value:
        case Number():
            return f"{value.kind} {unit_text(value)}".rstrip()
        case VectorValue():
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
    """Return the sort with its article: `a number [m]`, `a formula`."""
    match value:
        case Number():
            return f"a number {unit_text(value)}".rstrip()
        case EnumMember():
            return "an enum member"
        case _:
            return f"a {describe(value)}"
