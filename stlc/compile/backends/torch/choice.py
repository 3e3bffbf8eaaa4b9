"""The minimum or maximum of several arrays and of a column of time, with cheap subgradients.

Torch's own spend most of the way back on masks of booleans. Here a mask is written as numbers, in the memory
of the gradient that it becomes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from stlc.compile.backends.array.extremum import Pick

_LARGE = 1 << 12
"""From so many numbers on a gradient of our own is faster."""

_LARGE_COLUMN = 1 << 14

_SEVERAL = 4
"""From so many small operands on stacking them is faster than one operation a pair."""


class _Choice(torch.autograd.Function):
    """Elementwise extremum of arrays of one shape; the first of equal operands gets the gradient."""

    @staticmethod
    def forward(ctx: Any, pick: Pick, *items: Tensor) -> Tensor:
        choose = torch.minimum if pick == "min" else torch.maximum
        out = choose(items[0], items[1])
        for item in items[2:]:
            choose(out, item, out=out)
        ctx.save_for_backward(out, *items)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        out, *items = ctx.saved_tensors
        grads: list[Tensor] = []
        left = grad
        for item in items[:-1]:
            mine = torch.empty_like(out)
            torch.eq(item, out, out=mine).mul_(left)
            left = left - mine if left is grad else left.sub_(mine)
            grads.append(mine)
        return None, *grads, left


class _Reduction(torch.autograd.Function):
    """Extremum over axis 0, kept; equal operands share the gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, pick: Pick) -> Tensor:
        out = x.amin(dim=0, keepdim=True) if pick == "min" else x.amax(dim=0, keepdim=True)
        ctx.save_for_backward(x, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        x, out = ctx.saved_tensors
        share = torch.empty_like(x)
        torch.eq(x, out, out=share)
        return share.mul_(grad / share.sum(dim=0, keepdim=True)), None


def choice(items: Sequence[Tensor], pick: Pick) -> Tensor:
    """The elementwise extremum of one or more arrays."""
    first = items[0]
    if len(items) == 1:
        return first
    alike = all(item.shape == first.shape and item.dtype == first.dtype for item in items[1:])
    if alike and first.numel() >= _LARGE and torch.is_grad_enabled():
        out: Tensor = _Choice.apply(pick, *items)  # type: ignore[no-untyped-call]
        return out
    if alike and len(items) >= _SEVERAL and first.numel() < _LARGE:
        stacked = torch.stack(list(items))
        return stacked.amin(dim=0) if pick == "min" else stacked.amax(dim=0)
    return reduce(torch.minimum if pick == "min" else torch.maximum, items)


def reduction(x: Tensor, pick: Pick) -> Tensor:
    """The extremum over axis 0, which stays with length 1."""
    if x.requires_grad and x.numel() >= _LARGE_COLUMN:
        out: Tensor = _Reduction.apply(x, pick)  # type: ignore[no-untyped-call]
        return out
    return x.amin(dim=0, keepdim=True) if pick == "min" else x.amax(dim=0, keepdim=True)
