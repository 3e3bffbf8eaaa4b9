"""How the value of a formula follows from the values of its parts; one method a kind of node."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import assert_never, final

from stlc.compile import ir
from stlc.compile.ops import Array
from stlc.compile.schedule import Extent, Run, Step
from stlc.compile.semantics import Pick
from stlc.compile.windows import Windows, dual, neutral

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


@final
@dataclass(frozen=True, slots=True)
class Machine:
    """Values `(count, batch)` of formulas on one trace.

    Attributes:
        extent: of the trace.
        windows: the algorithms, with semantics and array library.
        like: any column, for shape, dtype and device.
    """

    extent: Extent
    windows: Windows
    like: Array

    def constant(self, rows: int, value: float) -> Array:
        """`rows` rows of `value`."""
        return self.windows.ops.full((rows, *self.like.shape[1:]), value, self.like)

    @property
    def unknown(self) -> float:
        """What stands for what nobody knows yet."""
        return math.inf if self.extent.end == "upper" else -math.inf

    def atom(self, node: ir.Atom, run: Run, known: Array | None, missing: int = 0) -> Array:
        """A predicate: `known` are the rows that have a value, `missing` rows after the first of `run`.

        They are signed already. Beyond the trace a predicate is unknown, and false where windows are cut.
        """
        outside = self.unknown if self.extent.open else -node.sign * math.inf
        if known is None:
            return self.constant(run.count, outside)
        ops = self.windows.ops
        if node.guard:
            known = ops.infinite(ops.gt(known, 0.0) if node.strict else ops.ge(known, 0.0), known)
        known = self.windows.padded(known, run.count - missing, outside)
        return ops.cat([self.constant(missing, outside), known]) if missing else known

    def value(self, step: Step, parts: Sequence[Array | None]) -> Array:
        """Any other node, from the values of its parts (None: at no instant)."""
        node, run = step.node, step.run
        match node:
            case ir.Truth(value):
                return self.constant(run.count, math.inf if value else -math.inf)
            case ir.Join(op):
                items = [part for part in parts if part is not None]
                return self.windows.semantics.join(items, _PICK[op], self.windows.ops)
            case ir.Over(op, window):
                return self._future(window, run, parts, _PICK[op])
            case ir.Until(op, window):
                return self._future(window, run, parts, _PICK[op])
            case ir.Past(op, window):
                return self._past(window, run, parts, _PICK[op])
            case ir.Since(op, window):
                return self._past(window, run, parts, _PICK[op])
            case ir.Shift():
                return self._shift(node, run, parts[0])
            case ir.Atom() | ir.Freeze():
                raise TypeError("predicates and frozen values come from programs")
            case _:
                assert_never(node)

    def _future(self, window: ir.Window, run: Run, parts: Sequence[Array | None], pick: Pick) -> Array:
        """Windows of the future; those "to the end" that start beyond it are unknown on an open trace."""
        rows = run.count
        beyond = neutral(pick)
        if self.extent.open and window.hi is None:
            rows = min(rows, self.extent.samples - window.lo - run.start)
            beyond = self.unknown
        arrays = [part for part in parts if part is not None]
        if rows <= 0 or not arrays:
            return self.constant(run.count, beyond)
        return self.windows.padded(self._windows(arrays, window, pick, rows), run.count, beyond)

    def _past(self, window: ir.Window, run: Run, parts: Sequence[Array | None], pick: Pick) -> Array:
        """Windows of the past: the same, with time reversed."""
        arrays = [part for part in parts if part is not None]
        if not arrays:
            return self.constant(run.count, neutral(pick))
        if run.count == 1 and len(arrays) == 1:
            return self.windows.semantics.reduce(arrays[0], pick, self.windows.ops)
        flip = self.windows.ops.flip
        return flip(self._windows([flip(array) for array in arrays], window, pick, run.count))

    def _windows(self, arrays: list[Array], window: ir.Window, pick: Pick, rows: int) -> Array:
        """One operand: its extrema. Two: `until` from `window.lo` on, and the left one holds up to there."""
        right = arrays[-1]
        width = len(right) if window.hi is None else window.hi - window.lo + 1
        if len(arrays) == 1:
            return self.windows.extrema(right, pick, count=rows, width=width)
        left = arrays[0]
        later = left[window.lo :] if window.lo else left
        reached = self.windows.until(later, right, pick, count=rows, width=width)
        if not window.lo:
            return reached
        held = self.windows.extrema(left, dual(pick), count=rows, width=window.lo)
        return self.windows.semantics.pair(held, reached, dual(pick), self.windows.ops)

    def _shift(self, node: ir.Shift, run: Run, body: Array | None) -> Array:
        if node.outside is not None:
            outside = math.inf if node.outside else -math.inf
        elif self.extent.open:
            outside = self.unknown
        else:
            outside = math.inf if node.weak else -math.inf
        if body is None:
            return self.constant(run.count, outside)
        before = min(max(-(run.start + node.steps), 0), run.count)
        after = run.count - before - len(body)
        parts = [self.constant(before, outside)] if before else []
        parts.append(body)
        if after:
            parts.append(self.constant(after, outside))
        return self.windows.ops.cat(parts) if len(parts) > 1 else body
