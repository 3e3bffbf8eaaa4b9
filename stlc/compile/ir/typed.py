"""Typed specifications: names resolved, types and units checked, macros expanded, time in seconds.

Numbers are those of `stlc.compile.ir.nodes`; formulas keep their negations, implications and source locations
(spans).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, Literal, Self, TypeAlias, assert_never

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.tree import FormulaTree
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.grammar.spec import Spec as WrittenSpec
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

    `stlc.compile.ir.discretize.Grid.in_samples` converts the time to samples on the grid.
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

    @property
    def is_now(self) -> bool:
        """True if both bounds are the present sample, or the start of the mission."""
        return self.lo == self.hi == Time()


@dataclass(frozen=True, slots=True)
class Formula(ir.Node, FormulaTree["Formula"]):
    """Base of typed formulas, with the source location (`span`) of the formula."""

    span: Span = field(compare=False, repr=False)

    @property
    def word(self) -> str:
        """Word or sign of an operator, such as `always`, `not` or `->`; "" for other formulas."""
        return getattr(self, "op", "")

    @property
    def temporal(self) -> Timed | None:
        """The formula itself if it is a temporal operator."""
        return None

    @property
    def ahead(self) -> Interval | None:
        """Interval of a temporal operator of the future; None for other formulas."""
        node = self.temporal
        return None if node is None or node.op in _PAST else node.interval

    @property
    def pointwise(self) -> bool:
        """True for an operator that reads its operands at the present instant."""
        return isinstance(self, Not | Logic | Freeze)

    def joined_by(self, op: str) -> tuple[Formula, ...]:
        """Return the operands of the propositional operator `op`; none if the formula is another one."""
        return self.items if isinstance(self, Logic) and self.op == op else ()

    def predicates(self) -> Iterator[Predicate]:
        """Yield the predicates in the formula."""
        return (node for node in self.walk() if isinstance(node, Predicate))

    def temporals(self) -> Iterator[Timed]:
        """Yield the temporal operators in the formula."""
        return (node for node in self.walk() if isinstance(node, Timed))

    def times(self) -> Iterator[Time]:
        """Yield the bounds of intervals and the delays of `shift` in the formula."""
        for node in self.walk():
            if isinstance(node, Timed):
                yield from (end for end in (node.interval.lo, node.interval.hi) if end is not None)
            elif isinstance(node, Shift) and node.delay is not None:
                yield node.delay
        leaves = (leaf for num in self.numbers() for leaf in num.leaves())
        yield from (leaf.delay for leaf in leaves if isinstance(leaf, DelayedSignal))

    @property
    def counts_samples(self) -> bool:
        """True if the formula counts samples: `3 steps`, `dt`, `prev(p)`; it then depends on `dt`."""
        return (
            any(time.steps for time in self.times())
            or any(isinstance(node, Shift) and node.delay is None for node in self.walk())
            or any(steps for num in self.numbers() for _, steps, _ in num.reads())
        )

    @property
    def margin_unit(self) -> str:
        """Unit of the formula's robustness; "" if its predicates have different units."""
        found = {node.unit.text for node in self.predicates() if not node.guard}
        return found.pop() if len(found) == 1 else ""

    @property
    def on_clock(self) -> bool:
        """True for an operator whose interval counts from the start of the mission (`always@[a, b]`)."""
        return False

    def from_now(self) -> Formula:
        """Return the formula with its own interval relative to now: `always[a, b]` for `always@[a, b]`.

        At the first sample of a trace, the two mean the same.
        """
        return self

    def from_first_sample(self) -> Formula:
        """Return the formula of a requirement that is evaluated only at the first sample of a recorded trace.

        At that sample, mission time and relative time are equal, so absolute operators (`always@[a, b]`)
        become relative ones (`always[a, b]`). This does not apply to absolute operators below another
        temporal operator, which evaluates them at later samples too. They stay absolute: their interval still
        counts from the first sample.
        """
        if isinstance(self, Timed | Shift | Edge):
            return self.from_now()
        return self.map_children(formulas=lambda part: part.from_first_sample())

    @property
    def absolute(self) -> bool:
        """True if an operator's interval counts from the mission's start (`always@[a, b]`)."""
        return any(node.on_clock for node in self.walk())

    @property
    def looks_back(self) -> bool:
        """True if the formula has a past operator."""
        return any(node.word in (*_PAST, "rise", "fall") for node in self.walk())

    def timer_form(self) -> Formula:
        """Return a state formula with its past operators in the form for a single instant.

        The past operators were rewritten with timers before, to `Recalled` nodes. A `Recalled` node has two
        forms: one for a single instant (`now`), one for the samples of a plan (`along`). Each node is
        replaced by `now`, a test of the timers.
        """
        return self.map_children(formulas=lambda part: part.timer_form())

    def is_state(self, *, augmented: bool = False) -> bool:
        """True for a state formula, whose truth depends on one instant (and on enclosing frozen values).

        Args:
            augmented: whether the formula is for training. If so, two rules change. `Recalled` nodes, which
                are past operators rewritten with timers, count as state formulas. Formulas with frozen values
                do not count as state formulas, since frozen values come from other instants.
        """
        state: tuple[type, ...] = (Truth, Predicate, Not, Logic)
        elsewhere: tuple[type, ...] = (ir.ShiftedSignal,)
        if augmented:
            state, elsewhere = (*state, Recalled), (ir.ShiftedSignal, ir.FrozenVar)
        return all(isinstance(node, state) for node in self.walk()) and not any(
            isinstance(leaf, elsewhere) for num in self.numbers() for leaf in num.leaves()
        )

    @property
    def mentions_horizon(self) -> bool:
        """True if a bound of the formula is written with the planning horizon `T`."""
        timed = (node.interval for node in self.temporals())
        return any(end is not None and end.horizons != 0 for each in timed for end in (each.lo, each.hi))


