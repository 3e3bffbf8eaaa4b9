"""Typed specifications: names bound, sorts and units checked, macros expanded, time in seconds.

Numbers are already those of `stlc.compile.ir.nodes`; formulas keep their negations, implications and spans.
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
from stlc.units import DIMENSIONLESS, Unit


@dataclass(frozen=True, slots=True)
class Time:
    """A bound: `seconds + steps * dt + horizons * T`."""

    seconds: Fraction = Fraction(0)
    steps: Fraction = Fraction(0)
    horizons: Fraction = Fraction(0)
    span: Span | None = field(default=None, compare=False, repr=False)

    def plus(self, other: Time | None) -> Time:
        """The sum of two times."""
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
    """A signal some time away, `shift(x, 0.1 s)`, besides the samples that are known already.

    The grid of time says how many samples the delay is (`stlc.compile.ir.discretize.in_samples`).
    """

    delay: Time = field(default_factory=Time)


@dataclass(frozen=True, slots=True)
class Interval:
    """Bounds of a temporal operator; `hi` None means to the end of the trace (`end`, `inf` or nothing)."""

    lo: Time
    hi: Time | None
    lo_open: bool = False
    hi_open: bool = False
    clock: Literal["now", "start"] = "now"
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Node:
    """Base of typed formulas."""

    span: Span = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Truth(Node):
    """`true` or `false`."""

    value: bool


@dataclass(frozen=True, slots=True)
class Predicate(Node):
    """`num > 0` (`strict`) or `num >= 0`; a `guard` decides truth and never limits the margin.

    `num` and `unit`, that of the margin, are in SI; `written` is the unit of what is compared. Where recorded
    traces are judged both are in that (`stlc.compile.lowering.lower`).
    """

    num: ir.Num
    strict: bool
    guard: bool = False
    unit: Unit = field(default=DIMENSIONLESS, compare=False, repr=False)
    written: Unit = field(default=DIMENSIONLESS, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Not(Node):
    """Negation."""

    body: Formula


@dataclass(frozen=True, slots=True)
class Logic(Node):
    """`and` and `or` hold two or more items, `->`, `<->` and `xor` exactly two."""

    op: Literal["and", "or", "xor", "->", "<->"]
    items: tuple[Formula, ...]


@dataclass(frozen=True, slots=True)
class Temporal(Node):
    """A temporal operator with one operand."""

    op: ast.UnaryTemporal
    interval: Interval
    body: Formula


@dataclass(frozen=True, slots=True)
class Until(Node):
    """A temporal operator with two operands."""

    op: ast.BinaryTemporal
    interval: Interval
    left: Formula
    right: Formula


@dataclass(frozen=True, slots=True)
class Shift(Node):
    """`next(p)` (+1), `prev(p)` (-1); `outside` as in `ir.Shift`; `delay` is a time instead of the steps."""

    steps: int
    body: Formula
    outside: bool | None = None
    delay: Time | None = None


@dataclass(frozen=True, slots=True)
class Edge(Node):
    """`rise(p)` or `fall(p)`; false at the first sample."""

    op: Literal["rise", "fall"]
    body: Formula


@dataclass(frozen=True, slots=True)
class Freeze(Node):
    """`freeze p0 = p in body`: each name, of an `ir.FrozenVar`, stands for the value of its number now."""

    bindings: tuple[tuple[str, ir.Num], ...]
    body: Formula


@dataclass(frozen=True, slots=True)
class Recalled(Node):
    """A past operator rewritten with timers; it is under no negation.

    Attributes:
        now: as a formula about one instant, whose timers decide truth alone.
        along: with a robustness, along any stretch of a trace from whose first sample the timers are known.
    """

    now: Formula
    along: Formula


Formula: TypeAlias = Truth | Predicate | Not | Logic | Temporal | Until | Shift | Edge | Freeze | Recalled


@dataclass(frozen=True, slots=True)
class Requirement:
    """One `require`, with what its tags say.

    Attributes:
        name: of the requirement.
        doc: its `##` comment.
        tags: bare tag names (`safety`, `liveness`).
        weight: factor of its robustness in the whole.
        scale: divisor of its robustness in the whole.
        id: of `@id("…")`, or "".
        group: of `@group(name)`, or "".
        formula: as typed.
        written: the declaration's formula as written, for messages.
        span: of the declaration.
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
    """One component of a `param`: a constant of every trajectory.

    Attributes:
        span: of its name.
        column: that holds it, with its range.
        draw: how it is drawn, in the unit of the column; a number with samplers.
        text: the same as written.
        carried: the system has it as a state, and draws it.
    """

    span: Span = field(compare=False, repr=False)
    column: Column
    draw: ir.Num
    text: str
    carried: bool = False


@dataclass(frozen=True, slots=True)
class Spec:
    """A resolved specification.

    Attributes:
        name: of the `spec` pragma, else the stem of the file.
        signature: the signals that the file declares, units as declared.
        constants: every `const`, in SI units.
        requirements: in order.
        assumptions: `assume`s, in order.
        source_ast: as parsed.
        parameters: every `param`, by component.
        taken: names that states added by the compiler must not have.
        warnings: findings that are no errors.
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
