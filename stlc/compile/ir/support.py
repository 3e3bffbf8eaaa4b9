"""Samples that a formula reads: its lookback and its lookahead.

An `Analysis` assigns a value to every node of a formula. `ir.Formula.fold` computes these values upwards from
the leaves. The value of a node follows from the values of its operands, and from the offsets at which the
node reads its operands (`ir.Operator.offsets`).

Windows of the past are cut at the start of the trace. So they never require samples that do not exist. A
window "to the end" requires only its first sample.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeAlias, TypeVar, final

if TYPE_CHECKING:
    from stlc.compile.ir import nodes as ir

V = TypeVar("V")


class Offsets(NamedTuple):
    """Instants at which an operator reads an operand, in samples relative to now; both ends are included.

    Attributes:
        first: least offset, negative in the past; None if the operand is read from the start of the trace on.
        last: greatest offset; None if the operand is read up to the end of the trace.
    """

    first: int | None
    last: int | None


NOW = Offsets(0, 0)


class Analysis(ABC, Generic[V]):
    """Analysis of a formula that assigns a value, of any type, to every node of the formula.

    There is one method per kind of node. The method computes the value of a node from the values of the
    operands. `ir.Formula.fold` applies the methods from the leaves upwards.
    """

    def predicate(self, num: ir.Num) -> V:  # noqa: ARG002
        """Return the value of a predicate on the number `num`; unless overridden, that of a constant.

        The method is also called for a number that a `freeze` binds to a name.
        """
        return self.constant()

    @abstractmethod
    def constant(self) -> V:
        """Return the value of the formulas `true` and `false`."""

    @abstractmethod
    def over(self, parts: Sequence[V], offsets: Sequence[Offsets]) -> V:
        """Return the value of an operator whose operands have the values `parts`.

        Operand i is read at `offsets[i]`; the last offsets are the window of the operator.
        """

    @abstractmethod
    def at_start(self, body: V) -> V:
        """Return the value of an `ir.AtStart` node, whose operand is evaluated at the first sample.

        `body` is the value of the operand.
        """

    def shift(self, body: V, node: ir.Shift) -> V:
        """Return the value of `node`, which reads its operand at another sample.

        `body` is the value of the operand.
        """
        return self.over((body,), node.offsets)

    def freeze(self, bound: Sequence[V], body: V) -> V:
        """Return the value of a `freeze`.

        `bound` are the values of the numbers that it binds to names; `body` is the value of its body.
        """
        parts = (body, *bound)
        return self.over(parts, (NOW,) * len(parts))


# ------------------------------------------------------------------- lookback and lookahead


class Reach(NamedTuple):
    """Lookback (`past`) and lookahead (`future`) in samples, both at least 0."""

    past: int
    future: int

    @classmethod
    def over(cls, steps: Iterable[int]) -> Reach:
        """Return the least that contains all of `steps`, in samples relative to now."""
        found = (0, *steps)
        return cls(-min(found), max(found))


_Needs: TypeAlias = tuple[int, int, int]
"""Lookback; lookahead; and lookahead of operators such as `always@[a, b]`, counted from the first sample."""


@final
class _Required(Analysis[_Needs]):
    """Analysis of the required samples.

    Windows of the past are cut at the start of the trace, so they require no sample.
    """

    def predicate(self, num: ir.Num) -> _Needs:
        return (*num.reach, 0)

    def constant(self) -> _Needs:
        return 0, 0, 0

    def over(self, parts: Sequence[_Needs], offsets: Sequence[Offsets]) -> _Needs:
        """Return the samples that an operator requires: (lookback, lookahead, lookahead from the start).

        The third number is the lookahead of operators such as `always@[a, b]` inside, counted from the first
        sample of the trace. `parts` contains the same three numbers for each operand. Lookback and lookahead
        are shifted by the offsets at which the operator reads the operand. A window without end requires only
        the sample nearest to now.
        """
        past = future = clocked = 0
        for (back, ahead, later), (first, last) in zip(parts, offsets, strict=True):
            low, high = (last or 0) if first is None else first, (first or 0) if last is None else last
            past, future, clocked = max(past, back - low), max(future, ahead + high), max(clocked, later)
        return past, future, clocked

    def at_start(self, body: _Needs) -> _Needs:
        return 0, 0, max(body[1], body[2])


@final
class _History(Analysis[int]):
    """Analysis of the samples that a formula reads before now, with past windows counted in full."""

    def predicate(self, num: ir.Num) -> int:
        return num.farthest.past

    def constant(self) -> int:
        return 0

    def over(self, parts: Sequence[int], offsets: Sequence[Offsets]) -> int:
        firsts = [-_EVERYTHING if first is None else first for first, _ in offsets]
        return max(0, *(part - first for part, first in zip(parts, firsts, strict=True)))

    def at_start(self, _body: int) -> int:
        return _EVERYTHING


_EVERYTHING = 1 << 40
"""More samples than any trace has."""


@final
class _Earliest(Analysis[tuple[int, int]]):
    def constant(self) -> tuple[int, int]:
        return 0, 0

    def over(self, parts: Sequence[tuple[int, int]], offsets: Sequence[Offsets]) -> tuple[int, int]:
        firsts = (max(first or 0, 0) for first, _ in offsets)
        later = max(part[0] + first for part, first in zip(parts, firsts, strict=True))
        return later, max(part[1] for part in parts)

    def shift(self, body: tuple[int, int], _node: ir.Shift) -> tuple[int, int]:
        return body

    def at_start(self, body: tuple[int, int]) -> tuple[int, int]:
        return 0, max(body)


REQUIRED, HISTORY, EARLIEST = _Required(), _History(), _Earliest()
"""Analyses of `ir.Formula.reach`, `ir.Formula.history` and `ir.Formula.earliest`."""


# ------------------------------------------------------------------------------ constant tails


@final
@dataclass(frozen=True, slots=True)
class Tail(Analysis[int | None]):
    """Analysis of the instant from which on the robustness of a formula is constant, +inf or -inf.

    The trace is open: it continues, but its values beyond the last known sample are unknown. To bound the
    robustness, all predicates there count as +inf, or all as -inf. Most formulas are therefore constant from
    some instant on. An operator whose window extends far beyond that instant needs to read only one instant
    of this constant part.

    Attributes:
        samples: number of known samples.
        length: assumed length of the whole trace in samples; windows to the end of the trace end there.
    """

    samples: int
    length: int

    def predicate(self, _num: ir.Num) -> int | None:
        return self.samples

    def constant(self) -> int | None:
        return 0

    def over(self, parts: Sequence[int | None], offsets: Sequence[Offsets]) -> int | None:
        """Return an instant from which on an operator is constant, or None if none is known.

        `parts` are the instants from which on the operands are constant; operand i is read at `offsets[i]`.
        From the returned instant on, the operator reads its operands only where they are constant, or its
        window is empty. There is one exception: a window that begins at the start of the trace. From the
        returned instant on, this window contains all instants at which the operand varies.
        """
        known = [part for part in parts if part is not None]
        if len(known) < len(parts):
            return None
        (first, last), whole = offsets[-1], max(known)
        if first is None:
            return whole + 1 - (last or 0)
        least = min(each.first or 0 for each in offsets)
        return max(whole - least, 0 if last is not None else self.length - first, 0)

    def freeze(self, _bound: Sequence[int | None], _body: int | None) -> int | None:
        return None

    def at_start(self, _body: int | None) -> int | None:
        return None
