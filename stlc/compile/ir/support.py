"""Samples and signals that a formula reads: its lookback, its lookahead, and the names of its signals.

An `Analysis` assigns a value to every node of a formula. `fold` computes the values from the leaves upwards.
The value of a node follows from the values of its operands, and from the offsets at which the node reads its
operands (`ir.Operator.offsets`).

Windows of the past are cut at the start of the trace. So they never require samples that do not exist. A
window "to the end" requires only its first sample.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeAlias, TypeVar, final

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import leaves, nodes, numbers, operands

V = TypeVar("V")


class Analysis(ABC, Generic[V]):
    """Analysis of a formula that assigns a value, of any type, to every node of the formula.

    There is one method per kind of node. The method computes the value of a node from the values of the
    operands. `fold` applies the methods from the leaves upwards.
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
    def over(self, parts: Sequence[V], offsets: Sequence[ir.Offsets]) -> V:
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
        return self.over(parts, (ir.NOW,) * len(parts))


def fold(formula: ir.Formula, analysis: Analysis[V]) -> V:
    """Return the value that an analysis computes for a formula, from the leaves upwards."""
    match formula:
        case ir.Truth():
            return analysis.constant()
        case ir.Predicate(num):
            return analysis.predicate(num)
        case ir.Shift(_, body):
            return analysis.shift(fold(body, analysis), formula)
        case ir.Freeze(bindings, body):
            return analysis.freeze([analysis.predicate(num) for _, num in bindings], fold(body, analysis))
        case ir.AtStart(body):
            return analysis.at_start(fold(body, analysis))
        case _:
            return analysis.over([fold(part, analysis) for part in operands(formula)], formula.offsets)


# ------------------------------------------------------------------- lookback and lookahead


class Reach(NamedTuple):
    """Lookback (`past`) and lookahead (`future`) in samples, both at least 0."""

    past: int
    future: int


def reach(formula: ir.Formula) -> Reach:
    """Return how many samples before and after now a formula requires (lookback and lookahead).

    A window to the end of the trace requires only its first sample. The interval of an operator such as
    `always@[a, b]` counts from the first sample of the trace, wherever the operator stands; the end of the
    interval counts as lookahead.
    """
    past, future, clocked = fold(formula, _REQUIRED)
    return Reach(past, max(future, clocked))


def reach_of(num: ir.Num) -> Reach:
    """Return how many samples before and after now a numeric expression needs in order to be defined."""
    return _offsets([leaf.steps for leaf in _shifts(num) if not leaf.clamped])


def farthest(num: ir.Num) -> Reach:
    """Return how many samples before and after now a numeric expression reads.

    Unlike `reach_of`, this includes signals that repeat their first or last sample outside the trace
    (`clamped`).
    """
    return _offsets([leaf.steps for leaf in _shifts(num)])


def history(formula: ir.Formula) -> int:
    """Return how many samples before now a formula reads; 2^40 stands for all earlier samples.

    Unlike in `reach`, past windows count in full, although they are cut at the start of the trace.
    """
    return fold(formula, _HISTORY)


def _shifts(num: ir.Num) -> list[ir.ShiftedSignal]:
    return [leaf for leaf in leaves(num) if isinstance(leaf, ir.ShiftedSignal)]


def _offsets(steps: Sequence[int]) -> Reach:
    return Reach(max((-step for step in steps if step < 0), default=0), max((0, *steps)))


_Needs: TypeAlias = tuple[int, int, int]
"""Lookback; lookahead; and lookahead of operators such as `always@[a, b]`, counted from the first sample."""


@final
class _Required(Analysis[_Needs]):
    """Analysis of the required samples.

    Windows of the past are cut at the start of the trace, so they require no sample.
    """

    def predicate(self, num: ir.Num) -> _Needs:
        return (*reach_of(num), 0)

    def constant(self) -> _Needs:
        return 0, 0, 0

    def over(self, parts: Sequence[_Needs], offsets: Sequence[ir.Offsets]) -> _Needs:
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
        return farthest(num).past

    def constant(self) -> int:
        return 0

    def over(self, parts: Sequence[int], offsets: Sequence[ir.Offsets]) -> int:
        firsts = [-_EVERYTHING if first is None else first for first, _ in offsets]
        return max(0, *(part - first for part, first in zip(parts, firsts, strict=True)))

    def at_start(self, _body: int) -> int:
        return _EVERYTHING


