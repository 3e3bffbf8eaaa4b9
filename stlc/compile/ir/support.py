"""The support of a formula: lookback, lookahead and signals.

All of them follow a formula from its predicates up. `Analysis` says what the value of a node is, given those
of its operands; `fold` walks. Windows of the past are cut at the start of the trace, so they never ask for
samples that do not exist; a window "to the end" takes what there is from its start on.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeAlias, TypeVar, assert_never, final

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import leaves, nodes, numbers

V = TypeVar("V")


class Analysis(ABC, Generic[V]):
    """The value of every kind of node, from the values of its operands."""

    @abstractmethod
    def predicate(self, num: ir.Num) -> V:
        """Of a predicate, or of a number that `freeze` binds."""

    @abstractmethod
    def constant(self) -> V:
        """Of `true` and `false`."""

    @abstractmethod
    def all_of(self, parts: Sequence[V]) -> V:
        """Of one or more formulas at the same instant."""

    @abstractmethod
    def ahead(self, body: V, window: ir.Window) -> V:
        """Of a window of the future."""

    @abstractmethod
    def back(self, body: V, window: ir.Window) -> V:
        """Of a window of the past."""

    @abstractmethod
    def shift(self, body: V, node: ir.Shift) -> V:
        """Of the value some samples later."""

    @abstractmethod
    def at_start(self, body: V) -> V:
        """Of the value at the first sample."""

    def until(self, left: V, right: V, window: ir.Window) -> V:
        """`until` reads its right side in the window, its left one from now on."""
        return self.all_of((self.ahead(right, window), self.ahead(left, ir.Window(0, window.hi))))

    def since(self, left: V, right: V, window: ir.Window) -> V:
        """`since` is the mirror of `until`."""
        return self.all_of((self.back(right, window), self.back(left, ir.Window(0, window.hi))))

    def freeze(self, bound: Sequence[V], body: V) -> V:
        """Of values that are frozen for a formula."""
        return self.all_of((body, *bound))


def fold(formula: ir.Formula, analysis: Analysis[V]) -> V:
    """The value of a formula under an analysis."""

    def of(part: ir.Formula) -> V:
        return fold(part, analysis)

    match formula:
        case ir.Truth():
            return analysis.constant()
        case ir.Predicate(num):
            return analysis.predicate(num)
        case ir.BoolOp(_, items):
            return analysis.all_of([of(item) for item in items])
        case ir.Temporal(_, window, body) | ir.PastTemporal(_, window, body):
            windowed = analysis.ahead if isinstance(formula, ir.Temporal) else analysis.back
            return windowed(of(body), window)
        case ir.Until(_, window, left, right) | ir.Since(_, window, left, right):
            met = analysis.until if isinstance(formula, ir.Until) else analysis.since
            return met(of(left), of(right), window)
        case ir.Shift(_, body):
            return analysis.shift(of(body), formula)
        case ir.Freeze(bindings, body):
            return analysis.freeze([analysis.predicate(num) for _, num in bindings], of(body))
        case ir.AtStart(body):
            return analysis.at_start(of(body))
        case _:
            assert_never(formula)


# ------------------------------------------------------------------- lookback and lookahead


class Reach(NamedTuple):
    """Samples before and after the one at hand: lookback and lookahead."""

    past: int
    future: int


def reach(formula: ir.Formula) -> Reach:
    """The lookback and the lookahead of a formula: the samples that have to exist around its instant.

    A window to the end of the trace counts with its start alone. What is on the mission clock counts from the
    first sample on, whatever stands around it.
    """
    past, future, clocked = fold(formula, _REQUIRED)
    return Reach(past, max(future, clocked))


def reach_of(num: ir.Num) -> Reach:
    """The lookback and the lookahead of a number: the samples that have to exist for it to have a value."""
    return _offsets([leaf.steps for leaf in _shifts(num) if not leaf.clamped])


def farthest(num: ir.Num) -> Reach:
    """The samples before and after the one at hand that a number reads where they exist."""
    return _offsets([leaf.steps for leaf in _shifts(num)])


def history(formula: ir.Formula) -> int:
    """The samples before its instant that a formula reads where they exist; 2^40 stands for all of them."""
    return fold(formula, _HISTORY)


def _shifts(num: ir.Num) -> list[ir.ShiftedSignal]:
    return [leaf for leaf in leaves(num) if isinstance(leaf, ir.ShiftedSignal)]


def _offsets(steps: Sequence[int]) -> Reach:
    return Reach(max((-step for step in steps if step < 0), default=0), max((0, *steps)))


_Needs: TypeAlias = tuple[int, int, int]
"""Lookback, lookahead, and the lookahead of what is on the mission clock."""


@final
class _Required(Analysis[_Needs]):
    """Samples that have to exist: windows of the past are cut at the start, which they do not need."""

    def predicate(self, num: ir.Num) -> _Needs:
        return (*reach_of(num), 0)

    def constant(self) -> _Needs:
        return 0, 0, 0

    def all_of(self, parts: Sequence[_Needs]) -> _Needs:
        past, future, clocked = (max(values) for values in zip(*parts, strict=True))
        return past, future, clocked

    def ahead(self, body: _Needs, window: ir.Window) -> _Needs:
        return max(body[0] - window.lo, 0), body[1] + _last(window), body[2]

    def back(self, body: _Needs, window: ir.Window) -> _Needs:
        return body[0] + _last(window), max(body[1] - window.lo, 0), body[2]

    def shift(self, body: _Needs, node: ir.Shift) -> _Needs:
        return max(body[0] - node.steps, 0), max(body[1] + node.steps, 0), body[2]

    def at_start(self, body: _Needs) -> _Needs:
        return 0, 0, max(body[1], body[2])


@final
class _History(Analysis[int]):
    """Samples before the instant that are read where they exist."""

    def predicate(self, num: ir.Num) -> int:
        return farthest(num).past

    def constant(self) -> int:
        return 0

    def all_of(self, parts: Sequence[int]) -> int:
        return max(parts)

    def ahead(self, body: int, window: ir.Window) -> int:
        return max(body - window.lo, 0)

    def back(self, body: int, window: ir.Window) -> int:
        return body + (_EVERYTHING if window.hi is None else window.hi)

    def shift(self, body: int, node: ir.Shift) -> int:
        return max(body - node.steps, 0)

    def at_start(self, body: int) -> int:  # noqa: ARG002
        return _EVERYTHING


_EVERYTHING = 1 << 40
"""More samples than any record has."""
_REQUIRED, _HISTORY = _Required(), _History()


def _last(window: ir.Window) -> int:
    return window.lo if window.hi is None else window.hi


# ---------------------------------------------------------------------------------- signals


def columns_of(num: ir.Num) -> frozenset[str]:
    """Names of the signals that a number reads, at whatever sample."""
    read = {leaf.name for leaf in leaves(num) if isinstance(leaf, (ir.Signal, ir.ShiftedSignal))}
    return frozenset(read - {ir.ELAPSED})


def columns(formula: ir.Formula) -> frozenset[str]:
    """Names of the signals that a formula reads."""
    return frozenset(name for num in numbers(formula) for name in columns_of(num))


def looks_at_ends(num: ir.Num) -> bool:
    """True if the value of a number depends on where the trace begins, or on where it ends."""
    return any(leaf.clamped for leaf in _shifts(num))


def looks_on(num: ir.Num) -> bool:
    """True if the value of a number depends on where the trace ends."""
    return any(leaf.clamped and leaf.steps > 0 for leaf in _shifts(num))


def uses_end(formula: ir.Formula) -> bool:
    """True if a window of the future runs to the end of the trace, or a segment would leave it (`sweep`)."""
    ahead = (node.window for node in nodes(formula) if isinstance(node, (ir.Temporal, ir.Until)))
    return any(window.hi is None for window in ahead) or any(map(looks_on, numbers(formula)))


# ------------------------------------------------------------------------------ steady tails


def tail(formula: ir.Formula, samples: int, length: int) -> int | None:
    """An instant from which on a formula has one value, +inf or -inf, on a trace that goes on; None: unknown.

    Beyond the last sample every predicate is unknown, and so is what is made of nothing else: a window that
    looks far beyond a short trace needs one such instant, and not all of them.

    Args:
        formula: in negation normal form.
        samples: how many are known.
        length: where windows to the end of the trace end.
    """
    return fold(formula, _Tail(samples, length))


@final
@dataclass(frozen=True, slots=True)
class _Tail(Analysis[int | None]):
    samples: int
    length: int

    def predicate(self, num: ir.Num) -> int | None:  # noqa: ARG002
        return self.samples

    def constant(self) -> int | None:
        return 0

    def all_of(self, parts: Sequence[int | None]) -> int | None:
        known = [part for part in parts if part is not None]
        return max(known) if len(known) == len(parts) else None

    def ahead(self, body: int | None, window: ir.Window) -> int | None:
        """A window to the end is unknown where it starts beyond the end."""
        if body is None:
            return None
        return max(body - window.lo, 0 if window.hi is not None else self.length - window.lo, 0)

    def back(self, body: int | None, window: ir.Window) -> int | None:
        """A window from the start on has seen everything that is known."""
        return None if body is None else body + (window.hi if window.hi is not None else window.lo + 1)

    def until(self, left: int | None, right: int | None, window: ir.Window) -> int | None:
        whole = self.all_of((left, right))
        return None if whole is None else max(whole, 0 if window.hi is not None else self.length - window.lo)

    def since(self, left: int | None, right: int | None, window: ir.Window) -> int | None:
        return self.back(self.all_of((left, right)), window)

    def shift(self, body: int | None, node: ir.Shift) -> int | None:
        return None if body is None else max(body - node.steps, -node.steps, 0)

    def freeze(self, bound: Sequence[int | None], body: int | None) -> int | None:  # noqa: ARG002
        return None

    def at_start(self, body: int | None) -> int | None:  # noqa: ARG002
        return None