@dataclass(frozen=True, slots=True)
class Truth(Formula):
    """`true` or `false`."""

    value: bool


@dataclass(frozen=True, slots=True)
class Predicate(Formula):
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
class Not(Formula):
    """Negation."""

    body: Formula

    @property
    def word(self) -> str:
        """The word `not`."""
        return "not"


Sign: TypeAlias = Literal[1, -1]


def flip(sign: Sign) -> Sign:
    """Return the opposite sign."""
    return -1 if sign > 0 else 1


@dataclass(frozen=True, slots=True)
class Connective:
    """A propositional operator, or its negation, as an `and` or `or` of groups of operands.

    Attributes:
        op: operator between the groups; within a group it is the dual one.
        groups: pairs (operand, sign); the sign -1 stands for the negation of the operand.
    """

    op: Literal["and", "or"]
    groups: tuple[tuple[tuple[Formula, Sign], ...], ...]


@dataclass(frozen=True, slots=True)
class Logic(Formula):
    """Propositional operator: `and`, `or` of two or more items; `->`, `<->`, `xor` of two; `if` of three.

    The items of `if` are the condition and the formulas after `then` and `else`.
    """

    op: Literal["and", "or", "xor", "->", "<->", "if"]
    items: tuple[Formula, ...]

    def connective(self, sign: Sign = 1) -> Connective:
        """Return the definition of a propositional operator, or of its negation if `sign` is -1.

        `a -> b` is `not a or b`, `a <-> b` is `(a -> b) and (b -> a)`, and `a xor b` is the negation of that.
        `if c then p else q` is `(c and p) or (not c and q)`.
        """
        op, items, inverse = self.op, self.items, flip(sign)
        plain: Literal["and", "or"] = "and" if sign > 0 else "or"
        dual: Literal["and", "or"] = ir.DUAL[plain]
        match op:
            case "and" | "or":
                return Connective(plain if op == "and" else dual, tuple(((item, sign),) for item in items))
            case "->":
                return Connective(dual, (((items[0], inverse),), ((items[1], sign),)))
            case "if":
                cond, yes, no = items
                return Connective(dual, (((cond, sign), (yes, sign)), ((cond, inverse), (no, sign))))
            case "xor":
                return replace(self, op="<->").connective(inverse)
            case "<->":
                left, right = items
                return Connective(plain, (((left, inverse), (right, sign)), ((left, sign), (right, inverse))))
        assert_never(op)


