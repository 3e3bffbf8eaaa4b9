"""Intermediate representation (IR): numbers, and formulas in negation normal form with time in steps.

The evaluators, the dynamics and all back ends read the IR. Nodes are immutable and compare by structure, so
common sub-expressions are found by equality.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Self, TypeAlias, TypeVar

from stlc.compile.ir.support import EARLIEST, HISTORY, NOW, REQUIRED, Analysis, Offsets, Reach, Tail
from stlc.compile.ir.tree import FormulaTree, Tree
from stlc.source import Span

V = TypeVar("V")


class Node(Tree):
    """Base of numbers and formulas, in the IR and in typed specifications."""

    __slots__ = ()

    @property
    def columns(self) -> frozenset[str]:
        """Names of the signals that the node reads, at any sample."""
        read = {leaf.name for leaf in self.leaves() if isinstance(leaf, (Signal, ShiftedSignal))}
        return frozenset(read - {ELAPSED})

    @property
    def frozen(self) -> frozenset[str]:
        """Names of the frozen values (bound by `freeze`) that the node reads."""
        return frozenset(leaf.name for leaf in self.leaves() if isinstance(leaf, FrozenVar))

    @property
    def shifted(self) -> bool:
        """True if the node reads a signal at another sample."""
        return any(isinstance(leaf, ShiftedSignal) for leaf in self.leaves())

    @property
    def counts(self) -> bool:
        """True if the node reads the index of the current sample."""
        return any(name == ELAPSED for name, *_ in self.reads())

    def reads(self) -> Iterator[tuple[str, int, bool]]:
        """Yield (name, offset in samples, clamped) of every signal that the node reads (`ShiftedSignal`)."""
        for leaf in self.leaves():
            if isinstance(leaf, ShiftedSignal):
                yield leaf.name, leaf.steps, leaf.clamped
            elif isinstance(leaf, Signal):
                yield leaf.name, 0, False

    def calls(self) -> Iterator[Extern]:
        """Yield the calls of functions that the system provides."""
        return (part for part in self.subexpressions() if isinstance(part, Extern))

    def substitute(self, table: Mapping[str, Num]) -> Self:
        """Return the node with its columns replaced by numbers; `table` maps column -> number."""
        return self.map_leaves(lambda leaf: table.get(leaf.name, leaf) if isinstance(leaf, Signal) else leaf)

    def substitute_frozen(self, values: Mapping[str, Num]) -> Self:
        """Return the node with free frozen values replaced; `values` gives the replacement for each name.

        Names that an inner `freeze` binds again are not replaced.
        """
        own = {name for name, _ in getattr(self, "bindings", ())}
        outer = {name: value for name, value in values.items() if name not in own} if own else values
        return self.map_children(
            formulas=lambda body: body.substitute_frozen(outer),
            numbers=lambda num: num.substitute_frozen(values),
        )

    def map_parts(self, rewrite: Callable[[Num], Num]) -> Self:
        """Return the node with `rewrite` applied to its direct operands.

        For a state formula, `rewrite` is applied to the numbers in its predicates.
        """
        return self.map_children(numbers=rewrite, formulas=lambda part: part.map_parts(rewrite))


# ---------------------------------------------------------------------- numbers


class Num(Node):
    """Base of numbers, with the arithmetic of expressions; a float stands for a constant."""

    __slots__ = ()
    is_number: ClassVar = True

    def __add__(self, other: Num | float) -> Op:
        return Op("add", (self, _number(other)))

    def __radd__(self, other: float) -> Op:
        return Op("add", (Const(other), self))

    def __sub__(self, other: Num | float) -> Op:
        return Op("sub", (self, _number(other)))

    def __rsub__(self, other: float) -> Op:
        return Op("sub", (Const(other), self))

    def __mul__(self, other: Num | float) -> Op:
        return Op("mul", (self, _number(other)))

    def __rmul__(self, other: float) -> Op:
        return Op("mul", (Const(other), self))

    def __truediv__(self, other: Num | float) -> Op:
        return Op("div", (self, _number(other)))

    def __rtruediv__(self, other: float) -> Op:
        return Op("div", (Const(other), self))

    def __mod__(self, other: Num | float) -> Op:
        return Op("mod", (self, _number(other)))

    def apply(self, name: str, *others: Num | float) -> Op:
        """Return the function `name` of `stlc.compile.ir.functions.FUNCTIONS` of this number and others."""
        return Op(name, (self, *map(_number, others)))

    def __neg__(self) -> Op:
        return Op("neg", (self,))

    @staticmethod
    def total(parts: Sequence[Num]) -> Num:
        """Return the sum of one or more numbers, as a tree of little depth."""
        if len(parts) == 1:
            return parts[0]
        half = len(parts) // 2
        return Num.total(parts[:half]) + Num.total(parts[half:])

    @property
    def reach(self) -> Reach:
        """Samples before and after now that the number needs in order to be defined."""
        return Reach.over(leaf.steps for leaf in self._shifts() if not leaf.clamped)

    @property
    def farthest(self) -> Reach:
        """Samples before and after now that the number reads.

        Unlike `reach`, this includes signals that repeat their first or last sample outside the trace
        (`clamped`).
        """
        return Reach.over(leaf.steps for leaf in self._shifts())

    @property
    def depends_on_ends(self) -> bool:
        """True if the number depends on where the trace begins or ends.

        This is so if a signal in it repeats its first or last sample outside the trace (`clamped`).
        """
        return any(leaf.clamped for leaf in self._shifts())

    @property
    def is_linear(self) -> bool:
        """True for a linear function of one signal, whose range is that of the signal, mapped."""
        match self:
            case Signal():
                return True
            case Op("neg", (inner,)):
                return inner.is_linear
            case Op("add" | "sub" | "mul" | "div", (inner, Const())):
                return inner.is_linear
            case Op("add" | "sub" | "mul", (Const(), inner)):
                return inner.is_linear
            case _:
                return False

    def _shifts(self) -> Iterator[ShiftedSignal]:
        return (leaf for leaf in self.leaves() if isinstance(leaf, ShiftedSignal))


def _number(other: Num | float) -> Num:
    return other if isinstance(other, Num) else Const(other)


@dataclass(frozen=True, slots=True)
class Const(Num):
    """Constant in SI units."""

    value: float


@dataclass(frozen=True, slots=True)
class Signal(Num):
    """Value of a signal at the current sample: a state, a control, the time `t`, or a recorded signal."""

    name: str

    @property
    def before(self) -> Signal:
        """Value of a state at the previous sample."""
        return Signal(self.name + BEFORE)

    @property
    def at_first(self) -> ShiftedSignal:
        """Number that equals, at every instant, the value of the signal at the first sample."""
        return ShiftedSignal(self.name, -_LONG, clamped=True)


@dataclass(frozen=True, slots=True)
class ShiftedSignal(Num):
    """Value of a signal `steps` samples later (negative: earlier).

    Outside the trace, the value is undefined, and so is every predicate that reads it. A `clamped` signal has
    a value there: that of its first or last sample.
    """

    name: str
    steps: int
    clamped: bool = False


@dataclass(frozen=True, slots=True)
class FrozenVar(Num):
    """Value that an enclosing `Freeze` has stored under this name, which is unique in the specification."""

    name: str

    def substitute_frozen(self, values: Mapping[str, Num]) -> Num:  # type: ignore[override]
        """Return the replacement of the value, or the value itself if there is none."""
        return values.get(self.name, self)


@dataclass(frozen=True, slots=True)
class Op(Num):
    """Application of a function in `stlc.compile.ir.functions.FUNCTIONS`, e.g. `add`, `clip`, `norm`."""

    name: str
    args: tuple[Num, ...]


@dataclass(frozen=True, slots=True)
class Indicator(Num):
    """Number that is 1 where a state formula holds, else 0.

    In training, the number is smoothed to `(1 + tanh(w rho)) / 2` (Meng and Fan 2023, Eq. 6). Here rho is the
    margin of the formula, and w is `sharpness`. If `sharpness` is None, w has the default value of the
    evaluator (`stlc.compile.semantics.switch`).
    """

    cond: Formula
    sharpness: float | None = None


@dataclass(frozen=True, slots=True)
class Where(Num):
    """Number that is `yes` where a state formula holds, else `no`."""

    cond: Formula
    yes: Num
    no: Num


@dataclass(frozen=True, slots=True)
class Extern(Num):
    """One component of the result of a function that the system provides.

    `output` is the index of the component. `function` is a callable that maps arrays to all components, or
    the body of the function in the IR; None if the function is not loaded.
    """

    name: str
    args: tuple[Num, ...]
    output: int = 0
    function: Callable[..., Sequence[Any]] | Body | None = field(default=None, repr=False)

    @property
    def opaque(self) -> bool:
        """True if there is no body, only Python code or nothing."""
        return not isinstance(self.function, Body)


@dataclass(frozen=True, slots=True)
class Body(Node):
    """Body of a function as straight-line code.

    Attributes:
        formals: names of the arguments, one per component.
        lets: (name, number) of each local value, in order; a number may read the arguments and earlier local
            values.
        outputs: components of the result.
    """

    formals: tuple[str, ...]
    lets: tuple[tuple[str, Num], ...]
    outputs: tuple[Num, ...]

    def calls_of(self, name: str, args: tuple[Num, ...]) -> tuple[Extern, ...]:
        """Return the components of the function, which is called `name`, of the given arguments."""
        return tuple(Extern(name, args, index, self) for index in range(len(self.outputs)))


NumberLeaf: TypeAlias = Const | Signal | ShiftedSignal | FrozenVar
"""Numbers without parts."""

ELAPSED = "#elapsed"
"""Name of the signal that every evaluator provides: the index of the current sample."""

BEFORE = "#before"
"""Suffix of the name of a state: with it, the name stands for the value at the previous sample."""

_LONG = 1 << 30


# --------------------------------------------------------------------- formulas


class Formula(Node, FormulaTree["Formula"]):
    """Base of formulas; `&` and `|` join two."""

    __slots__ = ()
    span: Span | None

    def __and__(self, other: Formula) -> BoolOp:
        return BoolOp("and", (self, other))

    def __or__(self, other: Formula) -> BoolOp:
        return BoolOp("or", (self, other))

    @property
    def negated(self) -> Formula:
        """Negation of a state formula; raises TypeError for others."""
        raise TypeError(f"not a state formula: {self!r}")

    @property
    def constant(self) -> bool | None:
        """Value of the formula `true` or `false`; None for others."""
        return None

    @property
    def windowed(self) -> Windowed | None:
        """The formula itself if it is an operator with a window."""
        return None

    @property
    def unbounded(self) -> Windowed | None:
        """The formula itself if it is an operator whose window extends to the end of the trace."""
        node = self.windowed
        return node if node is not None and node.window.hi is None and not node.back else None

    @property
    def from_first(self) -> Formula:
        """Formula that has the same value at the first sample: the operand of an `AtStart`, else itself."""
        return self

    def select(self, yes: Num | float, no: Num | float) -> Where:
        """Return the number that is `yes` where the formula holds, a state formula, else `no`."""
        return Where(self, _number(yes), _number(no))

    def indicator(self, sharpness: float | None = None) -> Indicator:
        """Return the number that is 1 where the formula holds, a state formula, else 0."""
        return Indicator(self, sharpness)

    def predicates(self) -> Iterator[Predicate]:
        """Yield the predicates in the formula."""
        return (node for node in self.walk() if isinstance(node, Predicate))

    def windows(self) -> Iterator[Windowed]:
        """Yield the operators with a window in the formula."""
        return (node for node in self.walk() if isinstance(node, Windowed))

    def terms(self, op: Literal["and", "or"]) -> Iterator[Formula]:
        """Yield the formulas that nested operators `op` join; the formula itself for another formula."""
        if isinstance(self, BoolOp) and self.op == op:
            for item in self.items:
                yield from item.terms(op)
        else:
            yield self

    def map_terms(self, change: Callable[[Formula], Formula]) -> Formula:
        """Return the formula with each formula that `and` and `or` join replaced, simplified."""
        if isinstance(self, BoolOp):
            return BoolOp.joined(self.op, (item.map_terms(change) for item in self.items), self.span)
        return change(self)

    @property
    def pieces(self) -> list[Formula]:
        """Conjuncts: `always (a and b) and c` gives `always a`, `always b` and `c`."""
        match self:
            case BoolOp("and", items):
                return [piece for item in items for piece in item.pieces]
            case Temporal("always", _, body):
                return [replace(self, body=piece) for piece in body.pieces]
            case _:
                return [self]

    @property
    def demands(self) -> list[tuple[int, Formula]]:
        """Formulas that the formula demands at all samples, each with the first of these samples.

        There are none unless it is `always p`, or several of these.
        """
        match self:
            case Temporal("always", Window(first, None), body):
                return [(first, body)]
            case BoolOp("and", items):
                each = [item.demands for item in items]
                return [demand for demands in each for demand in demands] if all(each) else []
            case _:
                return []

    def fold(self, analysis: Analysis[V]) -> V:
        """Return the value that an analysis computes for the formula, from the leaves upwards."""
        raise NotImplementedError

    @property
    def reach(self) -> Reach:
        """Samples before and after now that the formula requires (lookback and lookahead).

        A window to the end of the trace requires only its first sample. The interval of an operator such as
        `always@[a, b]` counts from the first sample of the trace, wherever the operator stands; the end of
        the interval counts as lookahead.
        """
        past, future, clocked = self.fold(REQUIRED)
        return Reach(past, max(future, clocked))

    @property
    def own_reach(self) -> Reach:
        """Samples before and after an instant that the formula reads, without what its operands read.

        An unbounded window `[a, inf)` counts as `a` samples.
        """
        reads = [Reach(0, 0), *(num.farthest for num in self.own_numbers)]
        past, future = (max(ends) for ends in zip(*reads, strict=True))
        steps = self.steps if isinstance(self, Shift) else 0
        if node := self.windowed:
            width = node.window.lo if node.window.hi is None else node.window.hi
            steps = -width if node.back else width
        return Reach(past + max(-steps, 0), future + max(steps, 0))

    @property
    def history(self) -> int:
        """Number of samples before now that the formula reads; 2^40 stands for all earlier samples.

        Unlike in `reach`, past windows count in full, although they are cut at the start of the trace.
        """
        return self.fold(HISTORY)

    @property
    def earliest(self) -> tuple[int, int]:
        """Latest of the first samples of all future windows: after now, and after the first sample.

        If the trace ends before that sample, some operand of the formula has no value, wherever windows are
        cut. The second number is that of operators such as `always@[a, b]`.
        """
        return self.fold(EARLIEST)

    def tail(self, samples: int, length: int) -> int | None:
        """Return an instant from which on the robustness of the formula is constant on an open trace.

        `support.Tail` describes the arguments. The instant is counted in samples from the start of the trace;
        it is None if no such instant is known.
        """
        return self.fold(Tail(samples, length))

    @property
    def endless(self) -> bool:
        """True if the formula has a window to the end of the trace."""
        return any(node.unbounded for node in self.walk())

    @property
    def uses_end(self) -> bool:
        """True if the formula depends on where the trace ends.

        There are two cases. A window of the formula may extend to the end of the trace. Or a number may read
        a signal after the last sample, where the last sample is repeated; `sweep`, which reads the next
        sample, is rewritten to such numbers.
        """
        shifts = (leaf for num in self.numbers() for leaf in num.leaves() if isinstance(leaf, ShiftedSignal))
        return self.endless or any(leaf.clamped and leaf.steps > 0 for leaf in shifts)


class Operator(Formula):
    """Base of formulas whose value follows from the values of their operands at instants relative to now.

    Attributes:
        names: names of two dual operators. The first takes the minimum (over its window), the second the
            maximum.
    """

    __slots__ = ()
    names: ClassVar[tuple[str, ...]] = ()

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets at which the operands are read, relative to now: one entry per operand, in field order.

        The last operand is read over the window; if the window is empty, no operand is read.
        """
        raise NotImplementedError

    def fold(self, analysis: Analysis[V]) -> V:
        """Return the value that an analysis computes for the operator from those of its operands."""
        return analysis.over([part.fold(analysis) for part in self.operands], self.offsets)


