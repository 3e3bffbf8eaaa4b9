"""Abstract syntax tree, with one class per kind of expression, before types are known.

`stlc.compile.frontend.resolve` determines the types. Every node has a source location (`span`), which
comparisons of nodes ignore.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from fractions import Fraction
from typing import ClassVar, Literal, TypeAlias

from stlc.source import Span


@dataclass(frozen=True, slots=True)
class Node:
    """Base class of all nodes of the syntax tree; `span` is the location of the node's text in the source."""

    span: Span = field(compare=False, repr=False)
    is_formula: ClassVar[bool] = False
    """Form of the node: True if it is that of a formula, whatever the operands are."""

    def children(self) -> Iterator[Node]:
        """Yield the nodes directly below the node, in source order."""
        for part in fields(self):
            yield from _nodes_in(getattr(self, part.name))

    def walk(self) -> Iterator[Node]:
        """Yield the node and all nodes below it, in source order, outermost first."""
        stack: list[Node] = [self]
        while stack:
            top = stack.pop()
            yield top
            stack.extend(reversed(list(top.children())))


def _nodes_in(value: object) -> Iterator[Node]:
    if isinstance(value, Node):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from _nodes_in(item)


# ------------------------------------------------------------------ expressions


@dataclass(frozen=True, slots=True)
class Quantity(Node):
    """Number with its unit: "" for a number without a unit, "steps" for a number of time steps."""

    value: Fraction
    unit: str = ""


@dataclass(frozen=True, slots=True)
class String(Node):
    """String in double quotes."""

    value: str


@dataclass(frozen=True, slots=True)
class Bool(Node):
    """`true` or `false`."""

    is_formula: ClassVar = True
    value: bool


@dataclass(frozen=True, slots=True)
class Inf(Node):
    """The word `inf`: an infinite bound, or the end of the trace."""


@dataclass(frozen=True, slots=True)
class Name(Node):
    """A name in an expression, stored without backticks; `quoted` tells whether the source has them."""

    name: str
    quoted: bool = field(default=False, compare=False)


@dataclass(frozen=True, slots=True)
class Vector(Node):
    """Vector `[a, b, c]`."""

    items: tuple[Expr, ...]


@dataclass(frozen=True, slots=True)
class Index(Node):
    """Component of a vector: `base[index]`."""

    base: Expr
    index: Expr


@dataclass(frozen=True, slots=True)
class Attr(Node):
    """Name in an imported file: `base.name`."""

    base: Expr
    name: str


@dataclass(frozen=True, slots=True)
class Arg(Node):
    """Argument of a call; `name` is None for an argument without a name."""

    name: str | None
    value: Expr


@dataclass(frozen=True, slots=True)
class Call(Node):
    """Call of a function: `func(args)`; `func` is a `Name`, or an `Attr` as in `module.func(args)`."""

    func: Expr
    args: tuple[Arg, ...]


@dataclass(frozen=True, slots=True)
class Neg(Node):
    """Negative of a number: `-operand`."""

    operand: Expr


@dataclass(frozen=True, slots=True)
class Binary(Node):
    """Arithmetic operation with two operands: `+ - * / % ^`."""

    op: Literal["+", "-", "*", "/", "%", "^"]
    left: Expr
    right: Expr


Comparison: TypeAlias = Literal["<", "<=", ">", ">=", "==", "!="]


@dataclass(frozen=True, slots=True)
class Compare(Node):
    """Chain of comparisons: `a <= b < c` has three operands and two operators."""

    is_formula: ClassVar = True
    operands: tuple[Expr, ...]
    ops: tuple[Comparison, ...]


@dataclass(frozen=True, slots=True)
class Member(Node):
    """Membership `item in region`, or `item not in region` if `negated`.

    The right side is an expression, a range `[lo, hi]` or a set `{1, 2}`.
    """

    is_formula: ClassVar = True
    item: Expr
    region: Expr | SetLiteral
    negated: bool = False


@dataclass(frozen=True, slots=True)
class SetLiteral(Node):
    """Set `{1, 2}` on the right of `in`."""

    items: tuple[Expr, ...]


@dataclass(frozen=True, slots=True)
class Not(Node):
    """Negation `not operand`."""

    is_formula: ClassVar = True
    operand: Expr


@dataclass(frozen=True, slots=True)
class Logic(Node):
    """Logical connective between two formulas: `and`, `or`, `xor`, `->` or `<->`."""

    is_formula: ClassVar = True
    op: Literal["and", "or", "xor", "->", "<->"]
    left: Expr
    right: Expr


@dataclass(frozen=True, slots=True)
class Interval(Node):
    """Interval of a temporal operator.

    Attributes:
        lo: lower bound, an expression for a time.
        hi: upper bound; `Inf` and the name `end` mean "to the end of the trace".
        lo_open: whether the lower bound is excluded, `(lo, …`.
        hi_open: whether the upper bound is excluded, `…, hi)`.
        clock: zero point of the bounds. It is "now" for the present sample, or "start" for the start of the
            mission, as in `always@[a, b]`.
    """

    lo: Expr
    hi: Expr
    lo_open: bool = False
    hi_open: bool = False
    clock: Literal["now", "start"] = "now"


