"""Typed specifications: names bound, sorts and units checked, macros expanded, time in seconds.

Numbers are those of `stlc.compile.ir.nodes`; formulas keep their negations, implications and spans.
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
    """Bound of an interval: `seconds + steps * dt + horizons * T`."""

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
    """Signal shifted by a time, `shift(x, 0.1 s)`, in addition to `steps` samples.

    `stlc.compile.ir.discretize.in_samples` converts the time to samples on the grid.
    """

    delay: Time = field(default_factory=Time)


@dataclass(frozen=True, slots=True)
class Interval:
    """Bounds of a temporal operator; `hi` None: to the end of the trace (`end`, `inf` or omitted)."""

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

    `num` and the margin's `unit` are in SI; `written` is the unit of the comparison in the source. For
    recorded traces `num` and `unit` are converted to it (`stlc.compile.lowering.lower`).
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


UnaryTemporal: TypeAlias = Literal["always", "eventually", "once", "historically"]
BinaryTemporal: TypeAlias = Literal["until", "release", "unless", "since"]


@dataclass(frozen=True, slots=True)
class Temporal(Node):
    """Temporal operator with one operand."""

    op: UnaryTemporal
    interval: Interval
    body: Formula


@dataclass(frozen=True, slots=True)
class Until(Node):
    """Temporal operator with two operands."""

    op: BinaryTemporal
    interval: Interval
    left: Formula
    right: Formula


@dataclass(frozen=True, slots=True)
class Shift(Node):
    """`next(p)` (+1), `prev(p)` (-1); `outside` as in `ir.Shift`; `delay` is a time in place of steps."""

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
    """`freeze p0 = p in body`: each bound `ir.FrozenVar` has the value of its number now."""

    bindings: tuple[tuple[str, ir.Num], ...]
    body: Formula


@dataclass(frozen=True, slots=True)
class Recalled(Node):
    """Past operator rewritten with timers, under no negation.

    Attributes:
        now: state formula in which timers decide truth, without a margin.
        along: formula with a robustness, along any part of a trace with known timers at its first sample.
    """

    now: Formula
    along: Formula


Formula: TypeAlias = Truth | Predicate | Not | Logic | Temporal | Until | Shift | Edge | Freeze | Recalled


@dataclass(frozen=True, slots=True)
class Requirement:
    """Requirement (`require`) with its evaluated tags.

    Attributes:
        name: name of the requirement.
        doc: its `##` comment.
        tags: bare tag names (`safety`, `liveness`).
        weight: factor of its robustness in the overall minimum.
        scale: divisor of its robustness in the overall minimum.
        id: of `@id("…")`, or "".
        group: of `@group(name)`, or "".
        formula: typed formula.
        written: formula as written, for messages.
        span: place of the declaration.
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
    """Component of a `param`: constant along a trajectory.

    Attributes:
        span: place of its name.
        column: column of the value, with its range.
        draw: distribution as a number with samplers, in the unit of the column.
        text: distribution as written.
        carried: the system has it as a state, and draws it.
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
        name: that in the `spec` pragma, else the stem of the file.
        signature: declared signals, with their declared units.
        constants: every `const`, in SI units.
        requirements: every `require`, in order.
        assumptions: every `assume`, in order.
        source_ast: syntax tree.
        parameters: components of every `param`.
        taken: names that states added by the compiler must not use.
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
