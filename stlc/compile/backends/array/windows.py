"""Extrema over time windows.

The method depends on the windows: a reduction over time, the C kernel, running extrema, or merging blocks of
1, 2, 4, … rows. All arrays are `(time, batch)`. Window `j` of `count` starts at row `j` and has `width` rows;
it ends with the last row of the array at the latest. A window without rows has the neutral value (+inf for a
minimum, -inf for a maximum).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

from stlc.compile.backends.schedule import dual, neutral
from stlc.compile.namespace import Array, Ops, Pick, Sliding
from stlc.compile.semantics.semantics import Parts, Semantics

_SCAN_BATCH = 64
"""Batch size from which a sequential scan beats the log-depth one."""

_TILE = 1 << 17
"""Elements per tile of a long trace, so that intermediate results stay in cache."""

_OVERLAP = 8
"""Minimum tile length, in window widths."""


@final
@dataclass(frozen=True, slots=True)
class Windows:
    """Algorithms for extrema over time windows, for a given semantics and array library.

    Attributes:
        semantics: definition of min and max, exact or smooth.
        ops: the array library.
    """

    semantics: Semantics
    ops: Ops

    def padded(self, x: Array, rows: int, value: float) -> Array:
        """The first `rows` rows of `x`; if `x` has fewer, rows filled with `value` are appended."""
        if x.shape[0] >= rows:
            return x[:rows] if x.shape[0] > rows else x
        missing = self.ops.full((rows - x.shape[0], *x.shape[1:]), value, x)
        return self.ops.cat([x, missing]) if x.shape[0] else missing

    def extrema(self, x: Array, pick: Pick, *, count: int, width: int) -> Array:
        """Extrema over `count` sliding windows of `width` rows: `(time, batch)` -> `(count, batch)`.

        `pick` is "max" or "min".
        """
        rows = x.shape[0]
        width = min(width, max(rows, 1))
        if tiles := self._tiles(x, count, width):
            out = self.ops.empty((count, *x.shape[1:]), x)
            for asked, seen in tiles:
                out[asked] = self.extrema(x[seen], pick, count=asked.stop - asked.start, width=width)
            return out
        if count == 1 and rows:
            return self.semantics.reduce(self.padded(x, width, neutral(pick)), pick, self.ops)
        if self.semantics.exact and rows:
            found = self.ops.extrema(x, pick, Sliding(rows, min(count, rows), width))
            if found is not None:
                return self.padded(found, count, neutral(pick))
        if width >= rows > 1 and self.semantics.idempotent:
            return self.padded(self._to_end(x, pick), count, neutral(pick))
        return self._doubling(self.padded(x, count + width - 1, neutral(pick)), pick, width)

    def _tiles(self, x: Array, count: int, width: int) -> list[tuple[slice, slice]]:
        """Divide the computation on a long trace into tiles, which are computed one after the other.

        Returns a pair of slices for each tile: the windows to compute, and the rows that these windows read.
        The list is empty if no division is needed.
        """
        if self.ops.name != "numpy" or not self.semantics.exact:
            return []
        size = max(_TILE // max(math.prod(x.shape[1:]), 1), _OVERLAP * width)
        if count < 2 * size:
            return []
        asked = [slice(first, min(first + size, count)) for first in range(0, count, size)]
        return [(some, slice(some.start, some.stop + width - 1)) for some in asked]

    def _to_end(self, x: Array, pick: Pick) -> Array:
        """Extrema over windows that all extend to the last row: running extrema, backward in time."""
        running = self.ops.cummin if pick == "min" else self.ops.cummax
        return self.ops.flip(running(self.ops.flip(x)))

    def _doubling(self, x: Array, pick: Pick, width: int) -> Array:
        """Extrema over windows of `width` rows, in about log2(width) merges of blocks of 1, 2, 4, … rows.

        Every window must lie within the array.
        """
        if width == 1:
            return x
        piece, size, done = self.semantics.lift(x, pick, self.ops), 1, 0
        total: Parts | None = None
        overlapping = self.semantics.idempotent
        while True:
            if overlapping and 2 * size > width:
                total = self._merged(piece, piece, width - size, pick) if width > size else piece
                break
            if width & size and not overlapping:
                total = piece if total is None else self._merged(total, piece, done, pick)
                done += size
                if done == width:
                    break
            piece = self._merged(piece, piece, size, pick)
            size *= 2
        return self.semantics.finish(total, pick, self.ops)

    def _merged(self, a: Parts, b: Parts, shift: int, pick: Pick) -> Parts:
        """Join each block of rows in `a` with the block in `b` that starts `shift` rows later.

        `a` and `b` contain partial results (`Parts`), from which the semantics computes an extremum. Row j is
        the partial result of the block that starts at row j. The joined blocks are returned in the same form.
        """
        rows = min(a[0].shape[0], b[0].shape[0] - shift)
        return self.semantics.merge(
            tuple(part[:rows] for part in a), tuple(part[shift : shift + rows] for part in b), pick, self.ops
        )

    def until(self, left: Array, right: Array, pick: Pick, *, count: int, width: int, lo: int = 0) -> Array:
        """Robustness of `until` (for `pick` "max") or of its dual `release` (for "min") over windows.

        For `until`, row `j` of the result is the maximum of `min(right[t], left[j], …, left[lo + t])` over
        all rows `t` of window `j`. For `release`, minimum and maximum are exchanged.

        Args:
            left: operand that must hold up to and including `t`; `(time, batch)`.
            right: operand that must hold at `t`; its row 0 belongs to row `lo` of `left`.
            pick: "max" or "min".
            count: number of windows.
            width: number of rows of a window.
            lo: number of rows of `left` before the window.

        Returns:
            One row per window, `(count, batch)`.
        """
        rows = right.shape[0]
        width = min(width, max(rows, 1))
        if not self.semantics.exact:
            return self._until_by_definition(left, right, pick, (count, width, lo))
        if lo:
            reached = self.until(left[lo:], right, pick, count=count, width=width)
            held = self.extrema(left, dual(pick), count=count, width=lo)
            return self.semantics.pair(held, reached, dual(pick), self.ops)
        if width >= rows and (tiles := self._tiles(left, min(count, rows), 1)):
            return self.padded(self._until_by_tiles(left, right, pick, tiles), count, neutral(pick))
        if tiles := self._tiles(left, count, width):
            out = self.ops.empty((count, *left.shape[1:]), left)
            for asked, seen in tiles:
                many = asked.stop - asked.start
                out[asked] = self.until(left[seen], right[seen], pick, count=many, width=width)
            return out
        if count == 1 and rows:
            return self._until_once(left[:width], right[:width], pick)
        if rows:
            found = self.ops.until(left, right, pick, Sliding(rows, min(count, rows), width))
            if found is not None:
                return self.padded(found, count, neutral(pick))
        if width >= rows > 0 and (rows <= _SCAN_BATCH or left[0].shape[0] >= _SCAN_BATCH):
            return self.padded(self._until_to_end(left, right, pick, min(rows, count)), count, neutral(pick))
        left = self.padded(left, count + width - 1, neutral(dual(pick)))
        right = self.padded(right, count + width - 1, neutral(pick))
        return self._until_doubling(left, self.semantics.pair(left, right, dual(pick), self.ops), pick, width)

    def _until_once(self, left: Array, right: Array, pick: Pick) -> Array:
        pair, other = self.semantics.pair, dual(pick)
        held = (self.ops.cummin if pick == "max" else self.ops.cummax)(left)
        return self.semantics.reduce(pair(held, right, other, self.ops), pick, self.ops)

    def _until_by_definition(
        self, left: Array, right: Array, pick: Pick, sizes: tuple[int, int, int]
    ) -> Array:
        """Compute `until` by its definition, for extrema that are not exact.

        Faster methods assume that min distributes over max, which is true of exact extrema only. A loop runs
        over the samples of the window. Each of its `lo + width` iterations works on all `count` windows at
        once. `sizes` is (count, width, lo), as in `until`.
        """
        semantics, ops, other = self.semantics, self.ops, dual(pick)
        count, width, lo = sizes
        left = self.padded(left, count + lo + width - 1, neutral(other))
        right = self.padded(right, count + width - 1, neutral(pick))
        if count == 1 and semantics.associative:
            held_so_far = self._from_first(left, other)[lo:]
            return semantics.reduce(semantics.pair(held_so_far, right, other, ops), pick, ops)
        held, found = semantics.lift(left[:count], other, ops), None
        for ahead in range(lo + width):
            if ahead:
                held = semantics.merge(
                    held, semantics.lift(left[ahead : ahead + count], other, ops), other, ops
                )
            if ahead < lo:
                continue
            here = right[ahead - lo : ahead - lo + count]
            met = semantics.lift(
                semantics.pair(semantics.finish(held, other, ops), here, other, ops), pick, ops
            )
            found = met if found is None else semantics.merge(found, met, pick, ops)
        assert found is not None
        return semantics.finish(found, pick, ops)

    def _from_first(self, x: Array, pick: Pick) -> Array:
        """Running extremum from the first row on, in about log2(rows) operations."""
        size = 1
        while size < x.shape[0]:
            later = self.semantics.pair(x[size:], x[:-size], pick, self.ops)
            x, size = self.ops.cat([x[:size], later]), 2 * size
        return x

    def _until_to_end(self, left: Array, right: Array, pick: Pick, count: int) -> Array:
        """Unbounded `until`, by the recursion `u(t) = min(left(t), max(right(t), u(t + 1)))`."""
        pair, other = self.semantics.pair, dual(pick)
        row = pair(left[-1:], right[-1:], other, self.ops)
        out = [row]
        for t in range(left.shape[0] - 2, -1, -1):
            reached = pair(right[t : t + 1], row, pick, self.ops)
            row = pair(left[t : t + 1], reached, other, self.ops)
            out.append(row)
        rows = out[: -count - 1 : -1]
        return rows[0] if count == 1 else self.ops.cat(rows)

    def _until_by_tiles(
        self, left: Array, right: Array, pick: Pick, tiles: list[tuple[slice, slice]]
    ) -> Array:
        """Unbounded `until` on a long recorded trace, tile by tile backward in time.

        `tiles` contains consecutive ranges of rows, in the form of `_tiles`.
        """
        out = self.ops.empty((tiles[-1][0].stop, *left.shape[1:]), left)
        later = self.until(left[len(out) :], right[len(out) :], pick, count=1, width=len(left))
        for rows, _ in reversed(tiles):
            size = rows.stop - rows.start
            held = self._to_end(left[rows], dual(pick))
            met = self.until(left[rows], right[rows], pick, count=size, width=size)
            out[rows] = self.semantics.pair(
                met, self.semantics.pair(held, later, dual(pick), self.ops), pick, self.ops
            )
            later = out[rows.start : rows.start + 1]
        return out

    def _until_doubling(self, held: Array, met: Array, pick: Pick, width: int) -> Array:
        """`until` over windows of `width` rows, by about log2(width) rounds that join adjacent blocks.

        Every window must lie within the array. A block has two values: the least `left` in the block
        (`held`), and `until` within the block (`met`). The arguments contain blocks of one row each.
        """
        # Row j of `held` and `met` belongs to the block of `size` rows that starts at row j. Row j of `total`
        # belongs to the first `done` rows of window j.
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
        """Join each block of rows in `a` with the adjacent later block in `b`.

        A block has two values: the least `left` over its rows, and `until` within the block. For `pick`
        "min", the values are the greatest `left`, and `release` within the block. The joined blocks are
        returned in the same form.
        """
        rows = min(a[0].shape[0], b[0].shape[0])
        pair, other = self.semantics.pair, dual(pick)
        later = pair(a[0][:rows], b[1][:rows], other, self.ops)
        met = pair(a[1][:rows], later, pick, self.ops)
        return pair(a[0][:rows], b[0][:rows], other, self.ops), met
