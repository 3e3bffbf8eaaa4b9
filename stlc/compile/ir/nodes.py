"""Intermediate representation (IR): numbers, and formulas in negation normal form with time in steps.

The evaluators, the dynamics and all back ends read it. Nodes are immutable and compare by structure, so
common sub-expressions are found by equality.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias, get_args

from stlc.source import Span

# ---------------------------------------------------------------------- numbers


@dataclass(frozen=True, slots=True)
class Const:
    """Constant in SI units."""

    value: float


@dataclass(frozen=True, slots=True)
class Signal:
    """Column of the environment: a state, a control, `t`, or a sampled value."""

    name: str


@dataclass(frozen=True, slots=True)
class ShiftedSignal:
    """A column `steps` samples later (negative: earlier).

    Undefined outside the trace, as is a predicate that reads it; a `clamped` one repeats the first or last
    sample.
    """

    name: str
    steps: int
    clamped: bool = False


@dataclass(frozen=True, slots=True)
class FrozenVar:
    """Value bound by an enclosing `Freeze`, under a unique name."""

    name: str


@dataclass(frozen=True, slots=True)
class Op:
    """Application of a function in `stlc.compile.ir.functions.FUNCTIONS`, e.g. `add`, `clip`, `norm`."""

    name: str
    args: tuple[Num, ...]


@dataclass(frozen=True, slots=True)
class Indicator:
    """1 where a state formula holds, else 0; smoothed in training by `stlc.compile.semantics.switch`.

    `sharpness` is the paper's w (Eq. 6) for this indicator; None takes the default of the switch.
    """

    cond: Formula
    sharpness: float | None = None


@dataclass(frozen=True, slots=True)
class Where:
    """`yes` where a state formula holds, else `no`."""

    cond: Formula
    yes: Num
    no: Num


@dataclass(frozen=True, slots=True)
class Extern:
    """Component `output` of a function that the system provides.

    `function` maps arrays to all components, or is their body in the IR; None if not loaded.
    """

    name: str
    args: tuple[Num, ...]
    output: int = 0
    function: Callable[..., Sequence[Any]] | Body | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True)
class Body:
    """Body of a function as straight-line code.

    Attributes:
        formals: columns of the arguments, component by component.
        lets: (name, number), in order; each may read arguments and earlier ones.
        outputs: components of the result.
    """

    formals: tuple[str, ...]
    lets: tuple[tuple[str, Num], ...]
    outputs: tuple[Num, ...]


Num: TypeAlias = Const | Signal | ShiftedSignal | FrozenVar | Op | Indicator | Where | Extern

ELAPSED = "#elapsed"
"""Column that every evaluator provides: index of the current sample."""

_LONG = 1 << 30


def at_first(column: Signal) -> ShiftedSignal:
    """Return the value of a signal at the first sample, at any instant."""
    return ShiftedSignal(column.name, -_LONG, clamped=True)


# --------------------------------------------------------------------- formulas


class Offsets(NamedTuple):
    """Instants relative to now, both ends included, at which an operator reads an operand.

    Attributes:
        first: least offset, negative in the past; None: from the start of the trace.
        last: greatest offset; None: to the end of the trace.
    """

    first: int | None
    last: int | None


NOW = Offsets(0, 0)


class Operator:
    """Base of formulas whose value follows from their operands at instants relative to now.

    Attributes:
        names: the operator that is a minimum (over its window), and its dual, a maximum.
    """

    __slots__ = ()
    names: ClassVar[tuple[str, ...]] = ()

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets of each operand, in field order; where the last operand has no instant, none is read."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class Window:
    """Window of steps lo..hi, both included, relative to now; `hi` None: to the end of the trace.

    For past operators the steps count backwards.
    """

    lo: int
    hi: int | None


class Windowed(Operator):
    """Base of operators with a window, over which the last operand is read.

    Attributes:
        back: the window lies in the past, cut at the start of the trace.
    """

    __slots__ = ()
    op: str
    window: Window
    back: ClassVar[bool] = False

    @property
    def window_offsets(self) -> Offsets:
        """The window as offsets."""
        lo, hi = self.window.lo, self.window.hi
        return Offsets(None if hi is None else -hi, -lo) if self.back else Offsets(lo, hi)

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets of the operand: the window."""
        return (self.window_offsets,)


