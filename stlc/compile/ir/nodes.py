"""Intermediate representation (IR): numbers, and formulas in negation normal form with time in steps.

The evaluators, the dynamics and all back ends read the IR. Nodes are immutable and compare by structure, so
common sub-expressions are found by equality.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias, get_args

from stlc.source import Span


class Node:
    """Base of numbers and formulas. The hash of a node, which is that of its whole tree, is computed once."""

    __slots__ = ("_hash",)
    _hash: int

    def __init_subclass__(cls) -> None:
        cls.__hash__ = Node.__hash__  # type: ignore[method-assign] # else `dataclass` would make one

    def __hash__(self) -> int:
        try:
            return self._hash
        except AttributeError:
            found = hash(tuple(getattr(self, part.name) for part in fields(self) if part.compare))  # type: ignore[arg-type]
            object.__setattr__(self, "_hash", found)
            return found


# ---------------------------------------------------------------------- numbers


@dataclass(frozen=True, slots=True)
class Const(Node):
    """Constant in SI units."""

    value: float


@dataclass(frozen=True, slots=True)
class Signal(Node):
    """Value of a signal at the current sample: a state, a control, the time `t`, or a recorded signal."""

    name: str


@dataclass(frozen=True, slots=True)
class ShiftedSignal(Node):
    """Value of a signal `steps` samples later (negative: earlier).

    Outside the trace, the value is undefined, and so is every predicate that reads it. A `clamped` signal has
    a value there: that of its first or last sample.
    """

    name: str
    steps: int
    clamped: bool = False


@dataclass(frozen=True, slots=True)
class FrozenVar(Node):
    """Value that an enclosing `Freeze` has stored under this name, which is unique in the specification."""

    name: str


@dataclass(frozen=True, slots=True)
class Op(Node):
    """Application of a function in `stlc.compile.ir.functions.FUNCTIONS`, e.g. `add`, `clip`, `norm`."""

    name: str
    args: tuple[Num, ...]


@dataclass(frozen=True, slots=True)
class Indicator(Node):
    """Number that is 1 where a state formula holds, else 0.

    In training, the number is smoothed to `(1 + tanh(w rho)) / 2` (Meng and Fan 2023, Eq. 6). Here rho is the
    margin of the formula, and w is `sharpness`. If `sharpness` is None, w has the default value of the
    evaluator (`stlc.compile.semantics.switch`).
    """

    cond: Formula
    sharpness: float | None = None


@dataclass(frozen=True, slots=True)
class Where(Node):
    """Number that is `yes` where a state formula holds, else `no`."""

    cond: Formula
    yes: Num
    no: Num


@dataclass(frozen=True, slots=True)
class Extern(Node):
    """One component of the result of a function that the system provides.

    `output` is the index of the component. `function` is a callable that maps arrays to all components, or
    the body of the function in the IR; None if the function is not loaded.
    """

    name: str
    args: tuple[Num, ...]
    output: int = 0
    function: Callable[..., Sequence[Any]] | Body | None = field(default=None, repr=False)


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


Num: TypeAlias = Const | Signal | ShiftedSignal | FrozenVar | Op | Indicator | Where | Extern

ELAPSED = "#elapsed"
"""Name of the signal that every evaluator provides: the index of the current sample."""

BEFORE = "#before"
"""Suffix of the name of a state: with it, the name stands for the value at the previous sample."""

_LONG = 1 << 30


def at_first(column: Signal) -> ShiftedSignal:
    """Return the number that equals, at every instant, the value of `column` at the first sample."""
    return ShiftedSignal(column.name, -_LONG, clamped=True)


# --------------------------------------------------------------------- formulas


class Offsets(NamedTuple):
    """Instants at which an operator reads an operand, in samples relative to now; both ends are included.

    Attributes:
        first: least offset, negative in the past; None if the operand is read from the start of the trace on.
        last: greatest offset; None if the operand is read up to the end of the trace.
    """

    first: int | None
    last: int | None


NOW = Offsets(0, 0)


class Operator(Node):
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
    def window_offsets(self) -> Offsets:
        """Window of the operator as offsets from now, which are negative for a window in the past."""
        lo, hi = self.window.lo, self.window.hi
        return Offsets(None if hi is None else -hi, -lo) if self.back else Offsets(lo, hi)

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets at which the operand of a temporal operator is read: those of the window."""
        return (self.window_offsets,)


@dataclass(frozen=True, slots=True)
class Truth(Node):
    """Formula `true` or `false`, with robustness +inf or -inf.

    `stlc.compile.ir.simplify` removes such constants where they are operands of other operators.
    """

    value: bool
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Predicate(Node):
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


@dataclass(frozen=True, slots=True)
class BoolOp(Operator):
    """Conjunction (`and`, minimum) or disjunction (`or`, maximum) of at least two formulas."""

    names: ClassVar = ("and", "or")
    op: Literal["and", "or"]
    items: tuple[Formula, ...]
    span: Span | None = field(default=None, compare=False, repr=False)

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


@dataclass(frozen=True, slots=True)
class Freeze(Node):
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


@dataclass(frozen=True, slots=True)
class AtStart(Node):
    """Value of `body` at the first sample.

    The node is used for operators such as `always@[a, b]`, whose interval counts from the start of the
    mission.
    """

    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


Formula: TypeAlias = (
    Truth | Predicate | BoolOp | Temporal | PastTemporal | Until | Since | Shift | Freeze | AtStart
)

OPERATORS: Mapping[str, Any] = MappingProxyType(
    {name: kind for kind in get_args(Formula) if issubclass(kind, Operator) for name in kind.names}
)
"""Name of an operator -> class of its node."""

DUAL: Mapping[str, Any] = MappingProxyType(
    {name: dual for kind in OPERATORS.values() for name, dual in (kind.names, kind.names[::-1])}
)
"""Name of an operator -> name of its dual, which a negation turns it into."""
