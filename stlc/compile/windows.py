"""Extrema over windows of time, the algorithms: reductions, running extrema, doubling, scans.

All arrays are `(time, batch)`. Window `j` of `count` starts at row `j` and has `width` rows; rows beyond the
array are absent, and a window without rows has the neutral value (+inf for a minimum, -inf for a maximum).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

from stlc.compile.ops import Array, Ops
from stlc.compile.semantics import Pick, Semantics

_SCAN_BATCH = 64
"""From this batch size on a sequential scan beats the log-depth one."""


def dual(pick: Pick) -> Pick:
    """The other extremum."""
    return "max" if pick == "min" else "min"


def neutral(pick: Pick) -> float:
    """The extremum of nothing."""
    return math.inf if pick == "min" else -math.inf


@final
@dataclass(frozen=True, slots=True)
class Windows:
    """Windowed extrema under one semantics, on one array library."""

    semantics: Semantics
    ops: Ops

    def padded(self, x: Array, rows: int, value: float) -> Array:
        """The first `rows` rows of `x`, with rows of `value` behind it where it is shorter."""
        if len(x) >= rows:
            return x[:rows] if len(x) > rows else x
        missing = self.ops.full((rows - len(x), *x.shape[1:]), value, x)
        return self.ops.cat([x, missing]) if len(x) else missing

    def extrema(self, x: Array, pick: Pick, *, count: int, width: int) -> Array:
        """`count` windows of `width` rows: `(time, batch)` -> `(count, batch)`."""
        width = min(width, max(len(x), 1))
        if count == 1 and len(x):
            return self.semantics.reduce(self.padded(x, width, neutral(pick)), pick, self.ops)
        if width >= len(x) > 1 and self.semantics.idempotent:
            return self.padded(self._to_end(x, pick), count, neutral(pick))
        return self._doubling(self.padded(x, count + width - 1, neutral(pick)), pick, width)

    def _to_end(self, x: Array, pick: Pick) -> Array:
        """Every window reaches the last row: a running extremum from behind."""
        running = self.ops.cummin if pick == "min" else self.ops.cummax
        return self.ops.flip(running(self.ops.flip(x)))

    def _doubling(self, x: Array, pick: Pick, width: int) -> Array:
        """Full windows only, in about log2(width) operations: pieces of 1, 2, 4, … rows are put together."""
        piece, size, done, total = x, 1, 0, None
        while True:
            if self.semantics.idempotent and 2 * size > width:
                return self._overlapped(piece, pick, width - size)
            if width & size:
                part = piece[done:] if done else piece
                total = part if total is None else self._joined(total, part, pick)
                done += size
                if done == width:
                    return total
            piece = self._joined(piece, piece[size:], pick)
            size *= 2

    def _joined(self, a: Array, b: Array, pick: Pick) -> Array:
        rows = min(len(a), len(b))
        return self.semantics.pair(a[:rows], b[:rows], pick, self.ops)

    def _overlapped(self, piece: Array, pick: Pick, shift: int) -> Array:
        return self._joined(piece, piece[shift:], pick) if shift else piece

    def until(self, left: Array, right: Array, pick: Pick, *, count: int, width: int) -> Array:
        """`until` for `pick` "max", its dual `release` for "min".

        Row `j` is the extremum over rows `t` of window `j` of the dual extremum of `right[t]` and of
        `left[j..t]`.

        Args:
            left: what must hold up to and including `t`; `(time, batch)`.
            right: what must hold at `t`; as long as `left`.
            pick: "max" or "min".
            count: number of windows.
            width: rows of a window.

        Returns:
            `(count, batch)`
        """
        rows = len(left)
        width = min(width, max(rows, 1))
        if count == 1 and rows:
            return self._until_once(left[:width], right[:width], pick)
        if width >= rows > 0 and (rows <= _SCAN_BATCH or left[0].shape[0] >= _SCAN_BATCH):
            return self.padded(self._until_to_end(left, right, pick, min(rows, count)), count, neutral(pick))
        left = self.padded(left, count + width - 1, neutral(dual(pick)))
        right = self.padded(right, count + width - 1, neutral(pick))
        return self._until_doubling(left, self.semantics.pair(left, right, dual(pick), self.ops), pick, width)

    def _until_once(self, left: Array, right: Array, pick: Pick) -> Array:
        pair, other = self.semantics.pair, dual(pick)
        if not self.semantics.idempotent:
            return self._until_doubling(left, pair(left, right, other, self.ops), pick, len(left))
        held = (self.ops.cummin if pick == "max" else self.ops.cummax)(left)
        return self.semantics.reduce(pair(held, right, other, self.ops), pick, self.ops)

    def _until_to_end(self, left: Array, right: Array, pick: Pick, count: int) -> Array:
        """The recursion `u(t) = min(left(t), max(right(t), u(t + 1)))`, from behind."""
        pair, other = self.semantics.pair, dual(pick)
        row = pair(left[-1:], right[-1:], other, self.ops)
        out = [row]
        for t in range(len(left) - 2, -1, -1):
            reached = pair(right[t : t + 1], row, pick, self.ops)
            row = pair(left[t : t + 1], reached, other, self.ops)
            out.append(row)
        rows = out[: -count - 1 : -1]
        return rows[0] if count == 1 else self.ops.cat(rows)

    def _until_doubling(self, held: Array, met: Array, pick: Pick, width: int) -> Array:
        """Full windows, in about log2(width) compositions of (`left` holds throughout, met within).

        `total` covers the first `done` rows of every window, `met` the `size` rows from every row on.
        """
        size, done = 1, 0
        total: tuple[Array, Array] | None = None
        while True:
            if width & size:
                part = (held[done:], met[done:])
                total = part if total is None else self._composed(total, part, pick)
                done += size
                if done == width:
                    return total[1]
            held, met = self._composed((held, met), (held[size:], met[size:]), pick)
            size *= 2

    def _composed(self, a: tuple[Array, Array], b: tuple[Array, Array], pick: Pick) -> tuple[Array, Array]:
        """First window `a`, then window `b`: `left` holds through both, or it is met in one of them."""
        rows = min(len(a[0]), len(b[0]))
        pair, other = self.semantics.pair, dual(pick)
        later = pair(a[0][:rows], b[1][:rows], other, self.ops)
        met = pair(a[1][:rows], later, pick, self.ops)
        return pair(a[0][:rows], b[0][:rows], other, self.ops), met
