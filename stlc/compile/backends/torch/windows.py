"""Sliding extrema and `until` with exact subgradients: the passes forward, and the same ones turned round.

Nothing is stored between the two but the operands: to run again costs less than to write indices and to read
them back. Where operands tie, one of them gets the whole gradient.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from stlc.compile.backends.array.extremum import Pick, Sliding
from stlc.compile.backends.array.scans import chooser
from stlc.compile.backends.array.scratch import Scratch, scratch
from stlc.compile.backends.array.sliding import (
    Asked,
    extrema,
    flat,
    heads_then_and_reach,
    held_and_met,
    starts,
    stops,
    tails_and_heads,
    to_end,
    until,
)
from stlc.compile.backends.torch.flow import flow_on, flow_to_chosen, taken_over

Pair: TypeAlias = tuple[Tensor, Tensor]
"""What belongs to the left and to the right operand of `until`."""


class SlidingExtremum(torch.autograd.Function):
    """`stlc.compile.backends.array.sliding.extrema`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, asked: Asked) -> Tensor:
        ctx.asked = asked
        x = _by_rows(x)
        if not asked.window.to_end:
            ctx.save_for_backward(x)
            out: Tensor = extrema(x, asked)
            return out
        scan: Tensor = to_end(x, asked)
        ctx.save_for_backward(scan)
        return scan[: asked.window.count]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (x,) = ctx.saved_tensors
        asked: Asked = ctx.asked
        window, batch = asked.window, x.shape[1]
        grad = _by_rows(grad)
        out = torch.empty_like(x)
        arrays = 2 if window.to_end else 5
        with scratch(arrays * window.numbers(batch, arrays), x, asked.ops) as memory:
            for part in window.chunks(batch, arrays):
                memory.clear()
                if window.to_end:
                    _to_end_back(x[:, part], grad[:, part], out[:, part], asked, memory)
                else:
                    _extrema_back(x[:, part], grad[:, part], out[:, part], asked, memory)
        return out, None


def _by_rows(x: Tensor) -> Tensor:
    """The same numbers, those of an instant beside each other: turning all of them at once is cheap."""
    return x if x.stride(1) <= 1 or x.shape[1] == 1 else x.contiguous()


def _to_end_back(scan: Tensor, grad: Tensor, out: Tensor, asked: Asked, memory: Scratch) -> None:
    window = asked.window
    out[: window.count] = grad
    out[window.count :] = 0.0
    room = memory.take(*window.shape, out.shape[1]), memory.take(*window.shape, out.shape[1])
    flow_to_chosen(out[None], scan[None], room, asked.ops, behind=True)


def _extrema_back(x: Tensor, grad: Tensor, out: Tensor, asked: Asked, memory: Scratch) -> None:
    window, ops = asked.window, asked.ops
    tails, heads = tails_and_heads(x, asked, memory)
    to_tails, to_heads = _room(window, 0, x, memory), _room(window, window.width - 1, x, memory)
    mine, others = starts(to_tails, window), stops(to_heads, window)
    _wins(starts(tails, window), stops(heads, window), asked.pick, mine).mul_(grad)
    torch.sub(grad, mine, out=others)
    passes = memory.take(*tails.shape)
    flow_to_chosen(to_tails, tails, (passes, tails), ops, behind=True)
    flow_to_chosen(to_heads, heads, (passes, heads), ops, behind=False)
    seen = min(window.rows, window.covered)
    torch.add(flat(to_tails)[:seen], flat(to_heads)[:seen], out=out[:seen])
    out[seen:] = 0.0


def _room(window: Sliding, first: int, like: Tensor, memory: Scratch) -> Tensor:
    """Blocks whose rows are 0, apart from `count` of them from the flat row `first` on, which are not set."""
    out: Tensor = memory.take(*window.shape, like.shape[1])
    rows = flat(out)
    rows[:first] = 0.0
    rows[first + window.count :] = 0.0
    return out


def _wins(a: Tensor, b: Tensor, pick: Pick, out: Tensor) -> Tensor:
    """1 where `a` is the extremum of the two, else 0."""
    compare = torch.le if pick == "min" else torch.ge
    return compare(a, b, out=out)


class SlidingUntil(torch.autograd.Function):
    """`stlc.compile.backends.array.sliding.until`."""

    @staticmethod
    def forward(ctx: Any, left: Tensor, right: Tensor, asked: Asked) -> Tensor:
        ctx.asked = asked
        left, right = _by_rows(left), _by_rows(right)
        ctx.save_for_backward(left, right)
        out: Tensor = until(left, right, asked)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        left, right = ctx.saved_tensors
        asked: Asked = ctx.asked
        window, batch = asked.window, left.shape[1]
        grad = _by_rows(grad)
        out = torch.empty_like(left), torch.empty_like(right)
        with scratch(10 * window.numbers(batch, 5), left, asked.ops) as memory:
            for part in window.chunks(batch, 5):
                memory.clear()
                operands = left[:, part], right[:, part]
                _until_back(operands, grad[:, part], (out[0][:, part], out[1][:, part]), asked, memory)
        return out[0], out[1], None


def _until_back(operands: Pair, grad: Tensor, out: Pair, asked: Asked, memory: Scratch) -> None:
    window, ops = asked.window, asked.ops
    held, met = held_and_met(operands, asked, memory)
    to_met = _room(window, 0, grad, memory)
    if window.to_end:
        starts(to_met, window)[:] = grad
        _met_back(to_met, met, operands, out, (asked, memory))
        return
    heads, then, reach = heads_then_and_reach(operands, asked, memory)
    to_held, to_reach = _room(window, 0, grad, memory), _room(window, window.width - 1, grad, memory)
    hold, meet, come = starts(held, window), starts(met, window), stops(reach, window)
    at_hold, at_meet, at_come = starts(to_held, window), starts(to_met, window), stops(to_reach, window)
    later = chooser(asked.other, ops)(hold, come, out=at_hold)
    _wins(meet, later, asked.pick, at_meet).mul_(grad)
    torch.sub(grad, at_meet, out=at_come)
    _wins(hold, come, asked.other, at_hold).mul_(at_come)
    at_come.sub_(at_hold)
    _met_back(to_met, met, operands, out, (asked, memory))
    seen = min(window.rows, window.covered)
    to_left, to_right = out[0][:seen], out[1][:seen]
    passes = memory.take(*held.shape)
    to_left.add_(flat(flow_to_chosen(to_held, held, (passes, held), ops, behind=True))[:seen])
    to_then = flow_to_chosen(to_reach, reach, (passes, reach), ops, behind=False)
    to_heads = _wins(heads, then, asked.other, met).mul_(to_then)
    to_right.add_(flat(to_then.sub_(to_heads))[:seen])
    to_left.add_(flat(flow_to_chosen(to_heads, heads, (passes, heads), ops, behind=False))[:seen])


def _met_back(grad: Tensor, met: Tensor, operands: Pair, out: Pair, how: tuple[Asked, Scratch]) -> None:
    """Gradients of both operands of `until` to the end of each block; `grad` is used up."""
    asked, memory = how
    seen = min(asked.window.rows, asked.window.covered)
    with memory.lent(*met.shape) as passes:
        taken_over(met, passes, behind=True)
        flow_on(grad, passes, memory, asked.ops, behind=True)
        grad.addcmul_(grad, passes, value=-1.0)
    here = flat(grad)[:seen]
    torch.eq(flat(met)[:seen], operands[0][:seen], out=out[0][:seen]).mul_(here)
    torch.sub(here, out[0][:seen], out=out[1][:seen])
    for each in out:
        each[seen:] = 0.0
