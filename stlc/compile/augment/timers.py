"""States that the compiler adds to store what happened before a plan: initial values and updates.

`clock`: number of steps since the start of the mission. `status`: whether an absolute formula (`always@[a, b]
p`, whose interval counts from the start of the mission) is open (undecided), true or false. `latch`: whether
a formula held at the previous sample, or at any sample so far. `timer`: for how many steps a formula has
held, or has not held. All are integers, updated from the state at the start of a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.signature import Column
from stlc.source import Span

TimerKind: TypeAlias = Literal["clock", "status", "latch", "timer"]

OPEN, TRUE, FALSE = 0.0, 1.0, -1.0
"""Values of a status."""

MISSING = 1000.0
"""Robustness lost for each step that a timer lacks before the plan."""


@dataclass(frozen=True, slots=True)
class Timer:
    """State that the compiler adds to those of the system.

    Such a state is called a timer, whatever its kind.

    Attributes:
        name: name of the state.
        kind: clock, status, latch or timer.
        initial: value at the start of a mission.
        update: value one step later, as a function of the state at the start of the step.
        low: least value.
        high: greatest value, at which the count stops; larger values would make no difference to any formula.
        about: meaning in words, for `stlc compile` and generated code.
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
        """Description of this state as a column of the state vector: name, type and range."""
        return Column(self.name, kind="int", role="timer", low=self.low, high=self.high, fact=True)


def clock_of(name: str, high: int) -> Timer:
    """Return the mission clock: an added state that counts the steps of the mission up to `high`."""
    later = (ir.Signal(name) + 1.0).apply("min", float(high))
    return Timer(name, "clock", 0.0, later, 0.0, float(high), "counts the samples of the mission")


class TimerTable:
    """Added states of a specification, collected over its requirements; equal states are shared."""

    def __init__(self, taken: frozenset[str]) -> None:
        """Create an empty table. No state that is added later gets a name in `taken`."""
        self._taken = set(taken)
        self._known: dict[tuple[object, ...], Timer] = {}
        self._clock: str | None = None
        self._latest = 0

    @property
    def timers(self) -> tuple[Timer, ...]:
        """Added states in order, the mission clock first if there is one."""
        clocks = () if self._clock is None else (clock_of(self._clock, self._latest),)
        return (*clocks, *self._known.values())

    def clock(self, latest: int) -> ir.Signal:
        """Return the signal of the mission clock: steps since the start, counted to `latest` or further."""
        self._latest = max(self._latest, latest)
        if self._clock is None:
            self._clock = self.fresh("clock")
        return ir.Signal(self._clock)

    def add(self, draft: Timer, update: Callable[[ir.Signal], ir.Num]) -> ir.Signal:
        """Return the signal of the state described by `draft`; add the state unless there is an equal one.

        `update` returns the value of the state one step later; its argument is the signal of the state.
        """
        key = (draft.kind, draft.initial, draft.high, update(ir.Signal("")))
        if key not in self._known:
            name = self.fresh(draft.name)
            self._known[key] = replace(draft, name=name, update=update(ir.Signal(name)))
        return ir.Signal(self._known[key].name)

    def fresh(self, wanted: str) -> str:
        """Return the name `wanted`, with a number appended if it is taken, and mark the result as taken."""
        name, number = wanted, 1
        while name in self._taken:
            number += 1
            name = f"{wanted}_{number}"
        self._taken.add(name)
        return name


# ------------------------------------------------------------------------- conditions


def at_least(left: ir.Num, right: ir.Num) -> ir.Predicate:
    """Return the predicate `left >= right` between integers."""
    return ir.Predicate(left - right)


def time_test(left: ir.Num, right: ir.Num, span: Span) -> typed.Predicate:
    """Return the predicate `left >= right` between added states (clock, timer, status) and constants.

    Its robustness is +inf or -inf. So it decides whether an enclosing formula holds, but not by how much.
    """
    return typed.Predicate(span, left - right, strict=False, guard=True)


def timer_test(left: ir.Num, right: ir.Num, span: Span) -> typed.Formula:
    """Return a formula that holds if `left >= right`, with finite robustness where the formula fails.

    The robustness is +inf where the formula holds. Where the formula fails, the robustness is `-MISSING`
    times the number of missing steps, `right - left`. This is less than the robustness of any other
    predicate. So in an `or` or `eventually`, whose robustness is a maximum, the operands that the plan can
    influence decide. The robustness is finite, so that plans that all fail can still be ranked.
    """
    gap = (left - right) * MISSING
    return typed.Logic(span, "or", (time_test(left, right, span), typed.Predicate(span, gap, strict=False)))


def choose(condition: ir.Formula, yes: ir.Num, no: ir.Num) -> ir.Num:
    """Return the number that is `yes` where a state formula holds, else `no`."""
    if isinstance(condition, ir.Truth):
        return yes if condition.value else no
    return condition.select(yes, no)


def tolerant(formula: ir.Formula) -> ir.Formula:
    """Return a state formula that holds wherever the monitor reports `formula` as satisfied.

    The monitor accepts a predicate that misses its threshold by at most `TOLERANCE`.
    """
    if isinstance(formula, ir.Predicate) and not formula.guard:
        return ir.Predicate(formula.num + (formula.sign * TOLERANCE), formula.sign)
    return formula.map_children(formulas=tolerant)


def both(*items: ir.Formula) -> ir.Formula:
    """Return the conjunction of formulas, simplified where a formula is a constant."""
    return ir.BoolOp.joined("and", items)


def cited(formula: typed.Formula) -> str:
    """Return the source text of a formula, cut to 40 characters; in quotes if it has backticks."""
    text = " ".join(formula.span.text.split())
    if isinstance(formula, typed.Not) and formula.span == formula.body.span:
        text = f"not ({text})"
    text = text if len(text) <= 40 else f"{text[:37]}..."
    return f"'{text}'" if "`" in text else f"`{text}`"
