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
from stlc.units import Unit, nearest

Labels: TypeAlias = tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class Origin:
    """Declaration of a named value: its source location, and its description ("line 5")."""

    span: Span | None
    text: str


@dataclass(frozen=True, slots=True)
class Placed:
    """Base class of values; `span` is the source location of the expression, which comparisons ignore."""

    span: Span | None = field(default=None, compare=False, repr=False, kw_only=True)


@dataclass(frozen=True, slots=True)
class Number(Placed):
    """Scalar expression in SI units, counted from the zero of its own unit: 20 degC is 20, not 293.15.

    A number in a unit with an offset (degC) is a temperature, as opposed to a temperature difference.

    Attributes:
        num: the number in the IR, in SI units whatever the scale of `unit`.
        unit: physical unit, for checks and messages.
        flexible: whether the number agrees with any unit. This is so if no unit was declared for it, or if
            one of its factors has no unit.
        bare: whether the number consists only of numbers without a unit. It then takes the unit that its
            place requires, with the scale of this unit: in `psi < 30`, 30 means 30 deg if psi is in deg.
        exact: exact value of a rational constant, else None.
        sense: "difference" for the difference of two temperatures, which cannot be compared with a
            temperature. "open" if the number may be a temperature or a difference: a varying number in kelvin
            was subtracted from a temperature, or a temperature was multiplied or divided by a plain number.
            "" otherwise.
        kind: type of the values; a `bool` is 0 or 1 and is also a formula, an `enum` is one of `labels`.
        labels: (label, value) pairs of an enum.
        formula: for a number such as `if c then p else q` with bools p and q, the same choice as a formula,
            with the margins of p and q. None for any other number.
        origin: declaration of the name that stands for the number, if any.
    """

    num: ir.Num
    unit: Unit = Unit.ONE
    flexible: bool = False
    bare: bool = False
    exact: Fraction | None = None
    kind: Kind = "real"
    sense: Literal["", "difference", "open"] = ""
    labels: Labels = ()
    formula: typed.Formula | None = None
    origin: Origin | None = field(default=None, compare=False, repr=False)

    @property
    def constant(self) -> float | None:
        """Value of a constant, in SI units counted from the zero of its unit; None for a varying number."""
        return self.num.value if isinstance(self.num, ir.Const) else None

    @classmethod
    def fixed(cls, value: float, unit: Unit = Unit.ONE) -> Number:
        """Return the constant `value`, given in SI units, as a number in `unit`.

        A constant without a unit takes the unit that its place in an expression requires.
        """
        bare = not unit.text
        exact = Fraction(repr(value)) - unit.offset
        kind: Literal["int", "real"] = "int" if bare and exact.denominator == 1 else "real"
        return cls(ir.Const(nearest(exact)), unit, bare, bare, exact, kind)


@dataclass(frozen=True, slots=True)
class VectorValue(Placed):
    """Vector of numbers."""

    items: tuple[Number, ...]


@dataclass(frozen=True, slots=True)
class EnumMember(Placed):
    """Name of a member of one or several enums.

    If there are several, the other operand of a comparison decides which enum is meant.
    """

    name: str
    options: tuple[Labels, ...]


@dataclass(frozen=True, slots=True)
class TimeExpr(Placed):
    """Time `seconds + steps * dt + horizons * T`, or `end` (also written `inf`), the end of the trace."""

    seconds: Fraction = Fraction(0)
    steps: Fraction = Fraction(0)
    horizons: Fraction = Fraction(0)
    end: bool = False

    def plus(self, other: TimeExpr, factor: int) -> TimeExpr:
        """Return `this time + factor * other`; neither time may be `end`."""
        return TimeExpr(
            self.seconds + factor * other.seconds,
            self.steps + factor * other.steps,
            self.horizons + factor * other.horizons,
        )

    def times(self, factor: Fraction) -> TimeExpr:
        """Return `factor` times this time, which must not be `end`."""
        return TimeExpr(self.seconds * factor, self.steps * factor, self.horizons * factor)

    def on(self, span: Span | None) -> typed.Time:
        """Return the time as an interval bound or a delay with the source location `span`."""
        return typed.Time(self.seconds, self.steps, self.horizons, span)


class Operand(NamedTuple):
    """Operand of an operator: its expression and its value."""

    expr: ast.Expr
    value: Value