@dataclass(frozen=True, slots=True)
class Temporal(Node):
    """Temporal operator with one operand: `op[interval] body`.

    Without an interval the window extends to the end of the trace. `alias` is the spelling in the source if
    that is not `op`, such as `G`; else it is "".
    """

    op: str
    interval: Interval | None
    body: Expr
    alias: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class Until(Node):
    """Temporal operator with two operands: `left op[interval] right`.

    Without an interval the window extends to the end of the trace. `alias` is the spelling in the source if
    that is not `op`, such as `U`; else it is "".
    """

    op: str
    interval: Interval | None
    left: Expr
    right: Expr
    alias: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class Quantifier(Node):
    """Quantifier `forall i in 0..6: body`; `domain` is a pair (low, high) or a set."""

    kind: Literal["forall", "exists"]
    var: str
    domain: tuple[Expr, Expr] | SetLiteral
    body: Expr


@dataclass(frozen=True, slots=True)
class Extreme(Node):
    """Greatest or least value of a number over a window, `max[-5 s, 0 s](x)`; it stands in a comparison."""

    op: Literal["max", "min"]
    interval: Interval
    body: Expr


@dataclass(frozen=True, slots=True)
class Freeze(Node):
    """Formula `freeze p0 = p, … in body`, in which p0 keeps the value that p has now."""

    bindings: tuple[tuple[str, Expr], ...]
    body: Expr


@dataclass(frozen=True, slots=True)
class IfThenElse(Node):
    """Choice `if cond then yes else no` between formulas or between numbers."""

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
    | Extreme
    | IfThenElse
)

# ----------------------------------------------------------------- declarations


@dataclass(frozen=True, slots=True)
class Tag(Node):
    """Tag of a requirement: `@safety`, `@weight(2)`, `@id("R1")`."""

    name: str
    args: tuple[Arg, ...] = ()


@dataclass(frozen=True, slots=True)
class TypeRef(Node):
    """Type in a declaration: `real`, `int`, `bool`, the name of an enum, or `real[7]`."""

    name: str
    size: int | None = None


@dataclass(frozen=True, slots=True)
class Declaration(Node):
    """Base class of the declarations in a specification.

    Attributes:
        noun: kind of the declaration in messages.
        name: the declared name.
        name_span: location of the name in the source.
        tags: tags before the declaration.
        doc: text of the `##` comment before it.
    """

    noun: ClassVar[str]
    name: str
    name_span: Span = field(compare=False, repr=False)
    tags: tuple[Tag, ...]
    doc: str

    @property
    def names(self) -> tuple[str, ...]:
        """Names that the declaration introduces."""
        return (self.name,)


@dataclass(frozen=True, slots=True)
class Signal(Declaration):
    """Declaration `env signal x : Type [unit] in [lo, hi] from "column"`; each declared name gets a node."""

    noun: ClassVar = "signal"
    role: Literal["input", "output", "state", "env"] | None
    type: TypeRef | None
    unit: str
    domain: tuple[Expr, Expr] | SetLiteral | None
    column: str | None


@dataclass(frozen=True, slots=True)
class Const(Declaration):
    """Declaration `const c [unit] = expr`."""

    noun: ClassVar = "constant"
    type: TypeRef | None
    unit: str
    value: Expr


@dataclass(frozen=True, slots=True)
class Param(Declaration):
    """Declaration of a parameter: `param r [unit] in [lo, hi]`, or `param r [unit] ~ uniform(…)`.

    `domain` is the pair of bounds, a set of values, or the call that names a distribution.
    """

    noun: ClassVar = "parameter"
    type: TypeRef | None
    unit: str
    domain: tuple[Expr, Expr] | SetLiteral | Expr


@dataclass(frozen=True, slots=True)
class Enum(Declaration):
    """Declaration `enum Sign { stop = 0, light = 1 }`."""

    noun: ClassVar = "enum"
    members: tuple[tuple[str, int], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The name of the enum and those of its members."""
        return (self.name, *(name for name, _ in self.members))


@dataclass(frozen=True, slots=True)
class Region(Declaration):
    """Declaration `region pond = circle(…)`."""

    noun: ClassVar = "region"
    value: Expr


@dataclass(frozen=True, slots=True)
class Formal(Node):
    """Formal argument of a `def` or an `extern fn`."""

    name: str
    type: TypeRef | None


@dataclass(frozen=True, slots=True)
class Def(Declaration):
    """Declaration `def name(args) = expr`, a macro."""

    noun: ClassVar = "definition"
    formals: tuple[Formal, ...]
    type: TypeRef | None
    value: Expr


@dataclass(frozen=True, slots=True)
class Extern(Declaration):
    """Declaration `extern fn ee(q: real[7]) -> real[3] [m]`."""

    noun: ClassVar = "function"
    formals: tuple[Formal, ...]
    type: TypeRef
    unit: str


@dataclass(frozen=True, slots=True)
class Require(Declaration):
    """Declaration `require name: formula`."""

    noun: ClassVar = "requirement"
    formula: Expr


@dataclass(frozen=True, slots=True)
class Assume(Declaration):
    """Declaration `assume name: formula`."""

    noun: ClassVar = "assumption"
    formula: Expr


@dataclass(frozen=True, slots=True)
class Import(Node):
    """Import `import "file" as m`, or `import std`."""

    target: str
    is_file: bool
    alias: str | None
