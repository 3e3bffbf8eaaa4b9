"""Which values a formula needs at which instants: formulas and a trace length -> steps in order.

Nothing is computed where nobody asks: a state predicate at the root is read at one instant, the body of
`always[0, T]` at T + 1. Equal sub-formulas at equal instants are one step. Every back end reads the same
steps and matches on the node of each. Instants are whole numbers, or inside of a loop that a back end writes
(`LoopIndex`) expressions in its index.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias, assert_never

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Reach, farthest, reach_of, tail

Boundary: TypeAlias = Literal["strict", "truncate", "lower", "upper", "both"]
"""What stands beyond the last sample.

`strict`: nothing, and whoever asks is told. `truncate`: nothing, windows are cut. `lower` and `upper`: the
trace may go on, and unknown predicates are -inf or +inf there; windows to the end of the trace end at the
last known sample all the same. `both` (NumPy, without `freeze`): two traces, of which the first is taken at
its least and the second at its greatest.
"""

Pick: TypeAlias = Literal["min", "max"]

PICKS: Mapping[str, Pick] = {
    **dict.fromkeys(("and", "always", "historically", "release", "trigger"), "min"),
    **dict.fromkeys(("or", "eventually", "once", "until", "since"), "max"),
}
"""Operator -> the extremum that it takes, `until` and the like over its window."""

_FAR = 256
"""Instants beyond the last sample that are computed without asking whether they are all alike."""


def dual(pick: Pick) -> Pick:
    """The other extremum."""
    return "max" if pick == "min" else "min"


def neutral(pick: Pick) -> float:
    """The extremum of nothing."""
    return math.inf if pick == "min" else -math.inf


# ------------------------------------------------------------------------------ instants


@dataclass(frozen=True, slots=True)
class LoopIndex:
    """An instant that follows from the loops around it.

    Attributes:
        text: expression in the language of the back end.
        low: the least value it takes.
        high: the greatest.
    """

    text: str
    low: int
    high: int

    def __add__(self, steps: int) -> Instant:
        """The instant so many samples later."""
        if self.low == self.high:
            return self.low + steps
        if not steps:
            return self
        return LoopIndex(f"({self.text} + {steps})", self.low + steps, self.high + steps)

    def __sub__(self, steps: int) -> Instant:
        """The instant so many samples before."""
        return self + -steps

    def __str__(self) -> str:
        return self.text


Instant: TypeAlias = Any
"""A whole number, or a `LoopIndex`."""


def earliest(instant: Instant) -> int:
    """The least value of an instant."""
    return instant.low if isinstance(instant, LoopIndex) else int(instant)


def latest(instant: Instant) -> int:
    """The greatest value of an instant."""
    return instant.high if isinstance(instant, LoopIndex) else int(instant)


def at_least(instant: Instant, least: int) -> Instant:
    """The later one of an instant and `least`."""
    if isinstance(instant, int):
        return max(instant, least)
    if instant.low >= least:
        return instant
    later = LoopIndex(f"LATER({instant.text}, {least})", least, instant.high)
    return least if instant.high <= least else later


def at_most(instant: Instant, most: int) -> Instant:
    """An instant; `most` where it may lie beyond that."""
    if isinstance(instant, int):
        return min(instant, most)
    return most if instant.high > most else instant


@dataclass(frozen=True, slots=True)
class IndexRange:
    """Consecutive instants, both ends included; none where `last` is before `start`."""

    start: Instant
    last: Instant

    @property
    def count(self) -> int:
        """Instants between the earliest start and the latest end; none if this is 0 or less."""
        if isinstance(self.start, int) and isinstance(self.last, int):
            return self.last - self.start + 1
        return latest(self.last) - earliest(self.start) + 1

    @property
    def single(self) -> bool:
        """Whether it is one instant, wherever."""
        return bool(self.start == self.last)

    @property
    def settled(self) -> IndexRange:
        """All instants that it covers in any turn of the loops around."""
        return IndexRange(earliest(self.start), latest(self.last))


def spanning(start: int, count: int) -> IndexRange:
    """`count` instants from `start` on."""
    return IndexRange(start, start + count - 1)


@dataclass(frozen=True, slots=True)
class TraceDomain:
    """Length of a trace, and whether it may go on.

    Attributes:
        samples: how many are known.
        end: what stands beyond them.
        stop: final length where the trace goes on; windows to its end end there, and not with the last known
            sample.
        counted: every instant counts, unknown ones as well: the semantics is a mean.
    """

    samples: int
    end: Boundary = "strict"
    stop: int | None = None
    counted: bool = False

    @property
    def open(self) -> bool:
        """Whether instants beyond the last sample exist, with unknown predicates."""
        return self.end in ("lower", "upper", "both")

    @property
    def length(self) -> int:
        """Final length; unbounded windows are clipped here."""
        return self.samples if self.stop is None else self.stop

    def last(self, window: ir.Window, latest_start: Instant, parts: Sequence[ir.Formula]) -> Instant:
        """The last instant of `parts` that a window of the future needs.

        Of the instants beyond the trace at which all parts stay as they are it takes one.

        Args:
            window: of the operator.
            latest_start: the last instant at which the operator is needed.
            parts: its operands.
        """
        if window.hi is None:
            return self.length - 1
        last = latest_start + window.hi
        if not self.open:
            return at_most(last, self.samples - 1)
        if latest(last) < self.samples + _FAR or self.counted:
            return last
        tails = [tail(part, self.samples, self.length) for part in parts]
        known = [found for found in tails if found is not None]
        if len(known) < len(tails):
            return last
        return min(latest(last), max(*known, latest(latest_start) + window.lo))


# ------------------------------------------------------------------------------ operands


def operands(
    node: ir.Formula, run: IndexRange, domain: TraceDomain
) -> tuple[tuple[ir.Formula, IndexRange], ...]:
    """Operands of a formula that is needed at the instants `run`, each with its own instants, maybe none."""
    match node:
        case ir.Truth() | ir.Predicate() | ir.Freeze():
            return ()
        case ir.BoolOp(_, items):
            return tuple((item, run) for item in items)
        case ir.Temporal(_, window, body):
            return ((body, IndexRange(run.start + window.lo, domain.last(window, run.last, (body,)))),)
        case ir.PastTemporal(_, window, body):
            return ((body, IndexRange(_first(window, run), run.last - window.lo)),)
        case ir.Until() | ir.Since():
            return _both(node, run, domain)
        case ir.Shift(steps, body):
            last = run.last + steps
            last = last if domain.open else at_most(last, domain.samples - 1)
            return ((body, IndexRange(at_least(run.start + steps, 0), last)),)
        case ir.AtStart(body):
            return ((body, IndexRange(0, 0)),)
        case _:
            assert_never(node)


_NEVER = IndexRange(0, -1)


def _both(
    node: ir.Until | ir.Since, run: IndexRange, domain: TraceDomain
) -> tuple[tuple[ir.Formula, IndexRange], tuple[ir.Formula, IndexRange]]:
    """Operands of `until` and `since`: the right one in the window, the left one from now up to there."""
    window, left, right = node.window, node.left, node.right
    if isinstance(node, ir.Until):
        last = domain.last(window, run.last, (left, right))
        held, met = IndexRange(run.start, last), IndexRange(run.start + window.lo, last)
    else:
        first = _first(window, run)
        held, met = IndexRange(first, run.last), IndexRange(first, run.last - window.lo)
    return ((left, held), (right, met)) if met.count > 0 else ((left, _NEVER), (right, _NEVER))


def _first(window: ir.Window, run: IndexRange) -> Instant:
    """The first instant that a window of the past reads."""
    return 0 if window.hi is None else at_least(run.start - window.hi, 0)


def reads(num: ir.Num, domain: TraceDomain) -> Reach:
    """Samples that have to exist for a number to have a value.

    What reads the last sample instead of one beyond the trace has to wait for it while the trace goes on.
    """
    past, future = reach_of(num)
    return Reach(past, future if domain.stop is None else max(future, farthest(num).future))


def within(reach: Reach, run: IndexRange, domain: TraceDomain) -> IndexRange:
    """The instants of `run` at which all samples exist that a number of this reach reads."""
    first = max(earliest(run.start), reach.past)
    return IndexRange(first, max(min(latest(run.last), domain.samples - 1 - reach.future), first - 1))


# ----------------------------------------------------------------------------- schedules


@dataclass(frozen=True, slots=True)
class Loop:
    """Steps that a back end runs again and again: the inside of a `freeze`, or of a table of alike formulas.

    Attributes:
        index: name of the index in the language of the back end.
        bound: numbers under which the frozen values stand, in the order of their bindings.
        steps: filled anew in every turn.
        own: numbers of everything that is, in the order in which they were given out.
        root: number of the step that is the outcome of a turn.
    """

    index: str
    bound: tuple[int, ...]
    steps: tuple[Step, ...]
    own: tuple[int, ...]
    root: int


@dataclass(frozen=True, slots=True)
class Step:
    """One value to compute.

    Attributes:
        node: the formula; or what a back end computes beside formulas.
        run: at which instants.
        args: numbers of the steps with the values of its operands; None for an operand that is not needed at
            any instant.
        inner: what is run for every instant of a `freeze`, or for every row of a table; None where the back
            end evaluates it itself.
        number: of this step among all.
    """

    node: Any
    run: IndexRange
    args: tuple[int | None, ...]
    inner: Loop | None = None
    number: int = 0

    @property
    def operands(self) -> tuple[int, ...]:
        """Numbers of the operands that are needed."""
        return tuple(number for number in self.args if number is not None)


@dataclass(frozen=True, slots=True)
class Schedule:
    """Steps in order.

    Attributes:
        domain: of the trace.
        steps: operands first.
        roots: numbers of the formulas that were asked for.
    """

    domain: TraceDomain
    steps: tuple[Step, ...]
    roots: tuple[int, ...]


@dataclass(slots=True)
class Scope:
    """Steps that are run together, and what they compute already."""

    steps: list[Step] = field(default_factory=list)
    known: dict[tuple[ir.Formula, IndexRange], int] = field(default_factory=dict)


class Scheduler:
    """Gives every formula that is needed at some instants one step."""

    def __init__(self, domain: TraceDomain) -> None:
        self.domain = domain
        self.scope = Scope()
        self._count = 0

    def place(self, node: ir.Formula, run: IndexRange) -> int | None:
        """The number of the step of a formula; None where it is needed at no instant."""
        if run.count <= 0:
            return None
        key, known = (node, run), self.scope.known
        found = known.get(key)
        if found is None:
            found = known[key] = self.scheduled(node, run)
        return found

    def scheduled(self, node: ir.Formula, run: IndexRange) -> int:
        """A new step, those of its operands before it."""
        args = tuple(self.place(part, its) for part, its in operands(node, run, self.domain))
        return self.add(Step(node, run, args, number=self.number(run)))

    def number(self, run: IndexRange) -> int:  # noqa: ARG002 - back ends give memory to it
        """The next number, of something that has a value at each of these instants."""
        self._count += 1
        return self._count - 1

    def add(self, step: Step) -> int:
        """Append a step; its number."""
        self.scope.steps.append(step)
        return step.number


def schedule(formulas: Sequence[ir.Formula], run: IndexRange, domain: TraceDomain) -> Schedule:
    """All steps that `formulas` at the instants `run` take; a `freeze` is one of them."""
    scheduler = Scheduler(domain)
    placed = (scheduler.place(formula, run) for formula in formulas)
    roots = tuple(number for number in placed if number is not None)
    return Schedule(domain, tuple(scheduler.scope.steps), roots)