@dataclass(frozen=True, slots=True)
class Window:
    """Window of a temporal operator, from `lo` to `hi` steps from now, both included.

    For past operators, the steps are counted backwards. If `hi` is None, the window extends to the end of the
    trace (for past operators, to its start).
    """

    lo: int
    hi: int | None


class Windowed(Operator):
    """Base of operators with a window, over which the last operand is read.

    Attributes:
        back: whether the window lies in the past; such a window is cut at the start of the trace.
    """

    __slots__ = ()
    op: str
    window: Window
    back: ClassVar[bool] = False

    @property
    def windowed(self) -> Self:
        """The operator itself."""
        return self

    def with_window(self, lo: int, hi: int | None) -> Self:
        """Return the operator with the window from `lo` to `hi`."""
        node: Any = self
        changed: Self = replace(node, window=Window(lo, hi))
        return changed

    @property
    def window_offsets(self) -> Offsets:
        """Window of the operator as offsets from now, which are negative for a window in the past."""
        lo, hi = self.window.lo, self.window.hi
        return Offsets(None if hi is None else -hi, -lo) if self.back else Offsets(lo, hi)

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets at which the operand of a temporal operator is read: those of the window."""
        return (self.window_offsets,)


@dataclass(frozen=True, slots=True)
class Truth(Formula):
    """Formula `true` or `false`, with robustness +inf or -inf.

    `stlc.compile.ir.simplify` removes such constants where they are operands of other operators.
    """

    value: bool
    span: Span | None = field(default=None, compare=False, repr=False)

    @property
    def constant(self) -> bool:
        """The value."""
        return self.value

    @property
    def negated(self) -> Truth:
        """The other constant."""
        return replace(self, value=not self.value)

    def fold(self, analysis: Analysis[V]) -> V:
        """Return the value that an analysis computes for a constant."""
        return analysis.constant()


@dataclass(frozen=True, slots=True)
class Predicate(Formula):
    """Predicate with robustness `sign * num`; true iff the robustness is > 0 (`strict`) or >= 0.

    Negation flips `sign` and `strict`, and leaves `num` as it is. A `guard` is a predicate on clocks and
    timers, states that the compiler adds to count time. The robustness of a guard is +inf or -inf, so the
    guard decides whether an enclosing formula holds, but not by how much.
    """

    num: Num
    sign: Literal[1, -1] = 1
    strict: bool = False
    guard: bool = False
    span: Span | None = field(default=None, compare=False, repr=False)

    @property
    def negated(self) -> Predicate:
        """Predicate with the other sign."""
        return replace(self, sign=-1 if self.sign > 0 else 1, strict=not self.strict)

    @property
    def threshold(self) -> tuple[str, float] | None:
        """(signal, value) if a signal is compared with a constant."""
        match self.num:
            case Op("sub", (Signal(name), Const(value)) | (Const(value), Signal(name))):
                return name, value
            case _:
                return None

    def fold(self, analysis: Analysis[V]) -> V:
        """Return the value that an analysis computes for the predicate."""
        return analysis.predicate(self.num)


@dataclass(frozen=True, slots=True)
class BoolOp(Operator):
    """Conjunction (`and`, minimum) or disjunction (`or`, maximum) of at least two formulas."""

    names: ClassVar = ("and", "or")
    op: Literal["and", "or"]
    items: tuple[Formula, ...]
    span: Span | None = field(default=None, compare=False, repr=False)

    @classmethod
    def joined(cls, op: Literal["and", "or"], items: Iterable[Formula], span: Span | None = None) -> Formula:
        """Return the `and` or `or` of formulas, simplified where a formula is a constant.

        A constant that does not change the result is removed; a constant that decides the result is returned.
        """
        kept: list[Formula] = []
        for item in items:
            if item.constant is None:
                kept.append(item)
            elif item.constant is not (op == "and"):
                return Truth(item.constant, span)
        if len(kept) < 2:
            return kept[0] if kept else Truth(op == "and", span)
        return cls(op, tuple(kept), span)

    @property
    def negated(self) -> BoolOp:
        """The dual operator over the negated items."""
        return replace(self, op=DUAL[self.op], items=tuple(item.negated for item in self.items))

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets at which the operands of `and` or `or` are read: each is read at the present sample."""
        return (NOW,) * len(self.items)


