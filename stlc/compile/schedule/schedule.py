"""Schedule of the values that formulas need, by instant: from formulas and a trace length to ordered steps.

Only needed values are computed: a state predicate at the root at one instant, the body of `always[0, T]` at
T + 1. Equal sub-formulas at equal instants are one step. All back ends read the same steps and match on their
nodes. Instants are integers, or expressions in a loop index of the back end (`LoopIndex`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Reach, farthest, reach_of, tail
from stlc.compile.ir.traverse import operands as parts_of

Boundary: TypeAlias = Literal["strict", "truncate", "lower", "upper", "both"]
"""Treatment of instants beyond the last sample.

`strict`: they do not exist, needing one is an error. `truncate`: windows are cut. `lower` and `upper`: the
trace is open, with unknown predicates -inf or +inf; windows to the end of the trace still end at the last
known sample. `both` (NumPy, without `freeze`): two traces, the first with lower, the second with upper
bounds.
"""

Pick: TypeAlias = Literal["min", "max"]

PICKS: Mapping[str, Pick] = MappingProxyType(
    {name: "min" if name == kind.names[0] else "max" for name, kind in ir.OPERATORS.items()}
)
"""Operator -> its extremum (of `until`, `since` and their duals, that over the window)."""

_FAR = 256
"""Instants beyond the last sample up to which no test for a constant tail is made."""


def dual(pick: Pick) -> Pick:
    """Return the dual extremum."""
    return "max" if pick == "min" else "min"


def neutral(pick: Pick) -> float:
    """Return the extremum of no operands."""
    return math.inf if pick == "min" else -math.inf


# ------------------------------------------------------------------------------ instants


@dataclass(frozen=True, slots=True)
class LoopIndex:
    """Instant as a function of enclosing loop indices.

    Attributes:
        text: expression in the language of the back end.
        low: least value.
        high: greatest value.
    """

    text: str
    low: int
    high: int

    def __add__(self, steps: int) -> Instant:
        """Return the instant `steps` samples later."""
        if self.low == self.high:
            return self.low + steps
        if not steps:
            return self
        return LoopIndex(f"({self.text} + {steps})", self.low + steps, self.high + steps)

    def __sub__(self, steps: int) -> Instant:
        """Return the instant `steps` samples earlier."""
        return self + -steps

    def __str__(self) -> str:
        return self.text


Instant: TypeAlias = Any
"""An integer, or a `LoopIndex`."""


def earliest(instant: Instant) -> int:
    """Return the least value of an instant."""
    return instant.low if isinstance(instant, LoopIndex) else int(instant)


def latest(instant: Instant) -> int:
    """Return the greatest value of an instant."""
    return instant.high if isinstance(instant, LoopIndex) else int(instant)


def at_least(instant: Instant, least: int) -> Instant:
    """Return the later of an instant and `least`."""
    if isinstance(instant, int):
        return max(instant, least)
    if instant.low >= least:
        return instant
    later = LoopIndex(f"LATER({instant.text}, {least})", least, instant.high)
    return least if instant.high <= least else later


def at_most(instant: Instant, most: int) -> Instant:
    """Return an instant, or `most` where the instant may be later."""
    if isinstance(instant, int):
        return min(instant, most)
    return most if instant.high > most else instant


@dataclass(frozen=True, slots=True)
class IndexRange:
    """Consecutive instants, both ends included; empty if `last` is before `start`."""

    start: Instant
    last: Instant

    @property
    def count(self) -> int:
        """Number of instants from the earliest start to the latest end; empty if <= 0."""
        if isinstance(self.start, int) and isinstance(self.last, int):
            return self.last - self.start + 1
        return latest(self.last) - earliest(self.start) + 1

    @property
    def single(self) -> bool:
        """True for a single instant."""
        return bool(self.start == self.last)

    @property
    def settled(self) -> IndexRange:
        """Range of all instants over all iterations of enclosing loops."""
        return IndexRange(earliest(self.start), latest(self.last))


def spanning(start: int, count: int) -> IndexRange:
    """Return the range of `count` instants from `start` on."""
    return IndexRange(start, start + count - 1)


@dataclass(frozen=True, slots=True)
class TraceDomain:
    """Length of a trace, and its continuation.

    Attributes:
        samples: number of known samples.
        end: treatment of instants beyond them.
        stop: final length of an open trace, at which windows to the end are clipped; None: at the last known
            sample.
        counted: every instant counts, unknown ones too, as the semantics is a mean.
    """

    samples: int
    end: Boundary = "strict"
    stop: int | None = None
    counted: bool = False

    @property
    def open(self) -> bool:
        """True if instants beyond the last sample exist, with unknown predicates."""
        return self.end in ("lower", "upper", "both")

    @property
    def length(self) -> int:
        """Final length; unbounded windows are clipped here."""
        return self.samples if self.stop is None else self.stop


# ------------------------------------------------------------------------------ operands


def operands(
    node: ir.Formula, run: IndexRange, domain: TraceDomain
) -> tuple[tuple[ir.Formula, IndexRange], ...]:
    """Return the operands of a formula needed at `run`, each with its instants, possibly none."""
    match node:
        case ir.Truth() | ir.Predicate() | ir.Freeze():
            return ()
        case ir.AtStart(body):
            return ((body, IndexRange(0, 0)),)
        case ir.BoolOp(_, items):
            return tuple((item, run) for item in items)
        case _:
            parts, around = parts_of(node), node.offsets
            runs = [
                IndexRange(_first(read, run), _last(read, run, around[-1], parts, domain)) for read in around
            ]
            runs = runs if runs[-1].count > 0 else [_NEVER] * len(runs)
            return tuple(zip(parts, runs, strict=True))


_NEVER = IndexRange(0, -1)


def _first(read: ir.Offsets, run: IndexRange) -> Instant:
    """Return the first instant at which a formula needed at `run` reads an operand."""
    return 0 if read.first is None else at_least(run.start + read.first, 0)


def _last(
    read: ir.Offsets, run: IndexRange, window: ir.Offsets, parts: Sequence[ir.Formula], domain: TraceDomain
) -> Instant:
    """Return the last such instant, at most one beyond the trace at which all operands are constant."""
    if read.last is None:
        return domain.length - 1
    last = run.last + read.last
    if not domain.open:
        return at_most(last, domain.samples - 1)
    far = read.last > 0 and latest(last) >= domain.samples + _FAR
    if not far or domain.counted or read.first == read.last:
        return last
    tails = [tail(part, domain.samples, domain.length) for part in parts]
    known = [found for found in tails if found is not None]
    if len(known) < len(tails):
        return last
    return min(latest(last), max(*known, latest(run.last) + (window.first or 0)))


def reads(num: ir.Num, domain: TraceDomain) -> Reach:
    """Return the samples required for a number to be defined.

    On an open trace a clamped read requires its actual sample.
    """
    past, future = reach_of(num)
    return Reach(past, future if domain.stop is None else max(future, farthest(num).future))


def within(reach: Reach, run: IndexRange, domain: TraceDomain) -> IndexRange:
    """Return the instants of `run` at which all samples within a lookback and lookahead exist."""
    first = max(earliest(run.start), reach.past)
    return IndexRange(first, max(min(latest(run.last), domain.samples - 1 - reach.future), first - 1))


# ----------------------------------------------------------------------------- schedules


@dataclass(frozen=True, slots=True)
class Step:
    """Value to compute.

    Attributes:
        node: formula, or a computation specific to a back end.
        run: instants at which it is computed.
        args: step numbers of the operands; None for an operand that is not needed at any instant.
        number: step number.
    """

    node: Any
    run: IndexRange
    args: tuple[int | None, ...]
    number: int = 0

    @property
    def operands(self) -> tuple[int, ...]:
        """Step numbers of the needed operands."""
        return tuple(number for number in self.args if number is not None)


@dataclass(frozen=True, slots=True)
class Schedule:
    """Ordered steps.

    Attributes:
        domain: trace that the steps read.
        steps: steps in order, operands first.
        roots: step numbers of the requested formulas.
    """

    domain: TraceDomain
    steps: tuple[Step, ...]
    roots: tuple[int, ...]


@dataclass(slots=True)
class StepScope:
    """Steps of one loop level, with an index of the values that they compute."""

    steps: list[Step] = field(default_factory=list)
    known: dict[tuple[ir.Formula, IndexRange], int] = field(default_factory=dict)


class Scheduler:
    """Scheduler that assigns one step to each formula and range of instants."""

    def __init__(self, domain: TraceDomain) -> None:
        self.domain = domain
        self.scope = StepScope()
        self._count = 0

    def place(self, node: ir.Formula, run: IndexRange) -> int | None:
        """Return the step number of a formula; None if it is needed at no instant."""
        if run.count <= 0:
            return None
        key, known = (node, run), self.scope.known
        found = known.get(key)
        if found is None:
            found = known[key] = self.scheduled(node, run)
        return found

    def scheduled(self, node: ir.Formula, run: IndexRange) -> int:
        """Add a step after those of its operands."""
        args = tuple(self.place(part, its) for part, its in operands(node, run, self.domain))
        return self.add(Step(node, run, args, number=self.number(run)))

    def number(self, run: IndexRange) -> int:  # noqa: ARG002 - back ends allocate memory for it
        """Return the next step number, for values at these instants."""
        self._count += 1
        return self._count - 1

    def add(self, step: Step) -> int:
        """Append a step; return its number."""
        self.scope.steps.append(step)
        return step.number


def schedule(formulas: Sequence[ir.Formula], run: IndexRange, domain: TraceDomain) -> Schedule:
    """Return the schedule of `formulas` at the instants `run`; a `freeze` is one step."""
    scheduler = Scheduler(domain)
    placed = (scheduler.place(formula, run) for formula in formulas)
    roots = tuple(number for number in placed if number is not None)
    return Schedule(domain, tuple(scheduler.scope.steps), roots)
