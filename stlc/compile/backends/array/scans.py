"""Running extrema along time, in place, in few array operations.

Arrays are `(blocks, time, batch)`; every block is scanned on its own. A scan takes an operation a row. Where
rows are short, blocks are therefore cut into pieces of about the square root of their length: the pieces are
scanned side by side, then their ends, and every piece takes over what the ends before it came to.

`behind` means from the last row on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from stlc.compile.backends.array.extremum import Pick, dual
from stlc.compile.backends.array.namespace import Array, Ops

_LONG_ROW = 1 << 14
"""Numbers in a row from which on an operation takes longer than its call."""

_FEW_ROWS = 12


def chooser(pick: Pick, ops: Ops) -> Callable[..., Array]:
    """The elementwise extremum of two arrays; takes `out=`."""
    return ops.minimum if pick == "min" else ops.maximum


def piece_of(blocks: Array) -> int:
    """How many rows are scanned one after the other: all of a block, or about the square root of them."""
    count, rows, batch = blocks.shape
    if count * batch >= _LONG_ROW or rows <= _FEW_ROWS:
        return int(rows)
    return math.isqrt(rows - 1) + 1


def split(blocks: Array, piece: int, behind: bool) -> tuple[Array, Array]:
    """Views: whole pieces `(blocks, pieces, time, batch)`, and the rows that are left at the far end."""
    count, rows, batch = blocks.shape
    whole = rows // piece * piece
    main = blocks[:, rows - whole :] if behind else blocks[:, :whole]
    rest = blocks[:, : rows - whole] if behind else blocks[:, whole:]
    return main.reshape(count, whole // piece, piece, batch), rest


def rows_of(array: Array, axis: int, ops: Ops, behind: bool) -> Sequence[Array]:
    """Views of the slices along an axis, in the order of the scan."""
    rows = ops.unbind(array, axis)
    return rows[::-1] if behind else rows


def ends_of(main: Array, behind: bool) -> Array:
    """A view of the row of every piece that is scanned last."""
    return main[:, :, 0] if behind else main[:, :, -1]


def takers(main: Array, behind: bool) -> Array:
    """A view of the rows that take over: all but the ends, of all pieces but the first."""
    return main[:, :-1, 1:] if behind else main[:, 1:, :-1]


def givers(ends: Array, behind: bool) -> Array:
    """A view of the ends `(blocks, pieces, batch)` that the pieces after them take over."""
    return ends[:, 1:, None] if behind else ends[:, :-1, None]


def running(blocks: Array, pick: Pick, ops: Ops, *, behind: bool) -> None:
    """Every row becomes the extremum of the rows up to it (`behind`: from it on)."""
    piece = piece_of(blocks)
    main, rest = split(blocks, piece, behind)
    _run(rows_of(main, 2, ops, behind), pick, ops)
    ends = ends_of(main, behind)
    last = rows_of(ends, 1, ops, behind)
    if len(last) > 1:
        _run(last, pick, ops)
        inner = takers(main, behind)
        chooser(pick, ops)(inner, givers(ends, behind), out=inner)
    if rest.shape[1]:
        _run([last[-1], *rows_of(rest, 1, ops, behind)], pick, ops)


def _run(rows: Sequence[Array], pick: Pick, ops: Ops) -> None:
    choose = chooser(pick, ops)
    before = rows[0]
    for row in rows[1:]:
        choose(row, before, out=row)
        before = row


def running_until(held: Array, met: Array, pick: Pick, ops: Ops) -> None:
    """`until` from every row to the end of its block: `u(t) = min(left(t), max(right(t), u(t + 1)))`.

    Args:
        held: `left`; becomes the dual extremum of the rows from each on.
        met: `right`; becomes `u`.
        pick: "max" for `until`, "min" for `release`.
        ops: the array library.
    """
    one, other = chooser(pick, ops), chooser(dual(pick), ops)
    piece = piece_of(held)
    (held, held_rest), (met, met_rest) = split(held, piece, True), split(met, piece, True)
    holding, meeting = rows_of(held, 2, ops, True), rows_of(met, 2, ops, True)
    other(meeting[0], holding[0], out=meeting[0])
    _run_until(holding, meeting, pick, ops)
    held_ends, met_ends = ends_of(held, True), ends_of(met, True)
    holding, meeting = rows_of(held_ends, 1, ops, True), rows_of(met_ends, 1, ops, True)
    if len(holding) > 1:
        for last, (h, m) in enumerate(zip(holding[1:], meeting[1:], strict=True)):
            one(m, other(h, meeting[last]), out=m)
            other(h, holding[last], out=h)
        inner, carried = takers(met, True), takers(held, True)
        one(inner, other(carried, givers(met_ends, True)), out=inner)
        other(carried, givers(held_ends, True), out=carried)
    if held_rest.shape[1]:
        holding = [holding[-1], *rows_of(held_rest, 1, ops, True)]
        meeting = [meeting[-1], *rows_of(met_rest, 1, ops, True)]
        _run_until(holding, meeting, pick, ops)


def _run_until(holding: Sequence[Array], meeting: Sequence[Array], pick: Pick, ops: Ops) -> None:
    """The recursion; the first row of each is done."""
    one, other = chooser(pick, ops), chooser(dual(pick), ops)
    later_held, later_met = holding[0], meeting[0]
    for held, met in zip(holding[1:], meeting[1:], strict=True):
        one(met, later_met, out=met)
        other(met, held, out=met)
        other(held, later_held, out=held)
        later_held, later_met = held, met
