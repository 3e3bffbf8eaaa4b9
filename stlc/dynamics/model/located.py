"""Jumps at the instants at which their guards begin to hold, found within a step by bisection.

In a round, the flow goes to the end of what is left of the step, and a cubic polynomial is put through the
states and derivatives at both ends. The first instant at which a guard holds on it is bracketed by bisection.
There the jumps take place, and the next round begins. All rounds are computed, as straight-line code; those
without a jump have no length.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.assignments import Assignments
from stlc.dynamics.declaration.motion import JumpDecl
from stlc.dynamics.model.integrators._tableau import Method, Rate, State

ROUNDS = 3
"""Instants at which jumps happen within one step of integration, at most; further ones wait for the next."""
HALVINGS = 20
"""Bisections: the instant of a jump is known to a millionth of the step."""
_ZERO, _ONE = ir.Const(0.0), ir.Const(1.0)


Formulas: TypeAlias = tuple[ir.Formula, ...]


@dataclass(frozen=True, slots=True)
class LocatedJumps:
    """Jumps that are located within a step.

    A jump whose guard still holds after it waits for the next step.

    Attributes:
        jumps: the jumps.
        writer: takes the intermediate results.
        happened: function from the state at an instant, and the conditions under which each jump happens, to
            the state afterwards.
    """

    jumps: Sequence[JumpDecl]
    writer: Assignments
    happened: Callable[[State, Formulas], State]

    def advanced(self, integrate: Method, rate: Rate, state: State, length: float) -> State:
        """Return the state after `length` seconds of flow and jumps; values of `state` are columns."""
        rest: ir.Num = _ONE
        waiting: Formulas | None = None
        for index in range(ROUNDS):
            segment = _Segment.over(integrate, _scaled(rate, rest), state, length, self._named)
            at = self._first(segment, waiting)
            there = self._named(segment.at(at, segment.moving))
            state = self._named(self.happened(there, self._due(there, waiting)))
            rest = self.writer.name(rest * (_ONE - at), "rest#{}")
            if index < ROUNDS - 1:  # a jump waits whose guard holds both before and after these jumps
                guards = zip(self._guards(there), self._guards(state), strict=True)
                flags = (self.writer.name(ir.BoolOp("and", each).indicator(), "waits#{}") for each in guards)
                waiting = tuple(ir.Predicate(0.5 - flag) for flag in flags)
        return self._named(integrate(_scaled(rate, rest), state, length, self._named))

    def _named(self, state: State) -> State:
        return {name: self.writer.name(num, name + "#{}") for name, num in state.items()}

    def _guards(self, state: State) -> Formulas:
        return tuple(jump.guard.substitute(state) for jump in self.jumps)

    def _due(self, state: State, waiting: Formulas | None) -> Formulas:
        """Conditions under which each jump happens in a state: its guard holds, and it does not wait."""
        if waiting is None:
            return self._guards(state)
        pairs = zip(self._guards(state), waiting, strict=True)
        return tuple(guard & free for guard, free in pairs)

    def _first(self, segment: _Segment, waiting: Formulas | None) -> ir.Num:
        """Share of a segment after which a jump happens for the first time; 1 if none does.

        A guard that holds at neither end is not noticed.
        """
        low: ir.Num = _ZERO
        high: ir.Num = _ONE
        for _ in range(HALVINGS):
            middle = self.writer.name(0.5 * (low + high), "middle#{}")
            holds = self._any(segment, middle, waiting)
            low, high = (
                self.writer.name(holds.select(*pair), "bracket#{}")
                for pair in ((low, middle), (middle, high))
            )
        found = self._any(segment, _ONE, waiting).select(high, _ONE)
        return self.writer.name(self._any(segment, _ZERO, waiting).select(_ZERO, found), "event#{}")

    def _any(self, segment: _Segment, share: ir.Num, waiting: Formulas | None) -> ir.Formula:
        """Condition that a jump happens after a share of a segment."""
        read = frozenset[str]().union(*(jump.guard.columns for jump in self.jumps))
        due = self._due(self._named(segment.at(share, read & segment.moving)), waiting)
        return due[0] if len(due) == 1 else ir.BoolOp("or", due)


@dataclass(frozen=True, slots=True)
class _Segment:
    """States along a part of a step, as cubic polynomials.

    Attributes:
        start: states at its beginning.
        end: states at its end.
        bends: name of a state that moves -> its derivatives at both ends, less the mean one, times the
            length.
    """

    start: State
    end: State
    bends: dict[str, tuple[ir.Num, ir.Num]]

    @classmethod
    def over(cls, integrate: Method, rate: Rate, start: State, length: float, named: Rate) -> _Segment:
        """Return the segment of a flow over `length` seconds."""
        first = rate(start)
        end = {**start, **named(integrate(rate, start, length, named))}
        last = rate(end)
        bends = {}
        for name in first:
            change = end[name] - start[name]
            ways = (ir.Const(length) * slope[name] for slope in (first, last))
            left, right = (way - change for way in ways)
            kept = named({f"{name}.left": left, f"{name}.right": right})
            bends[name] = kept[f"{name}.left"], kept[f"{name}.right"]
        return cls(start, end, bends)

    @property
    def moving(self) -> frozenset[str]:
        """Names of the states that move."""
        return frozenset(self.bends)

    def at(self, share: ir.Num, names: frozenset[str]) -> State:
        """Return the states after a share of the segment; those that are not in `names` as at its start."""
        if share == _ZERO:
            return self.start
        if share == _ONE:
            return {**self.start, **{name: self.end[name] for name in names}}
        rest = _ONE - share
        found = dict(self.start)
        for name in names:
            left, right = self.bends[name]
            change = self.end[name] - self.start[name]
            bent = rest * left - share * right
            found[name] = self.start[name] + share * (change + rest * bent)
        return found


def _scaled(rate: Rate, share: ir.Num) -> Rate:
    """Return the derivatives in a time that runs `share` times as fast."""
    if share == _ONE:
        return rate
    return lambda state: {name: share * slope for name, slope in rate(state).items()}
