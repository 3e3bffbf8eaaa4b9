"""Sliding extrema and `until` with exact subgradients, by a kernel in C: any layout, one pass each way.

`windows.c` is built on first use (`stlc.native`), once for a dtype and a width of vectors. Where it cannot
be, or the operands are not its kind, there is no kernel, and torch's own operations do the same work.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from stlc import native
from stlc.compile.backends.array.extremum import Pick, Sliding

_SOURCE = Path(__file__).with_name("windows.c")
_TYPES = {torch.float32: ("float", "int32_t"), torch.float64: ("double", "int64_t")}
_WIDE, _NARROW = 64, 16
"""Bytes of a vector, for many traces and for a few."""

_FEW_BYTES = 32
"""So many bytes of one instant are few."""

_ROOM = 1 << 24
"""Bytes that the kernel may take for itself, whatever the size of the operands."""


@final
@dataclass(frozen=True, slots=True)
class Task:
    """What to compute, and the library that does."""

    library: ctypes.CDLL
    pick: Pick
    window: Sliding

    def run(self, arrays: Sequence[Tensor], operands: int, *, back: bool) -> None:
        """Operands, values or their gradient, and with `back` the gradients of the operands."""
        window, batch = self.window, arrays[0].shape[1]
        numbers = [window.rows, window.count, window.width, batch]
        for array in arrays:
            numbers += array.stride()
        places = (ctypes.c_void_p * len(arrays))(*[array.data_ptr() for array in arrays])
        shape = (ctypes.c_int64 * len(numbers))(*numbers)
        call = self.library.slide_all if operands == 1 else self.library.until_all
        if call(places, shape, self.pick == "max", back):
            raise MemoryError


class _Windows(torch.autograd.Function):
    """One operand: its extrema; two: `until` or `release`. One of several equal rows gets the gradient."""

    @staticmethod
    def forward(ctx: Any, task: Task, *operands: Tensor) -> Tensor:
        ctx.task = task
        ctx.save_for_backward(*operands)
        out = _like(operands[0], task.window.count)
        task.run((*operands, out), len(operands), back=False)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        operands, task = ctx.saved_tensors, ctx.task
        out = [_like(operand, task.window.rows) for operand in operands]
        task.run((*operands, grad, *out), len(operands), back=True)
        return None, *out


def by_kernel(operands: Sequence[Tensor], pick: Pick, window: Sliding) -> Tensor | None:
    """`backends.array.sliding.extrema` of one array, `until` of two; None where there is no kernel for them.

    Args:
        operands: `(time, batch)`, of one dtype.
        pick: "max" asks for `until`, "min" for `release`.
        window: which windows.
    """
    first = operands[0]
    alike = all(each.dtype == first.dtype and each.device.type == "cpu" for each in operands)
    if not alike or first.dtype not in _TYPES:
        return None
    vector = _NARROW if first.shape[1] * first.itemsize <= _FEW_BYTES else _WIDE
    length = min(window.width, window.rows)
    room = vector * (2 * len(operands) * (window.rows + length) + window.count)
    if room > max(_ROOM, first.numel() * first.itemsize):
        return None
    library = _library(first.dtype, vector)
    if library is None:
        return None
    out: Tensor = _Windows.apply(Task(library, pick, window), *operands)  # type: ignore[no-untyped-call]
    return out


def _like(x: Tensor, rows: int) -> Tensor:
    """Memory for so many rows, laid out as `x`: samples or traces beside each other."""
    batch = x.shape[1]
    return x.new_empty((batch, rows)).T if x.stride(0) == 1 and batch > 1 else x.new_empty((rows, batch))


@cache
def _library(dtype: torch.dtype, vector: int) -> ctypes.CDLL | None:
    """The kernel for a dtype and a width of vectors in bytes; None where it cannot be built or loaded."""
    real, index = _TYPES[dtype]
    defined = f"#define REAL {real}\n#define INDEX {index}\n#define BYTES {vector}\n"
    return native.load(defined + _SOURCE.read_text(encoding="utf-8"))
