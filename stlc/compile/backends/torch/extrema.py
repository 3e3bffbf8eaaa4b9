"""Minimum and maximum in torch with fast subgradients: elementwise, along time, over windows, and `until`.

The backward passes of torch spend most of their time on boolean masks. Here a mask consists of numbers 0 and
1, and the gradient overwrites it in the same memory. Windows are computed by the C kernel
(`stlc.compile.backends.array.kernel`), or, for small arrays, by gathering all windows into one array.

Every backward pass is itself differentiable: a selection is linear in what it selects.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from stlc.compile.backends.array.kernel import Direction, Strided, WindowKernel, window_kernel
from stlc.compile.backends.schedule import dual, neutral
from stlc.compile.namespace import Pick, Sliding

_LARGE = 1 << 12
"""Elements from which the custom gradient is faster."""

_LARGE_COLUMN = 1 << 14

_SEVERAL = 4
"""Small operands from which stacking is faster than pairwise operations."""

_SMALL = 1 << 12
"""Maximum total elements of gathered windows."""


class _Choice(torch.autograd.Function):
    """Autograd function: elementwise extremum; the first of equal operands gets the gradient."""

    @staticmethod
    def forward(ctx: Any, pick: Pick, *items: Tensor) -> Tensor:
        choose = torch.minimum if pick == "min" else torch.maximum
        out = choose(items[0], items[1])
        for item in items[2:]:
            choose(out, item, out=out)
        ctx.save_for_backward(out, *items)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        out, *items = (each.detach() for each in ctx.saved_tensors)
        grads: list[Tensor] = []
        left = grad
        for item in items[:-1]:
            mine = torch.empty_like(out)
            torch.eq(item, out, out=mine).mul_(left)
            left = left - mine if left is grad else left.sub_(mine)
            grads.append(mine)
        return None, *grads, left


class _Reduction(torch.autograd.Function):
    """Autograd function: minimum or maximum over axis 0; equal operands share the gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, pick: Pick) -> Tensor:
        out = x.amin(dim=0, keepdim=True) if pick == "min" else x.amax(dim=0, keepdim=True)
        ctx.save_for_backward(x, out)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        x, out = (each.detach() for each in ctx.saved_tensors)
        share = torch.empty_like(x)
        torch.eq(x, out, out=share)
        return share.mul_(grad / share.sum(dim=0, keepdim=True)), None


def choice(items: Sequence[Tensor], pick: Pick) -> Tensor:
    """Return the elementwise minimum or maximum of one or more arrays."""
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
    """Return the minimum or maximum over axis 0, which is kept with length 1."""
    if x.requires_grad and x.numel() >= _LARGE_COLUMN:
        out: Tensor = _Reduction.apply(x, pick)  # type: ignore[no-untyped-call]
        return out
    return x.amin(dim=0, keepdim=True) if pick == "min" else x.amax(dim=0, keepdim=True)


# --------------------------------------------------------------------------- windows, by the kernel


class _Windows(torch.autograd.Function):
    """Autograd function: extrema over windows, or `until`, by the C kernel.

    If several rows are equal, one of them gets the whole gradient.
    """

    @staticmethod
    def forward(ctx: Any, kernel: WindowKernel, *operands: Tensor) -> Tensor:
        ctx.kernel = kernel
        ctx.save_for_backward(*operands)
        return _run(kernel, "values", operands, kernel.window.count)[0]

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return None, *_Pulled.apply(ctx.kernel, grad, *ctx.saved_tensors)  # type: ignore[no-untyped-call]


class _Pulled(torch.autograd.Function):
    """Autograd function: gradients of the operands of `_Windows` from the gradient of its values."""

    @staticmethod
    def forward(ctx: Any, kernel: WindowKernel, grad: Tensor, *operands: Tensor) -> tuple[Tensor, ...]:
        ctx.kernel = kernel
        ctx.save_for_backward(*operands)
        return _run(kernel, "pull", (*operands, grad), kernel.window.rows)

    @staticmethod
    def backward(ctx: Any, *changes: Tensor) -> tuple[Tensor | None, ...]:
        operands = ctx.saved_tensors
        change = _Pushed.apply(ctx.kernel, *operands, *changes)  # type: ignore[no-untyped-call]
        return None, change, *[None] * len(operands)


