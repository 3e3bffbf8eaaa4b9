"""Typed specifications: names resolved, types and units checked, macros expanded, time in seconds.

Numbers are those of `stlc.compile.ir.nodes`; formulas keep their negations, implications and source locations
(spans).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import Literal, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.signature import Column, Signature
from stlc.source import Span
from stlc.units import Unit


@dataclass(frozen=True, slots=True)
class Time:
    """Time of an interval bound or a delay: `seconds + steps * dt + horizons * T`."""

    seconds: Fraction = Fraction(0)
    steps: Fraction = Fraction(0)
    horizons: Fraction = Fraction(0)
    span: Span | None = field(default=None, compare=False, repr=False)

    def plus(self, other: Time | None) -> Time:
        """Return the sum of two times; None counts as zero."""
        if other is None:
            return self
        return Time(
            self.seconds + other.seconds,
            self.steps + other.steps,
            self.horizons + other.horizons,
            other.span or self.span,
        )


@dataclass(frozen=True, slots=True)
class DelayedSignal(ir.ShiftedSignal):
    """Signal shifted by a time, as in `shift(x, 0.1 s)`, in addition to `steps` samples.

    `stlc.compile.ir.discretize.in_samples` converts the time to samples on the grid.
    """

    delay: Time = field(default_factory=Time)


@dataclass(frozen=True, slots=True)
class Interval:
    """Interval of a temporal operator.

    If `hi` is None, the interval extends to the end of the trace (written `end`, `inf`, or no interval at
    all). `clock` is "now" if the bounds are relative to the present sample. It is "start" for an operator
    such as `always@[a, b]`, whose interval counts from the start of the mission.
    """

    lo: Time
    hi: Time | None
    lo_open: bool = False
    hi_open: bool = False
    clock: Literal["now", "start"] = "now"
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Node:
    """Base of typed formulas, with the source location (`span`) of the formula."""

    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Truth(Node):
    """`true` or `false`."""

    value: bool


@dataclass(frozen=True, slots=True)
class Predicate(Node):
    """Predicate `num > 0` (`strict`) or `num >= 0`.

    Attributes:
        num: the number compared with 0, in SI.
        strict: whether the comparison is `>`.
        guard: whether the predicate reads clocks and timers, the states that the compiler adds to count time.
            Such a predicate decides whether an enclosing formula holds, but not by how much.
        unit: unit of the margin, in SI.
        written: unit of the comparison in the source. For recorded traces, `num` and `unit` are converted to
            this unit (`stlc.compile.ir.lower`).
    """

    num: ir.Num
    strict: bool
    guard: bool = False
    unit: Unit = field(default=Unit.ONE, compare=False, repr=False)
    written: Unit = field(default=Unit.ONE, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Not(Node):
    """Negation."""

    body: Formula


@dataclass(frozen=True, slots=True)
class Logic(Node):
    """Propositional operator: `and`, `or` of two or more items; `->`, `<->`, `xor` of two; `if` of three.

    The items of `if` are the condition and the formulas after `then` and `else`.
    """

    op: Literal["and", "or", "xor", "->", "<->", "if"]
    items: tuple[Formula, ...]


UnaryTemporal: TypeAlias = Literal["always", "eventually", "once", "historically"]
BinaryTemporal: TypeAlias = Literal["until", "release", "unless", "since"]


@dataclass(frozen=True, slots=True)
class Temporal(Node):
    """Temporal operator with one operand, of the future or the past."""

    op: UnaryTemporal
    interval: Interval
    body: Formula


@dataclass(frozen=True, slots=True)
class Until(Node):
    """Temporal operator with two operands, of the future or the past."""

    op: BinaryTemporal
    interval: Interval
    left: Formula
    right: Formula


@dataclass(frozen=True, slots=True)
class Shift(Node):
    """Formula at another sample: `next(p)` (`steps` is 1) or `prev(p)` (-1).

    `outside` is the truth of the formula where the other sample lies outside the trace; if `outside` is None,
    the formula is undefined there. If `delay` is given, this time replaces `steps`.
    """

    steps: int
    body: Formula
    outside: bool | None = None
    delay: Time | None = None


@dataclass(frozen=True, slots=True)
class Edge(Node):
    """`rise(p)`: p has just become true. `fall(p)`: p has just become false. False at the first sample."""

    op: Literal["rise", "fall"]
    body: Formula


@dataclass(frozen=True, slots=True)
class Freeze(Node):
    """`freeze p0 = p in body`: in `body`, `p0` is the value of `p` at the instant of the `freeze` itself.

    Attributes:
        bindings: pairs (p0, p) of a name and an expression. In `body`, `ir.FrozenVar` refers to the name.
        body: formula that reads the names.
        units: unit of each value in the source, for messages.
    """

    bindings: tuple[tuple[str, ir.Num], ...]
    body: Formula
    units: tuple[Unit, ...] = field(default=(), compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Recalled(Node):
    """Past operator rewritten with timers (added states that hold the time since an event).

    The node never occurs inside a negation.

    Attributes:
        now: state formula that is equivalent to the operator at one instant. In it, tests of timers stand for
            the past; their robustness is +inf or -inf.
        along: formula that is equivalent to the operator along a plan or another part of a trace. The
            robustness of the node on this part is that of this formula. The timers are read only at the first
            sample of the part.
    """

    now: Formula
    along: Formula


Formula: TypeAlias = Truth | Predicate | Not | Logic | Temporal | Until | Shift | Edge | Freeze | Recalled


@dataclass(frozen=True, slots=True)
class Requirement:
    """Requirement (`require`) with its evaluated tags.

    Attributes:
        name: name of the requirement.
        doc: text of the `##` comment before the requirement.
        tags: names of the tags without arguments (`safety`, `liveness`).
        weight: factor of its robustness in the minimum over all requirements.
        scale: divisor of its robustness in the minimum over all requirements.
        id: text of `@id("…")`; "" without this tag.
        group: name in `@group(name)`; "" without this tag.
        formula: typed formula.
        written: syntax tree of the formula, for messages.
        span: source location of the declaration.
    """

    name: str
    doc: str
    tags: frozenset[str]
    weight: float
    scale: float
    id: str
    group: str
    formula: Formula
    written: ast.Expr
    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Parameter:
    """Component of a `param`: a value drawn once for every trajectory and constant along it.

    Attributes:
        span: source location of the name of the parameter.
        column: name, unit and range of the value.
        draw: distribution, a number that contains samplers such as `uniform`, in the unit of the column.
        text: text of the distribution in the source.
        carried: whether the system has a state of this name; the system then draws the value.
    """

    span: Span = field(compare=False, repr=False)
    column: Column
    draw: ir.Num
    text: str
    carried: bool = False


@dataclass(frozen=True, slots=True)
class Spec:
    """Resolved specification.

    Attributes:
        name: name given by `spec NAME`, else the stem of the file name.
        signature: declared signals, with their declared units.
        constants: (name, value in SI units) of every `const`.
        requirements: every `require`, in order.
        assumptions: every `assume`, in order.
        source_ast: syntax tree of the specification.
        parameters: components of every `param`.
        taken: names in use, which states added by the compiler must avoid.
        warnings: findings that are not errors.
    """

    name: str
    signature: Signature
    constants: tuple[tuple[str, float], ...]
    requirements: tuple[Requirement, ...]
    assumptions: tuple[Requirement, ...]
    source_ast: ast.Spec = field(compare=False, repr=False)
    parameters: tuple[Parameter, ...] = ()
    taken: frozenset[str] = frozenset()
    warnings: tuple[Diagnostic, ...] = field(default=(), compare=False, repr=False)
