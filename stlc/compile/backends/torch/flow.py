"""Where a running extremum took its values from: gradients flow to the rows that were chosen.

A row of a scan is either an operand of that row or the row scanned before it. The gradient of a row is thus
its own and that of the row scanned after it, if that one took it over: a recursion in time with factors 0 and
1. It is evaluated in place, in pieces as in `stlc.compile.backends.array.scans`, without any index.

`behind` is the direction of the scan; gradients flow the other way.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stlc.compile.backends.array.namespace import Ops
from stlc.compile.backends.array.scans import ends_of, givers, piece_of, rows_of, split, takers
from stlc.compile.backends.array.scratch import Scratch


def flow_to_chosen(
    grad: Tensor, scan: Tensor, room: tuple[Tensor, Tensor], ops: Ops, *, behind: bool
) -> Tensor:
    """The gradient of what a running extremum ran over, in place of the gradient of its values.

    Where operands tie, the one that was scanned first gets all of it.

    Args:
        grad: `(blocks, time, batch)`.
        scan: the running extremum, the same shape.
        room: two arrays of that shape to work in; the second may be `scan`.
        ops: torch.
        behind: the direction of the scan.

    Returns:
        `grad`.
    """
    passes, reach = room
    taken_over(scan, passes, behind)
    piece = piece_of(grad)
    (pieces, _), (reach, _) = split(scan, piece, not behind), split(reach, piece, not behind)
    if pieces.shape[1] > 1:
        torch.eq(pieces, ends_of(pieces, behind)[:, :, None].clone(), out=reach)
    _flow(grad, passes, reach, ops, not behind)
    return grad.addcmul_(grad, passes, value=-1.0)


def taken_over(scan: Tensor, out: Tensor, behind: bool) -> None:
    """1 where a row has the value of the row scanned before it, else 0."""
    if behind:
        torch.eq(scan[:, :-1], scan[:, 1:], out=out[:, :-1])
        out[:, -1] = 0.0
    else:
        torch.eq(scan[:, 1:], scan[:, :-1], out=out[:, 1:])
        out[:, 0] = 0.0


def flow_on(grad: Tensor, passes: Tensor, memory: Scratch, ops: Ops, *, behind: bool) -> None:
    """Add to the gradient of every row what the rows scanned after it hand on to it.

    Args:
        grad: `(blocks, time, batch)`, changed in place.
        passes: 1 where a row hands its gradient on, else 0; the same shape.
        memory: takes one array of that shape.
        ops: torch.
        behind: the direction of the scan.
    """
    piece = piece_of(grad)
    main, _ = split(passes, piece, not behind)
    if main.shape[1] == 1:
        _flow(grad, passes, main, ops, not behind)
        return
    with memory.lent(*main.shape) as reach:
        reaches, keeps = rows_of(reach, 2, ops, not behind), rows_of(main, 2, ops, not behind)
        reaches[0].fill_(1.0)
        for i in range(1, len(reaches)):
            torch.mul(reaches[i - 1], keeps[i - 1], out=reaches[i])
        _flow(grad, passes, reach, ops, not behind)


def _flow(grad: Tensor, passes: Tensor, reach: Tensor, ops: Ops, behind: bool) -> None:
    """`grad[t] += passes[t - 1] * grad[t - 1]`, in the order of time or from behind.

    `reach`, in pieces, is 1 where all rows of a piece before a row hand on.
    """
    piece = reach.shape[2]
    (main, rest), (keep, keep_rest) = split(grad, piece, behind), split(passes, piece, behind)
    _recur(rows_of(main, 2, ops, behind), rows_of(keep, 2, ops, behind))
    ends, leaves = ends_of(main, behind), ends_of(keep, behind)
    last, last_keep = rows_of(ends, 1, ops, behind), rows_of(leaves, 1, ops, behind)
    if len(last) > 1:
        out = torch.empty_like(ends)
        flows, through = rows_of(out, 1, ops, behind), rows_of(ends_of(reach, behind), 1, ops, behind)
        torch.mul(last[0], last_keep[0], out=flows[0])
        for i in range(1, len(last)):
            last[i].addcmul_(through[i], flows[i - 1])
            torch.mul(last[i], last_keep[i], out=flows[i])
        takers(main, behind).addcmul_(takers(reach, behind), givers(out, behind))
    if rest.shape[1]:
        rows, keeps = rows_of(rest, 1, ops, behind), rows_of(keep_rest, 1, ops, behind)
        _recur([last[-1], *rows], [last_keep[-1], *keeps])


def _recur(rows: Sequence[Tensor], keeps: Sequence[Tensor]) -> None:
    before = rows[0]
    for row, keep in zip(rows[1:], keeps, strict=False):
        row.addcmul_(before, keep)
        before = row
