"""Intermediate representation (IR): numbers, and formulas in negation normal form with time in steps.

The evaluators, the dynamics and all back ends read it. Nodes are immutable and compare by structure, so
common sub-expressions are found by equality.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

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


@dataclass(frozen=True, slots=True)
class Window:
    """Window of steps lo..hi, both included, relative to now; `hi` None: to the end of the trace.

    For past operators the steps count backwards.
    """

    lo: int
    hi: int | None


@dataclass(frozen=True, slots=True)
class Truth:
    """Truth constant: robustness +inf or -inf. Folded before evaluation."""

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
class BoolOp:
    """min (`and`) or max (`or`) of at least two formulas."""

    op: Literal["and", "or"]
    items: tuple[Formula, ...]
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Temporal:
    """min (`always`) or max (`eventually`) over a window of the future."""

    op: Literal["always", "eventually"]
    window: Window
    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class PastTemporal:
    """min (`historically`) or max (`once`) over a window of the past, cut at the start of the trace."""

    op: Literal["historically", "once"]
    window: Window
    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Until:
    """sup over t' in the window of min(right(t'), inf over [t, t'] of left); `release` is its dual."""

    op: Literal["until", "release"]
    window: Window
    left: Formula
    right: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Since:
    """Mirror of `Until` in the past, with `left` required at both ends; `trigger` is its dual."""

    op: Literal["since", "trigger"]
    window: Window
    left: Formula
    right: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Shift:
    """Value `steps` later (negative: earlier).

    `outside` is the value beyond the ends of the trace: None is undefined, as for windows; False is used by
    `rise` and `fall` at the first sample. Where windows are cut, an undefined value is false, or true for a
    `weak` node, the negation of a strong one.
    """

    steps: int
    body: Formula
    outside: bool | None = None
    span: Span | None = field(default=None, compare=False, repr=False)
    weak: bool = False


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
    """Value at the first sample, at any instant: for operators on the mission clock."""

    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


Formula: TypeAlias = (
    Truth | Predicate | BoolOp | Temporal | PastTemporal | Until | Since | Shift | Freeze | AtStart
)