@dataclass(frozen=True, slots=True)
class Swept(Placed):
    """Value of `sweep(p)`: the straight segment from a point to its position at the next sample."""

    point: VectorValue


@dataclass(frozen=True, slots=True)
class NormBall(Placed):
    """Region of the points at most `radius` from `center`; a disc in the plane."""

    center: VectorValue
    radius: Number


@dataclass(frozen=True, slots=True)
class BoxRegion(Placed):
    """Region of the points whose components all lie between those of `lower` and `upper`."""

    lower: VectorValue
    upper: VectorValue


@dataclass(frozen=True, slots=True)
class Polygon(Placed):
    """Simple polygon in the plane with constant corners in counter-clockwise order."""

    corners: tuple[VectorValue, ...]


@dataclass(frozen=True, slots=True)
class HalfSpace(Placed):
    """Region of the points p with `normal . p <= offset`."""

    normal: VectorValue
    offset: Number


@dataclass(frozen=True, slots=True)
class Combined(Placed):
    """Union or intersection (`op`) of at least one region."""

    op: Literal["union", "intersect"]
    parts: tuple[Region, ...]


@dataclass(frozen=True, slots=True)
class Dilated(Placed):
    """Region of the points within `margin` of another region; a negative margin shrinks this region."""

    region: Region
    margin: Number


@dataclass(frozen=True, slots=True)
class Complement(Placed):
    """Region of the points outside of another region."""

    region: Region


Region: TypeAlias = NormBall | BoxRegion | Polygon | HalfSpace | Combined | Dilated | Complement
REGION_TYPES = (NormBall, BoxRegion, Polygon, HalfSpace, Combined, Dilated, Complement)
Value: TypeAlias = Number | VectorValue | Swept | EnumMember | TimeExpr | Region | typed.Formula


def is_formula(value: Value) -> bool:
    """True for a formula, and for `if c then p else q` with bools p and q; False for a bool signal.

    A bool signal b can be used as a formula too, but it only stands for `b >= 1/2`.
    """
    return isinstance(value, typed.Formula) or (isinstance(value, Number) and value.formula is not None)


def literal(value: Fraction | float | int, span: Span | None = None) -> Number:
    """Return a constant as a number without a unit, exact if it is a fraction or an integer."""
    exact = Fraction(value) if isinstance(value, Fraction | int) else None
    kind: Kind = "int" if exact is not None and exact.denominator == 1 else "real"
    return Number(ir.Const(float(value)), flexible=True, bare=True, exact=exact, kind=kind, span=span)


def at(value: Value, span: Span) -> Value:
    """Return a value with the source location `span`; a formula keeps its own location."""
    return value if isinstance(value, typed.Formula) else replace(value, span=span)


def unit_text(number: Number) -> str:
    """Return the unit of a number in brackets, as in `[m/s]`; "" for a number without a unit."""
    return "" if number.unit.dimensionless and not number.unit.text else f"[{number.unit}]"


def describe(value: Value) -> str:
    """Return the type of a value for messages: `real [m]`, `vector of 3`, `formula`, `region`."""
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
        case typed.Formula():
            return "formula"
        case _:
            return "region"


def noun(value: Value) -> str:
    """Return the type of a value with its article, for messages: `a number [m]`, `a formula`."""
    match value:
        case Number():
            return f"a number {unit_text(value)}".rstrip()
        case EnumMember():
            return "an enum member"
        case _:
            return f"a {describe(value)}"


def shifted(num: ir.Num, steps: int, *, clamped: bool = False, delay: typed.Time | None = None) -> ir.Num:
    """Return a number shifted in time by `steps` samples (positive: later).

    If `delay` is given, the number is shifted by this time in addition. Outside the trace a `clamped` number
    repeats the first or last sample.
    """

    def moved(leaf: ir.Num) -> ir.Num:
        if not isinstance(leaf, (ir.Signal, ir.ShiftedSignal)):
            return leaf
        there, ends, later = steps, clamped, delay
        if isinstance(leaf, ir.ShiftedSignal):
            there, ends = there + leaf.steps, ends or leaf.clamped
        if isinstance(leaf, typed.DelayedSignal):
            later = leaf.delay.plus(delay)
        if later is not None:
            return typed.DelayedSignal(leaf.name, there, ends, later)
        return ir.ShiftedSignal(leaf.name, there, ends) if there else ir.Signal(leaf.name)

    found: ir.Num = num.map_leaves(moved)
    return found