@dataclass(frozen=True, slots=True)
class Truth:
    """Truth constant, with robustness +inf or -inf; `simplify` removes those in operators."""

    value: bool
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Predicate:
    """Predicate with robustness `sign * num`; true iff that is > 0 (`strict`) or >= 0.

    Negation flips `sign` and `strict`, so `num` is evaluated as written. A `guard` is a time test: it decides
    truth and never limits the margin (robustness +-inf).
    """

    num: Num
    sign: Literal[1, -1] = 1
    strict: bool = False
    guard: bool = False
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class BoolOp(Operator):
    """min (`and`) or max (`or`) of at least two formulas."""

    names: ClassVar = ("and", "or")
    op: Literal["and", "or"]
    items: tuple[Formula, ...]
    span: Span | None = field(default=None, compare=False, repr=False)

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets of each item: now."""
        return (NOW,) * len(self.items)


@dataclass(frozen=True, slots=True)
class Temporal(Windowed):
    """min (`always`) or max (`eventually`) over a window of the future."""

    names: ClassVar = ("always", "eventually")
    op: Literal["always", "eventually"]
    window: Window
    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class PastTemporal(Windowed):
    """min (`historically`) or max (`once`) over a window of the past, cut at the start of the trace."""

    names: ClassVar = ("historically", "once")
    back: ClassVar = True
    op: Literal["historically", "once"]
    window: Window
    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Until(Windowed):
    """sup over t' in the window of min(right(t'), inf over [t, t'] of left); `release` is its dual."""

    names: ClassVar = ("release", "until")
    op: Literal["until", "release"]
    window: Window
    left: Formula
    right: Formula
    span: Span | None = field(default=None, compare=False, repr=False)

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets of `left`, from now to the end of the window, and of `right`: the window."""
        return Offsets(0, self.window.hi), self.window_offsets


@dataclass(frozen=True, slots=True)
class Since(Windowed):
    """Mirror of `Until` in the past, with `left` required at both ends; `trigger` is its dual."""

    names: ClassVar = ("trigger", "since")
    back: ClassVar = True
    op: Literal["since", "trigger"]
    window: Window
    left: Formula
    right: Formula
    span: Span | None = field(default=None, compare=False, repr=False)

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets of `left`, from the far end of the window to now, and of `right`: the window."""
        return Offsets(self.window_offsets.first, 0), self.window_offsets


@dataclass(frozen=True, slots=True)
class Shift(Operator):
    """Value of `body` `steps` samples later (negative: earlier).

    `outside` is the value beyond the ends of the trace: None is undefined, as for windows; False is used by
    `rise` and `fall` at the first sample. Where windows are cut, an undefined value is false, or true for a
    `weak` node, the negation of a strong one.
    """

    steps: int
    body: Formula
    outside: bool | None = None
    span: Span | None = field(default=None, compare=False, repr=False)
    weak: bool = False

    @property
    def offsets(self) -> tuple[Offsets, ...]:
        """Offsets of the operand: one instant."""
        return (Offsets(self.steps, self.steps),)


@dataclass(frozen=True, slots=True)
class Freeze:
    """`body` with each bound `FrozenVar` equal to the value of its number now, at any instant of `body`.

    Where a bound number is undefined, so are the predicates that read it.
    """

    bindings: tuple[tuple[str, Num], ...]
    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class AtStart:
    """Value of `body` at the first sample, for operators on the mission clock."""

    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


Formula: TypeAlias = (
    Truth | Predicate | BoolOp | Temporal | PastTemporal | Until | Since | Shift | Freeze | AtStart
)

OPERATORS: Mapping[str, Any] = MappingProxyType(
    {name: kind for kind in get_args(Formula) if issubclass(kind, Operator) for name in kind.names}
)
"""Name of an operator -> its node."""

DUAL: Mapping[str, Any] = MappingProxyType(
    {name: dual for kind in OPERATORS.values() for name, dual in (kind.names, kind.names[::-1])}
)
"""Operator -> the operator of its negation."""