class _Pushed(torch.autograd.Function):
    """Autograd function: changes of the values of `_Windows` under changes of its operands."""

    @staticmethod
    def forward(ctx: Any, kernel: WindowKernel, *arrays: Tensor) -> Tensor:
        ctx.kernel = kernel
        ctx.save_for_backward(*arrays[: len(arrays) // 2])
        return _run(kernel, "push", arrays, kernel.window.count)[0]

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        operands = ctx.saved_tensors
        pulled = _Pulled.apply(ctx.kernel, grad, *operands)  # type: ignore[no-untyped-call]
        return None, *[None] * len(operands), *pulled


def by_kernel(operands: Sequence[Tensor], pick: Pick, window: Sliding) -> Tensor | None:
    """Return the extrema of one array over windows, or `until` or `release` of two arrays.

    The result is None if there is no kernel for the arrays.

    Args:
        operands: arrays `(time, batch)` of one dtype.
        pick: "max" for a maximum or `until`, "min" for a minimum or `release`.
        window: layout of the windows.
    """
    first = operands[0]
    alike = all(each.dtype == first.dtype and each.device.type == "cpu" for each in operands)
    dtype = str(first.dtype).removeprefix("torch.")
    kernel = window_kernel(dtype, first.shape[1], len(operands), pick, window) if alike else None
    if kernel is None:
        return None
    out: Tensor = _Windows.apply(kernel, *operands)  # type: ignore[no-untyped-call]
    return out


def _run(
    kernel: WindowKernel, direction: Direction, arrays: Sequence[Tensor], rows: int
) -> tuple[Tensor, ...]:
    """Run the kernel on `arrays`; return the arrays of `rows` rows that it fills."""
    operands = kernel.operands
    out = []  # uninitialized, each with the memory layout of an array in `arrays`
    for x in arrays[: operands if direction == "pull" else 1]:
        batch = x.shape[1]
        by_column = x.stride(0) == 1 and batch > 1
        out.append(x.new_empty((batch, rows)).T if by_column else x.new_empty((rows, batch)))
    kernel.run([Strided(x.data_ptr(), *x.stride()) for x in (*arrays, *out)], direction)
    return tuple(out)


# ------------------------------------------------------------------ windows over few numbers


def small_windows(operands: Sequence[Tensor], pick: Pick, window: Sliding) -> Tensor | None:
    """Exact extrema over sliding windows, or `until`: (time, batch) -> (count, batch).

    The result is None unless the arrays are small enough to copy all windows into one array, which takes
    `window.width` times their memory.
    """
    *lefts, x = operands
    if x.numel() * window.width > _SMALL:
        return None
    running = torch.cummin if pick == "min" else torch.cummax
    if window.to_end and not lefts:
        return _first(running(x.flip(0), 0).values.flip(0), window.count)
    found = _gathered(x, neutral(pick), window)
    if lefts:
        held = _gathered(lefts[0], neutral(dual(pick)), window)
        if pick == "max":
            found = torch.minimum(torch.cummin(held, -1).values, found)
        else:
            found = torch.maximum(torch.cummax(held, -1).values, found)
    return found.amin(dim=-1) if pick == "min" else found.amax(dim=-1)


def _gathered(x: Tensor, fill: float, window: Sliding) -> Tensor:
    """All windows as one array, `(count, batch, width)`; rows beyond the array have the value `fill`."""
    missing = window.count + window.width - 1 - window.rows
    filled = pad(x, (0, 0, 0, missing), value=fill) if missing > 0 else x
    return _first(filled.unfold(0, window.width, 1), window.count)


def _first(x: Tensor, count: int) -> Tensor:
    return x if x.shape[0] == count else x[:count]