_EVERYTHING = 1 << 40
"""More samples than any trace has."""
_REQUIRED, _HISTORY = _Required(), _History()


def earliest(formula: ir.Formula) -> tuple[int, int]:
    """Return the latest of the first samples of all future windows: after now, and after the first sample.

    If the trace ends before that sample, some operand of the formula has no value, wherever windows are cut.
    The second number is that of operators such as `always@[a, b]`, which count from the first sample.
    """
    return fold(formula, _EARLIEST)


@final
class _Earliest(Analysis[tuple[int, int]]):
    def constant(self) -> tuple[int, int]:
        return 0, 0

    def over(self, parts: Sequence[tuple[int, int]], offsets: Sequence[ir.Offsets]) -> tuple[int, int]:
        firsts = (max(first or 0, 0) for first, _ in offsets)
        later = max(part[0] + first for part, first in zip(parts, firsts, strict=True))
        return later, max(part[1] for part in parts)

    def shift(self, body: tuple[int, int], _node: ir.Shift) -> tuple[int, int]:
        return body

    def at_start(self, body: tuple[int, int]) -> tuple[int, int]:
        return 0, max(body)


_EARLIEST = _Earliest()


# ---------------------------------------------------------------------------------- signals


def columns_in(node: ir.Num | ir.Formula) -> frozenset[str]:
    """Return the names of the signals that a number or a formula reads, at any sample."""
    read = {leaf.name for leaf in leaves(node) if isinstance(leaf, (ir.Signal, ir.ShiftedSignal))}
    return frozenset(read - {ir.ELAPSED})


def depends_on_ends(num: ir.Num) -> bool:
    """True if a numeric expression depends on where the trace begins or ends.

    This is so if a signal in the expression repeats its first or last sample outside the trace (`clamped`).
    """
    return any(leaf.clamped for leaf in _shifts(num))


def endless(formula: ir.Formula) -> bool:
    """True if a formula has a window to the end of the trace."""
    windowed = (node for node in nodes(formula) if isinstance(node, ir.Windowed))
    return any(node.window.hi is None and not node.back for node in windowed)


def uses_end(formula: ir.Formula) -> bool:
    """True if a formula depends on where the trace ends.

    There are two cases. A window of the formula may extend to the end of the trace. Or a numeric expression
    may read a signal after the last sample, where the last sample is repeated; `sweep`, which reads the next
    sample, is rewritten to such expressions.
    """
    return endless(formula) or any(
        leaf.clamped and leaf.steps > 0 for num in numbers(formula) for leaf in _shifts(num)
    )


# ------------------------------------------------------------------------------ constant tails


def tail(formula: ir.Formula, samples: int, length: int) -> int | None:
    """Return an instant from which on the robustness of a formula is constant, +inf or -inf.

    The trace is open: it continues, but its values beyond the last known sample are unknown. To bound the
    robustness, all predicates there count as +inf, or all as -inf. Most formulas are therefore constant from
    some instant on. An operator whose window extends far beyond that instant needs to read only one instant
    of this constant part.

    Args:
        formula: formula in negation normal form.
        samples: number of known samples.
        length: assumed length of the whole trace in samples; windows to the end of the trace end there.

    Returns:
        The instant, counted in samples from the start of the trace; None if no such instant is known.
    """
    return fold(formula, _Tail(samples, length))


@final
@dataclass(frozen=True, slots=True)
class _Tail(Analysis[int | None]):
    samples: int
    length: int

    def predicate(self, _num: ir.Num) -> int | None:
        return self.samples

    def constant(self) -> int | None:
        return 0

    def over(self, parts: Sequence[int | None], offsets: Sequence[ir.Offsets]) -> int | None:
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