UnaryTemporal: TypeAlias = Literal["always", "eventually", "once", "historically"]
BinaryTemporal: TypeAlias = Literal["until", "release", "unless", "since"]
_PAST = ("once", "historically", "since")


class Timed(Formula):
    """Base of temporal operators."""

    __slots__ = ()
    op: UnaryTemporal | BinaryTemporal
    interval: Interval

    @property
    def temporal(self) -> Self:
        """The operator itself."""
        return self

    @property
    def on_clock(self) -> bool:
        """True if the interval counts from the start of the mission (`always@[a, b]`)."""
        return self.interval.clock == "start"

    def from_now(self) -> Self:
        """Return the operator with its interval relative to now."""
        node: Any = self
        changed: Self = replace(node, interval=replace(self.interval, clock="now"))
        return changed


@dataclass(frozen=True, slots=True)
class Temporal(Timed):
    """Temporal operator with one operand, of the future or the past."""

    op: UnaryTemporal
    interval: Interval
    body: Formula


@dataclass(frozen=True, slots=True)
class Until(Timed):
    """Temporal operator with two operands, of the future or the past."""

    op: BinaryTemporal
    interval: Interval
    left: Formula
    right: Formula

    def unless(self) -> Logic:
        """Return `left unless[a, b] right` as `always[0, b] left or left until[a, b] right`."""
        whole = replace(self.interval, lo=Time(), lo_open=False)
        held = Temporal(self.span, "always", whole, self.left)
        return Logic(self.span, "or", (held, replace(self, op="until")))


@dataclass(frozen=True, slots=True)
class Shift(Formula):
    """Formula at another sample: `next(p)` (`steps` is 1) or `prev(p)` (-1).

    `outside` is the truth of the formula where the other sample lies outside the trace; if `outside` is None,
    the formula is undefined there. If `delay` is given, this time replaces `steps`.
    """

    steps: int
    body: Formula
    outside: bool | None = None
    delay: Time | None = None


@dataclass(frozen=True, slots=True)
class Edge(Formula):
    """`rise(p)`: p has just become true. `fall(p)`: p has just become false. False at the first sample."""

    op: Literal["rise", "fall"]
    body: Formula


@dataclass(frozen=True, slots=True)
class Freeze(Formula):
    """`freeze p0 = p in body`: in `body`, `p0` is the value of `p` at the instant of the `freeze` itself.

    Attributes:
        bindings: pairs (p0, p) of a name and an expression. In `body`, `ir.FrozenVar` refers to the name.
        body: formula that reads the names.
        units: unit of each value in the source, for messages.
    """

    bindings: tuple[tuple[str, ir.Num], ...]
    body: Formula
    units: tuple[Unit, ...] = field(default=(), compare=False, repr=False)

    @property
    def word(self) -> str:
        """The word `freeze`."""
        return "freeze"


@dataclass(frozen=True, slots=True)
class Recalled(Formula):
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

    @property
    def operands(self) -> tuple[Formula, ...]:
        """The form for one instant alone, which has no past operator."""
        return (self.now,)

    def timer_form(self) -> Formula:
        """Return the test of the timers."""
        return self.now.timer_form()


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
    source_ast: WrittenSpec = field(compare=False, repr=False)
    parameters: tuple[Parameter, ...] = ()
    taken: frozenset[str] = frozenset()
    warnings: tuple[Diagnostic, ...] = field(default=(), compare=False, repr=False)
