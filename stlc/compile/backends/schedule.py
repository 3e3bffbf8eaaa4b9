"""Schedule: list of steps, each of which computes one sub-formula at the instants at which it is needed.

For `p and always[0, T] q` at one instant, for example, `p` is computed at that instant only, and `q` at T + 1
instants. Equal sub-formulas at equal instants share one step. All back ends read the same steps and handle
each by the class of its node. An instant is an integer. In generated code it may depend on the index of a
loop (`LoopIndex`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import Offsets, Reach
from stlc.compile.namespace import Pick

Boundary: TypeAlias = Literal["strict", "truncate", "lower", "upper", "both"]
"""Treatment of instants beyond the last sample.

`strict`: they do not exist, and it is an error if one is needed. `truncate`: windows are cut at the last
sample. `lower` and `upper`: the trace is open, that is, it continues with unknown predicates, of robustness
-inf or +inf; windows to the end of the trace still end at the last known sample. `both` (NumPy,
without `freeze`): the batch holds two traces, the first with lower, the second with upper bounds.
"""

End: TypeAlias = Literal["strict", "truncate"]
"""Treatment of windows that extend beyond the end of a plan: an error, or they are cut there."""

PICKS: Mapping[str, Pick] = MappingProxyType(
    {name: "min" if name == kind.names[0] else "max" for name, kind in ir.OPERATORS.items()}
)
"""Operator -> the extremum that it takes (`until`, `since` and their duals: over the window)."""

_FAR = 256
"""Number of instants beyond the last sample up to which no constant tail of a formula is searched."""


def dual(pick: Pick) -> Pick:
    """Return the dual extremum: "max" for "min", "min" for "max"."""
    return "max" if pick == "min" else "min"


def neutral(pick: Pick) -> float:
    """Return the extremum of no operands: +inf for "min", -inf for "max"."""
    return math.inf if pick == "min" else -math.inf


# ------------------------------------------------------------------------------ instants


@dataclass(frozen=True, slots=True)
class LoopIndex:
    """Instant that depends on the indices of the enclosing loops of generated code.

    Attributes:
        text: expression in the language of the back end.
        low: least value over all iterations.
        high: greatest value over all iterations.
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
    """Return the least value of an instant over all iterations of the enclosing loops."""
    return instant.low if isinstance(instant, LoopIndex) else int(instant)


def latest(instant: Instant) -> int:
    """Return the greatest value of an instant over all iterations of the enclosing loops."""
    return instant.high if isinstance(instant, LoopIndex) else int(instant)


def at_least(instant: Instant, least: int) -> Instant:
    """Return the later of two samples: `instant`, and `least`."""
    if isinstance(instant, int):
        return max(instant, least)
    if instant.low >= least:
        return instant
    later = LoopIndex(f"LATER({instant.text}, {least})", least, instant.high)
    return least if instant.high <= least else later


def at_most(instant: Instant, most: int) -> Instant:
    """Return `most` if `instant` may be later than `most` in some loop iteration, else `instant`."""
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
        """Number of instants in the range; 0 or less for an empty range.

        If `start` or `last` depends on the index of a loop, the range extends from the earliest `start` to
        the latest `last` over all iterations.
        """
        if isinstance(self.start, int) and isinstance(self.last, int):
            return self.last - self.start + 1
        return latest(self.last) - earliest(self.start) + 1

    @property
    def single(self) -> bool:
        """True if the range consists of a single instant."""
        return bool(self.start == self.last)

    @property
    def settled(self) -> IndexRange:
        """This range in integers: from the earliest `start` to the latest `last` over all loop iterations."""
        return IndexRange(earliest(self.start), latest(self.last))


def spanning(start: int, count: int) -> IndexRange:
    """Return the range of `count` instants from `start` on."""
    return IndexRange(start, start + count - 1)


