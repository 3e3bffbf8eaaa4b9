"""How the value of a formula follows from the values of its parts: steps of a schedule become functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, assert_never, final

import numpy as np

from stlc.compile.backends.array.namespace import Array
from stlc.compile.backends.array.windows import Windows, neutral
from stlc.compile.ir import nodes as ir
from stlc.compile.schedule.schedule import Extent, Run, Step
from stlc.compile.semantics.semantics import Pick

Kernel: TypeAlias = Callable[[Sequence[Array], Array], Array]
"""The values of the parts that exist, and any column for shape, dtype and device -> `(count, batch)`."""

_PICK: Mapping[str, Pick] = {
    "and": "min",
    "always": "min",
    "historically": "min",
    "release": "min",
    "trigger": "min",
    "or": "max",
    "eventually": "max",
    "once": "max",
    "until": "max",
    "since": "max",
}

_ENDLESS = 1 << 60
"""Rows of a window to the end of the trace: more than there are."""


@final
@dataclass(frozen=True, slots=True)
class Machine:
    """Makes functions of steps, for traces of one length.

    Attributes:
        extent: of the traces.
        windows: the algorithms, with semantics and array library.
    """

    extent: Extent
    windows: Windows

    @property
    def unknown(self) -> float:
        """What stands for what nobody knows yet; a number each where two traces are its two ends."""
        if self.extent.end == "both":
            both: Any = np.array([-math.inf, math.inf])
            return both  # type: ignore[no-any-return]
        return math.inf if self.extent.end == "upper" else -math.inf

    def atom(self, node: ir.Predicate, run: Run, inside: Run) -> Kernel:
        """A predicate; its one part are the rows at the instants `inside`, signed, if there are any.

        Beyond the trace a predicate is unknown, and false where windows are cut.
        """
        outside = self.unknown if self.extent.open else -node.sign * math.inf
        if inside.count <= 0:
            return self._constant(run.count, outside)
        ops, padded = self.windows.ops, self.windows.padded
        missing = inside.start - run.start
        whole = inside.count == run.count

        def kernel(parts: Sequence[Array], like: Array) -> Array:
            known = parts[0]
            if node.guard:
                known = ops.infinite(ops.gt(known, 0.0) if node.strict else ops.ge(known, 0.0), known)
            if whole:
                return known
            known = padded(known, run.count - missing, outside)
            if not missing:
                return known
            return ops.cat([ops.full((missing, *like.shape[1:]), outside, like), known])

        return kernel

    def bind(self, step: Step) -> Kernel:
        """Any other node."""
        node, run = step.node, step.run
        operands = sum(part is not None for part in step.parts)
        match node:
            case ir.Truth(value):
                return self._constant(run.count, math.inf if value else -math.inf)
            case ir.BoolOp(op):
                pick, ops, join = _PICK[op], self.windows.ops, self.windows.semantics.join
                return lambda parts, _: join(parts, pick, ops)
            case ir.Temporal(op, window) | ir.Until(op, window):
                return self._future(window, run, operands, _PICK[op])
            case ir.PastTemporal(op, window) | ir.Since(op, window):
                return self._past(window, run, operands, _PICK[op])
            case ir.Shift():
                return self._shift(node, run, operands)
            case ir.AtStart():
                return self._repeated(run.count)
            case ir.Predicate() | ir.Freeze():
                raise TypeError("predicates and frozen values come from programs")
            case _:
                assert_never(node)

    def _constant(self, rows: int, value: float) -> Kernel:
        full = self.windows.ops.full
        return lambda _, like: full((rows, *like.shape[1:]), value, like)

    def _repeated(self, rows: int) -> Kernel:
        full = self.windows.ops.full
        return lambda parts, like: parts[0] + full((rows, *like.shape[1:]), 0.0, like)

    def _future(self, window: ir.Window, run: Run, operands: int, pick: Pick) -> Kernel:
        """Windows of the future; those "to the end" that start beyond it are unknown on an open trace."""
        rows = run.count
        beyond = neutral(pick)
        if self.extent.open and window.hi is None:
            rows = min(rows, self.extent.length - window.lo - run.start)
            beyond = self.unknown
        if rows <= 0 or not operands:
            return self._constant(run.count, beyond)
        inner, padded = self._windows(window, operands, pick, rows), self.windows.padded
        if rows == run.count:
            return inner
        return lambda parts, like: padded(inner(parts, like), run.count, beyond)

    def _past(self, window: ir.Window, run: Run, operands: int, pick: Pick) -> Kernel:
        """Windows of the past: the same, with time reversed."""
        ops, reduce = self.windows.ops, self.windows.semantics.reduce
        if not operands:
            return self._constant(run.count, neutral(pick))
        if run.count == 1 and operands == 1:
            return lambda parts, _: reduce(parts[0], pick, ops)
        inner, flip = self._windows(window, operands, pick, run.count), ops.flip
        return lambda parts, like: flip(inner([flip(part) for part in parts], like))

    def _windows(self, window: ir.Window, operands: int, pick: Pick, rows: int) -> Kernel:
        """One operand: its extrema. Two: `until` from `window.lo` on, and the left one holds up to there."""
        extrema, until, lo = self.windows.extrema, self.windows.until, window.lo
        most = _ENDLESS if window.hi is None else window.hi - lo + 1
        if operands == 1:
            return lambda parts, _: extrema(parts[0], pick, count=rows, width=most)
        return lambda parts, _: until(parts[0], parts[1], pick, count=rows, width=most, lo=lo)

    def _shift(self, node: ir.Shift, run: Run, operands: int) -> Kernel:
        if node.outside is not None:
            outside = math.inf if node.outside else -math.inf
        elif self.extent.open:
            outside = self.unknown
        else:
            outside = math.inf if node.weak else -math.inf
        if not operands:
            return self._constant(run.count, outside)
        before = min(max(-(run.start + node.steps), 0), run.count)
        ops = self.windows.ops

        def kernel(parts: Sequence[Array], like: Array) -> Array:
            body = parts[0]
            after = run.count - before - body.shape[0]
            rest = [ops.full((rows, *like.shape[1:]), outside, like) for rows in (before, after) if rows]
            if not rest:
                return body
            return ops.cat([*rest[: bool(before)], body, *rest[bool(before) :]])

        return kernel
