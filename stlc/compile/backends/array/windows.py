"""Extrema over time windows, and `until` in them.

The method depends on the windows: a reduction over time, the C kernel, running extrema, or merging blocks of
1, 2, 4, … rows. All arrays are `(time, batch)`. Window `j` of `count` starts at row `j` and has `width` rows;
it ends with the last row of the array at the latest. A window without rows has the neutral value (+inf for a
minimum, -inf for a maximum).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
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

    def over(self, operands: Sequence[Array], pick: Pick, *, count: int, width: int, lo: int = 0) -> Array:
        """Extrema of one operand over windows, or `until` of two in them.

        Of one operand, row `j` of the result is the extremum over window `j`. Of two, it is the robustness of
        `until` (for `pick` "max"): the maximum of `min(right[t], left[j], …, left[lo + t])` over all rows `t`
        of window `j`. For its dual `release` ("min"), minimum and maximum are exchanged.

        Args:
            operands: arrays (time, batch). Of two, the left one must hold up to and including `t`, the right
                one at `t`; row 0 of the right one belongs to row `lo` of the left one.
            pick: "max" or "min".
            count: number of windows.
            width: number of rows of a window.
            lo: number of rows of the left operand before the window.

        Returns:
            One row per window, (count, batch).
        """
        *lefts, x = operands
        rows, other = x.shape[0], dual(pick)
        width = min(width, max(rows, 1))
        if lefts and not self.semantics.exact:
            return self._until_by_definition(lefts[0], x, pick, (count, width, lo))
        if lefts and lo:
            reached = self.over((lefts[0][lo:], x), pick, count=count, width=width)
            held = self.over(lefts, other, count=count, width=lo)
            return self.semantics.pair(held, reached, other, self.ops)
        if self.semantics.exact and rows and count > 1:
            found = self.ops.windows(operands, pick, Sliding(rows, min(count, rows), width))
            if found is not None:
                return found if count <= rows else self.padded(found, count, neutral(pick))
        if tiles := self._tiles(x, count, width):
            out = self.ops.empty((count, *x.shape[1:]), x)
            for asked, seen in tiles:
                many = asked.stop - asked.start
                out[asked] = self.over([each[seen] for each in operands], pick, count=many, width=width)
            return out
        if count == 1 and rows:
            x = self.padded(x, width, neutral(pick))
            if lefts:
                left = self.padded(lefts[0], width, neutral(other))
                held = (self.ops.cummin if pick == "max" else self.ops.cummax)(left)
                x = self.semantics.pair(held, x, other, self.ops)
            return self.semantics.reduce(x, pick, self.ops)
        if width >= rows > 0 and (to_end := self._to_end(operands, pick, min(rows, count))) is not None:
            return self.padded(to_end, count, neutral(pick))
        return self._doubling(operands, pick, count, width)

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

    def _to_end(self, operands: Sequence[Array], pick: Pick, count: int) -> Array | None:
        """The first `count` values over windows that all extend to the last row; None if doubling is faster.

        An extremum runs backward in time. `until` is `u(t) = min(left(t), max(right(t), u(t + 1)))`.
        """
        *lefts, x = operands
        rows, pair, ops = x.shape[0], self.semantics.pair, self.ops
        if not lefts:
            if rows == 1 or not self.semantics.idempotent:
                return None
            running = ops.cummin if pick == "min" else ops.cummax
            return ops.flip(running(ops.flip(x)))[:count]
        if rows > _SCAN_BATCH and x[0].shape[0] < _SCAN_BATCH:
            return None
        left, other = lefts[0], dual(pick)
        row = pair(left[-1:], x[-1:], other, ops)
        out = [row]
        for t in range(rows - 2, -1, -1):
            row = pair(left[t : t + 1], pair(x[t : t + 1], row, pick, ops), other, ops)
            out.append(row)
        found = out[: -count - 1 : -1]
        return found[0] if count == 1 else ops.cat(found)

    def _doubling(self, operands: Sequence[Array], pick: Pick, count: int, width: int) -> Array:
        """Values over windows, in about log2(width) rounds that join adjacent blocks of 1, 2, 4, … rows.

        A block has partial results (`Parts`): those of the semantics for an extremum; for `until` the least
        `left` in the block, and `until` within the block (for `release`, the greatest and `release`).
        """
        semantics, ops, other = self.semantics, self.ops, dual(pick)
        sides = (other, pick)[-len(operands) :]
        padded = [
            self.padded(x, count + width - 1, neutral(side)) for x, side in zip(operands, sides, strict=True)
        ]
        if len(operands) == 1:
            if width == 1:
                return padded[0]
            whole = self._joined(
                semantics.lift(padded[0], pick, ops),
                lambda a, b: semantics.merge(a, b, pick, ops),
                width,
                overlapping=semantics.idempotent,
            )
            return semantics.finish(whole, pick, ops)

        def composed(a: Parts, b: Parts) -> Parts:
            later = semantics.pair(a[0], b[1], other, ops)
            return semantics.pair(a[0], b[0], other, ops), semantics.pair(a[1], later, pick, ops)

        held, right = padded
        blocks = held, semantics.pair(held, right, other, ops)
        return self._joined(blocks, composed, width, overlapping=False)[1]

    def _joined(
        self, piece: Parts, join: Callable[[Parts, Parts], Parts], width: int, *, overlapping: bool
    ) -> Parts:
        """Partial results of windows of `width` rows, from those of single rows, one per row.

        Every window must lie within the array. `join` joins each block with the adjacent later one; if
        `overlapping`, also with one that begins within it.
        """

        def shifted(a: Parts, b: Parts, shift: int) -> Parts:
            rows = min(a[0].shape[0], b[0].shape[0] - shift)
            return join(tuple(part[:rows] for part in a), tuple(part[shift : shift + rows] for part in b))

        size, done, total = 1, 0, piece
        while done < width:
            if overlapping and 2 * size > width:
                return shifted(piece, piece, width - size) if width > size else piece
            if width & size and not overlapping:
                total = shifted(total, piece, done) if done else piece
                done += size
            if done < width:
                piece, size = shifted(piece, piece, size), 2 * size
        return total

    def _until_by_definition(
        self, left: Array, right: Array, pick: Pick, sizes: tuple[int, int, int]
    ) -> Array:
        """Compute `until` by its definition, for extrema that are not exact.

        Faster methods assume that min distributes over max, which is true of exact extrema only. A loop runs
        over the samples of the window. Each of its `lo + width` iterations works on all `count` windows at
        once. `sizes` is (count, width, lo), as in `over`.
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
