"""States that the compiler adds, because a plan must know what was before it: their values and how they move.

`clock`: how many steps the mission is old. `status`: what is known of an absolute formula. `latch`: whether a
formula held at the sample before, or ever. `timer`: for how long it has, or has not. All of them are whole
numbers, and one step later each is a function of the state at the start of the step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.normal_form import joined
from stlc.compile.ir.traverse import map_children
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.signature import Column
from stlc.source import Span

TimerKind: TypeAlias = Literal["clock", "status", "latch", "timer"]

OPEN, TRUE, FALSE = 0.0, 1.0, -1.0
"""Values of a status."""

MISSING = 1000.0
"""Robustness that a step lacks which a timer asks for, and which lies before a plan."""


@dataclass(frozen=True, slots=True)
class Timer:
    """A state that the compiler adds.

    Attributes:
        name: of its column.
        kind: what it holds.
        initial: its value at the start of a mission.
        update: its value one step later, read from the state at the start of the step.
        low: its least value.
        high: its greatest value; beyond it no formula tells instants apart.
        about: what it says, in words.
    """

    name: str
    kind: TimerKind
    initial: float
    update: ir.Num
    low: float
    high: float
    about: str = ""

    @property
    def column(self) -> Column:
        """The column that it adds to a state."""
        return Column(self.name, kind="int", role="timer", low=self.low, high=self.high, fact=True)


def clock_of(name: str, high: int) -> Timer:
    """The mission clock: it counts steps, so that no rounding enters, and stops at `high`."""
    later = ir.Op("min", (ir.Op("add", (ir.Signal(name), ir.Const(1.0))), ir.Const(float(high))))
    return Timer(name, "clock", 0.0, later, 0.0, float(high), "counts the samples of the mission")


class TimerTable:
    """The timers of a specification, gathered requirement by requirement; equal ones are kept once."""

    def __init__(self, taken: frozenset[str]) -> None:
        """Timers get names that are not among `taken`."""
        self._taken = set(taken)
        self._known: dict[tuple[object, ...], Timer] = {}
        self._clock: str | None = None
        self._latest = 0

    @property
    def timers(self) -> tuple[Timer, ...]:
        """The clock first, if there is one, then the others in order."""
        clocks = () if self._clock is None else (clock_of(self._clock, self._latest),)
        return (*clocks, *self._known.values())

    def clock(self, latest: int) -> ir.Signal:
        """The mission clock, which tells instants apart up to step `latest`."""
        self._latest = max(self._latest, latest)
        if self._clock is None:
            self._clock = self.fresh("clock")
        return ir.Signal(self._clock)

    def add(self, draft: Timer, update: Callable[[ir.Signal], ir.Num]) -> ir.Signal:
        """A timer like `draft`, whose own column `update` is given; of equal ones there is one."""
        key = (draft.kind, draft.initial, draft.high, update(ir.Signal("")))
        if key not in self._known:
            name = self.fresh(draft.name)
            self._known[key] = replace(draft, name=name, update=update(ir.Signal(name)))
        return ir.Signal(self._known[key].name)

    def fresh(self, wanted: str) -> str:
        """`wanted`, or with a number behind it where that is the name of something else."""
        name, number = wanted, 1
        while name in self._taken:
            number += 1
            name = f"{wanted}_{number}"
        self._taken.add(name)
        return name


# ------------------------------------------------------------------------- conditions


def at_least(left: ir.Num, right: ir.Num) -> ir.Predicate:
    """`left >= right`, between whole numbers."""
    return ir.Predicate(ir.Op("sub", (left, right)))


def time_test(left: ir.Num, right: ir.Num, span: Span) -> typed.Predicate:
    """`left >= right` as a test of time: it decides truth and never limits the margin."""
    return typed.Predicate(span, ir.Op("sub", (left, right)), strict=False, guard=True)


def timer_test(left: ir.Num, right: ir.Num, span: Span) -> typed.Formula:
    """`left >= right` as a test of what no plan changes any more: where it fails, what is missing counts.

    Each missing step counts as much as no predicate reaches, so that of several instants those are preferred
    at which a plan can do something; and it is finite, so that there is a best of plans that all fail.
    """
    gap = ir.Op("mul", (ir.Op("sub", (left, right)), ir.Const(MISSING)))
    return typed.Logic(span, "or", (time_test(left, right, span), typed.Predicate(span, gap, strict=False)))


def choose(condition: ir.Formula, yes: ir.Num, no: ir.Num) -> ir.Num:
    """`yes` where a state formula holds, else `no`."""
    if isinstance(condition, ir.Truth):
        return yes if condition.value else no
    return ir.Where(condition, yes, no)


def tolerant(formula: ir.Formula) -> ir.Formula:
    """A state formula that is true exactly where the monitor calls it satisfied: ties count."""
    if isinstance(formula, ir.Predicate) and not formula.guard:
        return ir.Predicate(ir.Op("add", (formula.num, ir.Const(formula.sign * TOLERANCE))), formula.sign)
    return map_children(formula, formulas=tolerant)


def both(*items: ir.Formula) -> ir.Formula:
    """The conjunction of formulas, constants folded."""
    return joined("and", items, ir.Truth(True))