@dataclass(frozen=True, slots=True)
class Temporal(Windowed):
    """`always` (minimum) or `eventually` (maximum) over a window of the future."""

    names: ClassVar = ("always", "eventually")
    op: Literal["always", "eventually"]
    window: Window
    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class PastTemporal(Windowed):
    """`historically` (minimum) or `once` (maximum) over a past window, cut at the start of the trace."""

    names: ClassVar = ("historically", "once")
    back: ClassVar = True
    op: Literal["historically", "once"]
    window: Window
    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Until(Windowed):
    """Until: sup over t' in the window of min(right(t'), inf over [t, t'] of left).

    The dual of `until` is `release`.
    """

    names: ClassVar = ("release", "until")
    op: Literal["until", "release"]
    window: Window
    left: Formula
    right: Formula
    span: Span | None = field(default=None, compare=False, repr=False)

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets at which the operands of `until` or `release` are read.

        `left` is read from now to the end of the window, `right` over the window.
        """
        return Offsets(0, self.window.hi), self.window_offsets


@dataclass(frozen=True, slots=True)
class Since(Windowed):
    """Since: sup over t' in the past window of min(right(t'), inf over [t', t] of left).

    The dual of `since` is `trigger`.
    """

    names: ClassVar = ("trigger", "since")
    back: ClassVar = True
    op: Literal["since", "trigger"]
    window: Window
    left: Formula
    right: Formula
    span: Span | None = field(default=None, compare=False, repr=False)

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets at which the operands of `since` or `trigger` are read.

        `left` is read from the far end of the window to now, `right` over the window.
        """
        return Offsets(self.window_offsets.first, 0), self.window_offsets


@dataclass(frozen=True, slots=True)
class Shift(Operator):
    """Value of `body` `steps` samples later (negative: earlier).

    Attributes:
        steps: number of samples.
        body: formula.
        outside: truth of the node where that sample lies outside the trace. None leaves it undefined there,
            like a window that leaves the trace. `rise` and `fall` are rewritten with False: they never hold
            at the first sample.
        span: source location.
        weak: whether the node results from a negation. Where windows are cut at the end of the trace
            (`truncate`), an undefined value counts as true if `weak` is True, and as false if it is False.
    """

    steps: int
    body: Formula
    outside: bool | None = None
    span: Span | None = field(default=None, compare=False, repr=False)
    weak: bool = False

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offset at which the operand is read: the single instant `steps` samples later."""
        return (Offsets(self.steps, self.steps),)

    def fold(self, analysis: Analysis[V]) -> V:
        """Return the value that an analysis computes for the formula from that of its operand."""
        return analysis.shift(self.body.fold(analysis), self)


@dataclass(frozen=True, slots=True)
class Freeze(Formula):
    """`freeze p0 = p in body`: in `body`, `p0` is the value of `p` at the instant of the `freeze` itself.

    This value is the same at all instants at which `body` is evaluated. If the value is undefined, the
    predicates that read `p0` are undefined too.

    Attributes:
        bindings: pairs (p0, p) of a name and an expression. In `body`, `FrozenVar` refers to the name.
        body: formula that reads the names.
        span: source location.
    """

    bindings: tuple[tuple[str, Num], ...]
    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)

    def fold(self, analysis: Analysis[V]) -> V:
        """Return the value that an analysis computes for the formula, from the bound numbers and the body."""
        bound = [analysis.predicate(num) for _, num in self.bindings]
        return analysis.freeze(bound, self.body.fold(analysis))


@dataclass(frozen=True, slots=True)
class AtStart(Formula):
    """Value of `body` at the first sample.

    The node is used for operators such as `always@[a, b]`, whose interval counts from the start of the
    mission.
    """

    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)

    @property
    def from_first(self) -> Formula:
        """The operand."""
        return self.body

    def fold(self, analysis: Analysis[V]) -> V:
        """Return the value that an analysis computes for the formula from that of its operand."""
        return analysis.at_start(self.body.fold(analysis))


OPERATORS: Mapping[str, Any] = MappingProxyType(
    {
        name: kind
        for kind in tuple(globals().values())
        if isinstance(kind, type) and issubclass(kind, Operator)
        for name in kind.names
    }
)
"""Name of an operator -> class of its node."""

DUAL: Mapping[str, Any] = MappingProxyType(
    {name: dual for kind in OPERATORS.values() for name, dual in (kind.names, kind.names[::-1])}
)
"""Name of an operator -> name of its dual, which a negation turns it into."""
