"""Abstract syntax as written, with one class of expressions; `stlc.compile.frontend.resolve` adds types.

Every node has a span, which equality ignores.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Literal, TypeAlias

from stlc.source import Source, Span


@dataclass(frozen=True, slots=True)
class Node:
    """Base of all nodes."""

    span: Span = field(compare=False, repr=False)


# ------------------------------------------------------------------ expressions


@dataclass(frozen=True, slots=True)
class Quantity(Node):
    """Number with its unit ("" for a bare number; "steps" is a unit)."""

    value: Fraction
    unit: str = ""


@dataclass(frozen=True, slots=True)
class String(Node):
    """String in double quotes."""

    value: str


@dataclass(frozen=True, slots=True)
class Bool(Node):
    """`true` or `false`."""

    value: bool


@dataclass(frozen=True, slots=True)
class Inf(Node):
    """`inf`."""


@dataclass(frozen=True, slots=True)
class Name(Node):
    """Name without its backticks, which are recorded."""

    name: str
    quoted: bool = field(default=False, compare=False)


@dataclass(frozen=True, slots=True)
class Vector(Node):
    """`[a, b, c]`."""

    items: tuple[Expr, ...]


@dataclass(frozen=True, slots=True)
class Index(Node):
    """`base[index]`."""

    base: Expr
    index: Expr


@dataclass(frozen=True, slots=True)
class Attr(Node):
    """`base.name`, for imported modules."""

    base: Expr
    name: str


@dataclass(frozen=True, slots=True)
class Arg(Node):
    """An argument of a call; `name` is None for a positional one."""

    name: str | None
    value: Expr


@dataclass(frozen=True, slots=True)
class Call(Node):
    """`func(args)`; `func` is a Name, or an Attr of an imported module."""

    func: Expr
    args: tuple[Arg, ...]


@dataclass(frozen=True, slots=True)
class Neg(Node):
    """`-operand`."""

    operand: Expr


@dataclass(frozen=True, slots=True)
class Binary(Node):
    """Arithmetic: `+ - * / % ^`."""

    op: Literal["+", "-", "*", "/", "%", "^"]
    left: Expr
    right: Expr


@dataclass(frozen=True, slots=True)
class Compare(Node):
    """Comparison chain: `a <= b < c` has three operands and two operators."""

    operands: tuple[Expr, ...]
    ops: tuple[Literal["<", "<=", ">", ">=", "==", "!="], ...]


@dataclass(frozen=True, slots=True)
class Member(Node):
    """`item in region`; the right side is an expression, a range `[lo, hi]` or a set `{1, 2}`."""

    item: Expr
    region: Expr | SetLiteral
    negated: bool = False


@dataclass(frozen=True, slots=True)
class SetLiteral(Node):
    """`{1, 2}` on the right of `in`."""

    items: tuple[Expr, ...]


@dataclass(frozen=True, slots=True)
class Not(Node):
    """Negation."""

    operand: Expr


@dataclass(frozen=True, slots=True)
class Logic(Node):
    """`and or xor -> <->`, binary, as written."""

    op: Literal["and", "or", "xor", "->", "<->"]
    left: Expr
    right: Expr


@dataclass(frozen=True, slots=True)
class Interval(Node):
    """Bounds of a temporal operator.

    Attributes:
        lo: lower bound, an expression of sort time.
        hi: upper bound; `Inf` and the name `end` mean "to the end of the trace".
        lo_open: the lower bound is excluded, `(lo, …`.
        hi_open: the upper bound is excluded, `…, hi)`.
        clock: "now" is relative to the time of evaluation; "start" is the mission clock (`@`).
    """

    lo: Expr
    hi: Expr
    lo_open: bool = False
    hi_open: bool = False
    clock: Literal["now", "start"] = "now"


@dataclass(frozen=True, slots=True)
class Temporal(Node):
    """`op[interval] body`; without an interval, to the end of the trace."""

    op: str
    interval: Interval | None
    body: Expr
    alias: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class Until(Node):
    """`left op[interval] right`."""

    op: str
    interval: Interval | None
    left: Expr
    right: Expr
    alias: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class Quantifier(Node):
    """`forall i in 0..6: body`; `domain` is a (low, high) pair or a set."""

    kind: Literal["forall", "exists"]
    var: str
    domain: tuple[Expr, Expr] | SetLiteral
    body: Expr


@dataclass(frozen=True, slots=True)
class Freeze(Node):
    """`freeze p0 = p, … in body`."""

    bindings: tuple[tuple[str, Expr], ...]
    body: Expr


@dataclass(frozen=True, slots=True)
class IfThenElse(Node):
    """`if cond then yes else no`, for formulas and for numbers."""

    cond: Expr
    yes: Expr
    no: Expr


Expr: TypeAlias = (
    Quantity
    | String
    | Bool
    | Inf
    | Name
    | Vector
    | Index
    | Attr
    | Call
    | Neg
    | Binary
    | Compare
    | Member
    | Not
    | Logic
    | Temporal
    | Until
    | Quantifier
    | Freeze
    | IfThenElse
)

# ----------------------------------------------------------------- declarations


@dataclass(frozen=True, slots=True)
class Tag(Node):
    """`@safety`, `@weight(2)`, `@id("R1")`."""

    name: str
    args: tuple[Arg, ...] = ()


@dataclass(frozen=True, slots=True)
class TypeRef(Node):
    """`real`, `int`, `bool`, the name of an enum, or `real[7]`."""

    name: str
    size: int | None = None


@dataclass(frozen=True, slots=True)
class Declaration(Node):
    """Base of declarations: name, its span, tags and `##` comment."""

    name: str
    name_span: Span = field(compare=False, repr=False)
    tags: tuple[Tag, ...]
    doc: str


@dataclass(frozen=True, slots=True)
class Signal(Declaration):
    """`env signal x : Sort [unit] in [lo, hi] from "column"` (one node per name)."""

    role: Literal["input", "output", "state", "env"] | None
    type: TypeRef | None
    unit: str
    domain: tuple[Expr, Expr] | SetLiteral | None
    column: str | None


@dataclass(frozen=True, slots=True)
class Const(Declaration):
    """`const c [unit] = expr`."""

    type: TypeRef | None
    unit: str
    value: Expr


@dataclass(frozen=True, slots=True)
class Param(Declaration):
    """`param r [unit] in [lo, hi]`, or `~ distribution` (a call)."""

    type: TypeRef | None
    unit: str
    domain: tuple[Expr, Expr] | SetLiteral | Expr


@dataclass(frozen=True, slots=True)
class Enum(Declaration):
    """`enum Sign { stop = 0, light = 1 }`."""

    members: tuple[tuple[str, int], ...]


@dataclass(frozen=True, slots=True)
class Region(Declaration):
    """`region pond = circle(…)`."""

    value: Expr


@dataclass(frozen=True, slots=True)
class Formal(Node):
    """A formal argument of a `def` or an `extern fn`."""

    name: str
    type: TypeRef | None


@dataclass(frozen=True, slots=True)
class Def(Declaration):
    """`def name(args) = expr`; a macro."""

    formals: tuple[Formal, ...]
    type: TypeRef | None
    value: Expr


@dataclass(frozen=True, slots=True)
class Extern(Declaration):
    """`extern fn ee(q: real[7]) -> real[3] [m]`."""

    formals: tuple[Formal, ...]
    type: TypeRef
    unit: str


@dataclass(frozen=True, slots=True)
class Require(Declaration):
    """`require name: formula`."""

    formula: Expr


@dataclass(frozen=True, slots=True)
class Assume(Declaration):
    """`assume name: formula`."""

    formula: Expr


@dataclass(frozen=True, slots=True)
class Import(Node):
    """`import "file" as m`, or `import std`."""

    target: str
    is_file: bool
    alias: str | None


Item: TypeAlias = Signal | Const | Param | Enum | Region | Def | Extern | Require | Assume


@dataclass(frozen=True, slots=True)
class Spec(Node):
    """A whole file.

    Attributes:
        name: of the `spec` pragma; "" when there is none.
        system: path of the `system` pragma, as written.
        system_span: of that path.
        time_unit: unit of bare numbers in intervals; "" when there is no `time` pragma.
        imports: in order.
        items: declarations in order.
        source: the text.
        library: texts of imports, by key (`stlc.compile.frontend.modules`); None to read the files.
    """

    name: str
    system: str | None
    system_span: Span | None = field(compare=False, repr=False)
    time_unit: str
    imports: tuple[Import, ...]
    items: tuple[Item, ...]
    source: Source = field(compare=False, repr=False)
    library: Mapping[str, str] | None = field(default=None, compare=False, repr=False)
