"""The one intermediate representation: numbers, and formulas in negation normal form and whole steps.

Everything that computes reads it: the NumPy and torch evaluators, the dynamics, later the C emitter.
Nodes are immutable and compare by structure, so a common sub-expression is found by equality.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from stlc.source import Span

# ---------------------------------------------------------------------- numbers


@dataclass(frozen=True, slots=True)
class Const:
    """A constant, in SI units."""

    value: float


@dataclass(frozen=True, slots=True)
class Signal:
    """An entry of the environment: a state, a control, `t`, or a value drawn earlier."""

    name: str


@dataclass(frozen=True, slots=True)
class ShiftedSignal:
    """A column `steps` samples later (negative: earlier).

    Outside the trace it is undefined, and so is a predicate that reads it; a `clamped` one reads the first or
    the last sample instead.
    """

    name: str
    steps: int
    clamped: bool = False


@dataclass(frozen=True, slots=True)
class FrozenVar:
    """A value that a `Freeze` around binds; its name is unique among those."""

    name: str


@dataclass(frozen=True, slots=True)
class Op:
    """A function of the table `stlc.compile.ir.functions.FUNCTIONS`, e.g. `add`, `clip`, `norm`."""

    name: str
    args: tuple[Num, ...]


@dataclass(frozen=True, slots=True)
class Indicator:
    """1 where a state formula holds, else 0; `stlc.compile.semantics.switch` says how in training.

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

    `function` takes the arguments as arrays and gives all components, or says in the IR what they are; None
    where nobody loaded it.
    """

    name: str
    args: tuple[Num, ...]
    output: int = 0
    function: Callable[..., Sequence[Any]] | Body | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True)
class Body:
    """Body of a function: straight-line code.

    Attributes:
        formals: columns that stand for its arguments, component by component.
        lets: (name, number), in order; each reads arguments and earlier ones.
        outputs: the components of the result.
    """

    formals: tuple[str, ...]
    lets: tuple[tuple[str, Num], ...]
    outputs: tuple[Num, ...]


Num: TypeAlias = Const | Signal | ShiftedSignal | FrozenVar | Op | Indicator | Where | Extern

ELAPSED = "#elapsed"
"""The column that every evaluator knows by itself: how many samples came before the one at hand."""

_LONG = 1 << 30


def at_first(column: Signal) -> ShiftedSignal:
    """Value of a signal at the first sample, wherever it is read."""
    return ShiftedSignal(column.name, -_LONG, clamped=True)


# --------------------------------------------------------------------- formulas


@dataclass(frozen=True, slots=True)
class Window:
    """Steps lo..hi, both ends included, relative to now; `hi` None: to the end of the trace.

    For past operators the steps count backwards.
    """

    lo: int
    hi: int | None


@dataclass(frozen=True, slots=True)
class Truth:
    """A constant: robustness +inf or -inf. Folded away before a graph is built."""

    value: bool
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Predicate:
    """A predicate: robustness `sign * num`; true iff that is > 0 (`strict`) or >= 0.

    Negation sinks into `sign` (and flips `strict`), so `num` is evaluated as it was written.
    A `guard` is a time test: it decides truth and never limits the margin (robustness +-inf).
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
    """The mirror of `Until` in the past, `left` required at both ends; `trigger` is its dual."""

    op: Literal["since", "trigger"]
    window: Window
    left: Formula
    right: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Shift:
    """The value `steps` later (negative: earlier).

    `outside` says what stands beyond the ends of the trace: None leaves it undefined like any window;
    False is what `rise` and `fall` need at the first sample. Where windows are cut to the trace an undefined
    value is false, or true for a `weak` one, which is what the negation of the other kind is.
    """

    steps: int
    body: Formula
    outside: bool | None = None
    span: Span | None = field(default=None, compare=False, repr=False)
    weak: bool = False


@dataclass(frozen=True, slots=True)
class Freeze:
    """`body` now, where each `FrozenVar` name stands for its number's value of now, whenever it is read.

    Where a number is undefined, so are the predicates that read its name.
    """

    bindings: tuple[tuple[str, Num], ...]
    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class AtStart:
    """The value at the first sample, whenever it is asked for: what is on the mission clock."""

    body: Formula
    span: Span | None = field(default=None, compare=False, repr=False)


Formula: TypeAlias = (
    Truth | Predicate | BoolOp | Temporal | PastTemporal | Until | Since | Shift | Freeze | AtStart
)