@dataclass(frozen=True, slots=True)
class TraceDomain:
    """Length of a trace, and how it continues beyond its last sample.

    Attributes:
        samples: number of known samples.
        end: treatment of the instants beyond the last sample (`Boundary`).
        stop: final length of an open trace in samples. An open trace continues beyond its known samples, but
            its predicates are unknown there. Unbounded windows end at `stop`. If `stop` is None, they end at
            the last known sample.
        counted: whether every instant contributes to the value of an operator, as it does to a mean. No
            instant may then be left out, even if all predicates are unknown there.
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
        """Final number of samples; unbounded windows end there."""
        return self.samples if self.stop is None else self.stop


# ------------------------------------------------------------------------------ operands


def operands(
    node: ir.Formula, run: IndexRange, domain: TraceDomain
) -> tuple[tuple[ir.Formula, IndexRange], ...]:
    """Return the operands of a formula, each with the range of instants at which the formula reads it.

    `run` holds the instants at which the value of the formula is needed. A range may be empty; `truth`,
    predicates and `freeze` have no operands.
    """
    match node:
        case ir.AtStart(body):
            return ((body, IndexRange(0, 0)),)
        case ir.BoolOp(_, items):
            return tuple((item, run) for item in items)
        case ir.Operator():
            parts, around = node.operands, node.offsets
            runs = []
            for read in around:
                first = 0 if read.first is None else at_least(run.start + read.first, 0)
                runs.append(IndexRange(first, _last(read, run, around[-1], parts, domain)))
            runs = runs if runs[-1].count > 0 else [_NEVER] * len(runs)
            return tuple(zip(parts, runs, strict=True))
        case _:
            return ()


_NEVER = IndexRange(0, -1)


def _last(
    read: Offsets, run: IndexRange, window: Offsets, parts: Sequence[ir.Formula], domain: TraceDomain
) -> Instant:
    """Return the last instant at which a formula reads an operand.

    On an open trace (one that continues with unknown predicates), a window may extend far beyond the last
    sample. If all operands are known to be constant from some instant on, later instants are left out.

    Args:
        read: offsets in samples. For its value at an instant k, the formula reads the operand from
            k + `read.first` to k + `read.last`.
        run: instants k at which the value of the formula is needed.
        window: offsets of the formula's window, likewise relative to k. For `until`, the window is part of
            the samples at which the left operand is read.
        parts: all operands of the formula.
        domain: length of the trace, and treatment of instants beyond its last sample.
    """
    if read.last is None:
        return domain.length - 1
    last = run.last + read.last
    if not domain.open:
        return at_most(last, domain.samples - 1)
    far = read.last > 0 and latest(last) >= domain.samples + _FAR
    if not far or domain.counted or read.first == read.last:
        return last
    tails = [part.tail(domain.samples, domain.length) for part in parts]
    known = [found for found in tails if found is not None]
    if len(known) < len(tails):
        return last
    return min(latest(last), max(*known, latest(run.last) + (window.first or 0)))


def reads(num: ir.Num, domain: TraceDomain) -> Reach:
    """Return how many samples before and after an instant the expression `num` needs to be defined there.

    A clamped read beyond the end of the trace gives the last sample, so it needs no samples there. But if
    more samples will follow (`domain.stop`, the final length, is given), the last sample is not yet known.
    Then all samples that `num` reads must exist.
    """
    past, future = num.reach
    return Reach(past, future if domain.stop is None else max(future, num.farthest.future))


def within(reach: Reach, run: IndexRange, domain: TraceDomain) -> IndexRange:
    """Return the instants of `run` at which an expression is defined: all samples that it needs exist.

    The expression needs `reach.past` samples before the instant and `reach.future` samples after it.
    """
    first = max(earliest(run.start), reach.past)
    return IndexRange(first, max(min(latest(run.last), domain.samples - 1 - reach.future), first - 1))


# ----------------------------------------------------------------------------- schedules


@dataclass(frozen=True, slots=True)
class ScheduleStep:
    """Computation of one formula at a range of instants.

    Attributes:
        node: formula, or an operation specific to a back end.
        run: instants at which it is computed.
        args: step numbers of the operands; None for an operand that is not needed at any instant.
        number: number of this step.
    """

    node: Any
    run: IndexRange
    args: tuple[int | None, ...]
    number: int = 0

    @property
    def operands(self) -> tuple[int, ...]:
        """Numbers of the steps that compute the operands; operands that are not needed are left out."""
        return tuple(number for number in self.args if number is not None)


@dataclass(frozen=True, slots=True)
class Schedule:
    """Steps in the order of computation.

    Attributes:
        domain: length of the trace, and treatment of instants beyond its last sample.
        steps: steps, each after those of its operands.
        roots: step numbers of the requested formulas.
    """

    domain: TraceDomain
    steps: tuple[ScheduleStep, ...]
    roots: tuple[int, ...]


@dataclass(slots=True)
class StepScope:
    """Steps in the body of one loop of generated code, or outside of all loops.

    `known` maps a formula and a range of instants to the number of the step that computes its values there.
    """

    steps: list[ScheduleStep] = field(default_factory=list)
    known: dict[tuple[ir.Formula, IndexRange], int] = field(default_factory=dict)


class Scheduler:
    """Scheduler that assigns one step to each formula and range of instants."""

    def __init__(self, domain: TraceDomain) -> None:
        self.domain = domain
        self.scope = StepScope()
        self._count = 0

    def place(self, node: ir.Formula, run: IndexRange) -> int | None:
        """Return the number of the step that computes `node` at the instants `run`; None if `run` is empty.

        If there is no such step yet, it is added.
        """
        if run.count <= 0:
            return None
        key, known = (node, run), self.scope.known
        found = known.get(key)
        if found is None:
            found = known[key] = self.scheduled(node, run)
        return found

    def scheduled(self, node: ir.Formula, run: IndexRange) -> int:
        """Add steps for the operands of `node`, then a step for `node`; return the number of the latter."""
        args = tuple(self.place(part, its) for part, its in operands(node, run, self.domain))
        return self.add(ScheduleStep(node, run, args, number=self.number(run)))

    def number(self, run: IndexRange) -> int:  # noqa: ARG002
        """Return the next free step number.

        `run` holds the instants of the step. It is unused here; a back end may reserve memory for them.
        """
        self._count += 1
        return self._count - 1

    def add(self, step: ScheduleStep) -> int:
        """Append a step; return its number."""
        self.scope.steps.append(step)
        return step.number


def schedule(formulas: Sequence[ir.Formula], run: IndexRange, domain: TraceDomain) -> Schedule:
    """Return the schedule that computes `formulas` at the instants `run`.

    A `freeze` is a single step, whose body is scheduled by the back end.
    """
    scheduler = Scheduler(domain)
    placed = (scheduler.place(formula, run) for formula in formulas)
    roots = tuple(number for number in placed if number is not None)
    return Schedule(domain, tuple(scheduler.scope.steps), roots)
