"""What is computed of formulas, as steps over buffers: the form between the IR and C."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from stlc.compile.backends.c.families import Table
from stlc.compile.backends.c.index import Stretch
from stlc.compile.ir import nodes as ir

Pick: TypeAlias = Literal["MIN", "MAX"]

PICKS: Mapping[str, Pick] = {
    **dict.fromkeys(("and", "always", "historically", "release", "trigger"), "MIN"),
    **dict.fromkeys(("or", "eventually", "once", "until", "since"), "MAX"),
}


@dataclass(frozen=True, slots=True)
class Buffer:
    """The values of a sub-formula at consecutive instants, `LANES` trajectories each.

    Attributes:
        name: of the C array.
        origin: the instant of its first row.
        rows: instants that there is room for.
        place: doubles per lane that stand before it in the room.
    """

    name: str
    origin: int
    rows: int
    place: int

    def __getitem__(self, instant: str) -> str:
        """C expression of the value at an instant, of lane `j`."""
        offset = f" - {self.origin}" if self.origin > 0 else f" + {-self.origin}" if self.origin else ""
        return f"{self.name}[{instant}{offset}][j]"


@dataclass(frozen=True, slots=True)
class Fill:
    """One number at all instants."""

    out: Buffer
    run: Stretch
    value: float


@dataclass(frozen=True, slots=True)
class Margin:
    """A predicate; `held` says where the frozen values stand that it reads."""

    out: Buffer
    run: Stretch
    atom: ir.Predicate
    held: Mapping[str, Buffer]


@dataclass(frozen=True, slots=True)
class Joined:
    """The extremum of several buffers, instant by instant."""

    out: Buffer
    run: Stretch
    pick: Pick
    items: tuple[Buffer, ...]


@dataclass(frozen=True, slots=True)
class Extremum:
    """The extremum over a window, of the past where `back`."""

    out: Buffer
    run: Stretch
    pick: Pick
    window: ir.Window
    body: Buffer
    back: bool


@dataclass(frozen=True, slots=True)
class Meeting:
    """`until` for `pick` MAX, `release` for MIN; `since` and `trigger` where `back`."""

    out: Buffer
    run: Stretch
    pick: Pick
    window: ir.Window
    left: Buffer
    right: Buffer
    back: bool


@dataclass(frozen=True, slots=True)
class Moved:
    """A buffer `steps` later, a number where that is outside of the plan; None: it never is."""

    out: Buffer
    run: Stretch
    body: Buffer | None
    steps: int
    outside: float


@dataclass(frozen=True, slots=True)
class Repeated:
    """The value of the first sample at all instants."""

    out: Buffer
    run: Stretch
    body: Buffer


@dataclass(frozen=True, slots=True)
class Called:
    """All components of a function of columns, at all samples."""

    outs: tuple[Buffer, ...]
    run: Stretch
    function: ir.Extern


@dataclass(frozen=True, slots=True)
class Frozen:
    """For every instant of `run`, with its numbers frozen, the steps and then the value of `body` there.

    Attributes:
        out: what it gives.
        run: its instants.
        index: C name of the instant.
        bindings: the numbers that are frozen, and the buffers of one row that take them.
        held: where the frozen values stand that these numbers read.
        steps: with buffers of their own, filled anew at every instant.
        own: these buffers, and those of the bindings.
        body: where the value stands.
    """

    out: Buffer
    run: Stretch
    index: str
    bindings: tuple[tuple[Buffer, ir.Num], ...]
    held: Mapping[str, Buffer]
    steps: tuple[Step, ...]
    own: tuple[Buffer, ...]
    body: Buffer


@dataclass(frozen=True, slots=True)
class Tabled:
    """For every row of a table the steps, and then the value of `body`.

    Attributes:
        out: the extremum of all rows, instant by instant; where `pick` is None the first value of each row.
        run: the instants of `body`.
        pick: which extremum.
        index: C name of the row.
        table: what differs from row to row.
        steps: with buffers of their own, filled anew for every row.
        own: these buffers.
        body: where the value stands.
    """

    out: Buffer
    run: Stretch
    pick: Pick | None
    index: str
    table: Table
    steps: tuple[Step, ...]
    own: tuple[Buffer, ...]
    body: Buffer


@dataclass(frozen=True, slots=True)
class Place:
    """Where one value stands: a row of a buffer."""

    buffer: Buffer
    row: int


Step: TypeAlias = Fill | Margin | Joined | Extremum | Meeting | Moved | Repeated | Called | Frozen | Tabled
CallKey: TypeAlias = tuple[str, tuple[ir.Signal, ...]]


@dataclass(frozen=True, slots=True)
class Plan:
    """What to compute, in order.

    Attributes:
        samples: of a trajectory, T + 1.
        steps: parts first.
        roots: where the robustness of each formula stands.
        buffers: all of them.
        size: doubles that they take per lane.
        calls: functions of columns that are computed once -> their components.
    """

    samples: int
    steps: tuple[Step, ...]
    roots: tuple[Place, ...]
    buffers: tuple[Buffer, ...]
    size: int
    calls: Mapping[CallKey, tuple[Buffer, ...]]


def call_of(num: ir.Num) -> CallKey | None:
    """Under which key a number is a call whose components are computed once, at all samples."""
    if not isinstance(num, ir.Extern) or not isinstance(num.function, ir.Body):
        return None
    leaves = [arg for arg in num.args if isinstance(arg, (ir.Signal, ir.ShiftedSignal))]
    if len(leaves) < len(num.args) or len({_moved(leaf) for leaf in leaves}) > 1:
        return None
    return num.name, tuple(ir.Signal(leaf.name) for leaf in leaves)


def _moved(leaf: ir.Signal | ir.ShiftedSignal) -> tuple[int, bool]:
    return (leaf.steps, leaf.clamped) if isinstance(leaf, ir.ShiftedSignal) else (0, False)
