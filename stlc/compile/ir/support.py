"""The support of a formula: lookback, lookahead and signals.

All are bottom-up analyses: `Analysis` gives the value of a node from those of its operands, `fold` traverses.
Windows of the past are cut at the start of the trace, so they never require missing samples; a window "to the
end" requires only its start.
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
    """Bottom-up analysis: the value of each kind of node, from the values of its operands."""

    @abstractmethod
    def predicate(self, num: ir.Num) -> V:
        """Value of a predicate, or of a number bound by `freeze`."""

    @abstractmethod
    def constant(self) -> V:
        """Value of `true` and `false`."""

    @abstractmethod
    def all_of(self, parts: Sequence[V]) -> V:
        """Value of one or more formulas at the same instant."""

    @abstractmethod
    def ahead(self, body: V, window: ir.Window) -> V:
        """Value of a future window."""

    @abstractmethod
    def back(self, body: V, window: ir.Window) -> V:
        """Value of a past window."""

    @abstractmethod
    def shift(self, body: V, node: ir.Shift) -> V:
        """Value of a shifted formula."""

    @abstractmethod
    def at_start(self, body: V) -> V:
        """Value of a formula at the first sample."""

    def until(self, left: V, right: V, window: ir.Window) -> V:
        """Value of `until`: the right side is read in the window, the left one from now on."""
        return self.all_of((self.ahead(right, window), self.ahead(left, ir.Window(0, window.hi))))

    def since(self, left: V, right: V, window: ir.Window) -> V:
        """Value of `since`, the mirror of `until`."""
        return self.all_of((self.back(right, window), self.back(left, ir.Window(0, window.hi))))

    def freeze(self, bound: Sequence[V], body: V) -> V:
        """Value of a `freeze` with its bound numbers."""
        return self.all_of((body, *bound))


def fold(formula: ir.Formula, analysis: Analysis[V]) -> V:
    """Return the value of a formula under an analysis."""

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
    """Lookback and lookahead in samples."""

    past: int
    future: int


def reach(formula: ir.Formula) -> Reach:
    """Return lookback and lookahead of a formula: the samples required around its instant.

    A window to the end of the trace counts with its start alone. Operators on the mission clock count from
    the first sample, regardless of enclosing operators.
    """
    past, future, clocked = fold(formula, _REQUIRED)
    return Reach(past, max(future, clocked))


def reach_of(num: ir.Num) -> Reach:
    """Return lookback and lookahead of a number: the samples required for it to be defined."""
    return _offsets([leaf.steps for leaf in _shifts(num) if not leaf.clamped])


def farthest(num: ir.Num) -> Reach:
    """Return the samples before and after now that a number reads where they exist."""
    return _offsets([leaf.steps for leaf in _shifts(num)])


def history(formula: ir.Formula) -> int:
    """Return the samples before its instant that a formula reads where they exist; 2^40 means all."""
    return fold(formula, _HISTORY)


def _shifts(num: ir.Num) -> list[ir.ShiftedSignal]:
    return [leaf for leaf in leaves(num) if isinstance(leaf, ir.ShiftedSignal)]


def _offsets(steps: Sequence[int]) -> Reach:
    return Reach(max((-step for step in steps if step < 0), default=0), max((0, *steps)))


_Needs: TypeAlias = tuple[int, int, int]
"""Lookback, lookahead, and lookahead of operators on the mission clock."""


@final
class _Required(Analysis[_Needs]):
    """Required samples; windows of the past are cut at the start of the trace and require none."""

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
"""More samples than any trace has."""
_REQUIRED, _HISTORY = _Required(), _History()


def _last(window: ir.Window) -> int:
    return window.lo if window.hi is None else window.hi


# ---------------------------------------------------------------------------------- signals


def columns_of(num: ir.Num) -> frozenset[str]:
    """Return the names of the signals that a number reads, at any sample."""
    read = {leaf.name for leaf in leaves(num) if isinstance(leaf, (ir.Signal, ir.ShiftedSignal))}
    return frozenset(read - {ir.ELAPSED})


def columns(formula: ir.Formula) -> frozenset[str]:
    """Return the names of the signals that a formula reads."""
    return frozenset(name for num in numbers(formula) for name in columns_of(num))


def looks_at_ends(num: ir.Num) -> bool:
    """True if a number depends on where the trace begins or ends."""
    return any(leaf.clamped for leaf in _shifts(num))


def looks_on(num: ir.Num) -> bool:
    """True if a number depends on where the trace ends."""
    return any(leaf.clamped and leaf.steps > 0 for leaf in _shifts(num))


def uses_end(formula: ir.Formula) -> bool:
    """True if a future window extends to the end of the trace, or a `sweep` is clamped there."""
    ahead = (node.window for node in nodes(formula) if isinstance(node, (ir.Temporal, ir.Until)))
    return any(window.hi is None for window in ahead) or any(map(looks_on, numbers(formula)))


# ------------------------------------------------------------------------------ steady tails


def tail(formula: ir.Formula, samples: int, length: int) -> int | None:
    """Return an instant from which a formula is constant, +inf or -inf, on an open trace; None: unknown.

    Beyond the last sample all predicates are unknown and so are formulas of them alone: a window far beyond a
    short trace needs one such instant instead of all.

    Args:
        formula: in negation normal form.
        samples: number of known samples.
        length: end of windows to the end of the trace.
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
        """Tail of a future window; one to the end is unknown where it starts beyond the end."""
        if body is None:
            return None
        return max(body - window.lo, 0 if window.hi is not None else self.length - window.lo, 0)

    def back(self, body: int | None, window: ir.Window) -> int | None:
        """Tail of a past window; one from the start covers all known samples."""
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
