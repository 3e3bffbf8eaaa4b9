"""Array operations of NumPy, for recorded traces and wherever torch must not be imported."""

from __future__ import annotations

import ctypes
import operator
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import reduce
from typing import Any, cast, final

import numpy as np

from stlc.compile.backends.array.kernel import Strided, kernel_library, window_kernel
from stlc.compile.ir.functions import FUNCTIONS
from stlc.compile.namespace import Array, FloatConstants, Mask, Ops, Pick, ScanByRows, Sliding

_MANY = 1 << 16
"""Elements of all arrays so far from which building the C kernel pays off."""

_BYTE = ctypes.c_char * 1
_NAMES = {"f": "float32", "d": "float64"}

_NARROW = 1 << 11
"""Elements of a window up to which joining blocks beats prefixes and suffixes of blocks."""


@final
class NumpyOps(FloatConstants, ScanByRows):
    """Implementation of `stlc.compile.namespace.Ops` for NumPy arrays, without gradients."""

    name = "numpy"
    _seen = 0

    add = staticmethod(operator.add)
    sub = staticmethod(operator.sub)
    mul = staticmethod(operator.mul)
    div = staticmethod(np.true_divide)
    expm1 = staticmethod(np.expm1)
    log1p = staticmethod(np.log1p)
    minimum = staticmethod(np.minimum)
    maximum = staticmethod(np.maximum)
    pow = staticmethod(np.power)
    gt = staticmethod(operator.gt)
    ge = staticmethod(operator.ge)
    both = staticmethod(operator.and_)
    either = staticmethod(operator.or_)
    where = staticmethod(np.where)
    cat = staticmethod(np.concatenate)
    stack = staticmethod(np.stack)

    def axpy(self, a: Array, b: Array, factor: float) -> Array:
        return a + factor * b

    def addcmul(self, a: Array, b: Array, c: Array, factor: float) -> Array:
        product = b * c
        return a + (product if factor == 1.0 else factor * product)

    def clamp(self, x: Array, low: float | None, high: float | None) -> Array:
        return np.clip(x, low, high)

    def norm(self, *components: Array | float) -> Array:
        return np.sqrt(reduce(operator.add, (np.square(part) for part in components)))

    def settled(self, weight: Array, mask: Mask) -> Array:
        """Array that is 1 where `mask` is True, else 0, with the shape and dtype of `weight`."""
        return np.broadcast_to(np.asarray(mask, dtype=weight.dtype), weight.shape)

    def number(self, mask: Mask, like: Array) -> Array:
        return mask.astype(like.dtype)

    def lerp(self, no: Array | float, yes: Array | float, weight: Array) -> Array:
        span = yes - no
        finite, less = np.isfinite(span), weight < 0.5
        mixed = np.where(less, no + weight * span, yes - span * (1.0 - weight))
        return np.where(finite, mixed, np.where(less, no, yes))

    def infinite(self, mask: Mask, like: Array) -> Array:
        return np.where(mask, np.inf, -np.inf).astype(like.dtype)

    def amin(self, x: Array) -> Array:
        return np.minimum.reduce(x, axis=0, keepdims=True)

    def amax(self, x: Array) -> Array:
        return np.maximum.reduce(x, axis=0, keepdims=True)

    def sum(self, x: Array) -> Array:
        return x.sum(axis=0, keepdims=True)

    def cummin(self, x: Array) -> Array:
        return np.minimum.accumulate(x, axis=0)

    def cummax(self, x: Array) -> Array:
        return np.maximum.accumulate(x, axis=0)

    def accumulate(self, start: Array, x: Array) -> Array:
        return np.cumsum(np.concatenate((start, x)), axis=0)

    def split(self, x: Array) -> Sequence[Array]:
        return np.split(x, len(x))

    def repeat(self, x: Array, count: int) -> Array:
        return np.broadcast_to(x, (count, *x.shape[1:]))

    def join(self, items: Sequence[Array], pick: Pick) -> Array:
        choose = np.minimum if pick == "min" else np.maximum
        if len(items) == 1:
            return items[0]
        out = choose(items[0], items[1])
        for item in items[2:]:
            here = out.ndim and item.shape == out.shape and item.dtype == out.dtype
            out = choose(out, item, out=out) if here else choose(out, item)
        return out

    def kernel_pays(self, x: Array) -> bool:
        """Count the elements of an array; True if building the C kernel pays off for all so far."""
        self._seen += x.size
        return self._seen >= _MANY

    def windows(self, operands: Sequence[Array], pick: Pick, window: Sliding) -> Array | None:
        """Exact extrema over sliding windows, or `until`, by the C kernel.

        The result is None if array operations of NumPy are faster, or if no kernel is available.
        """
        first, pays = operands[0], self.kernel_pays(operands[0])
        if first.ndim != 2 or not pays or any(each.dtype != first.dtype for each in operands):
            return None
        name, traces = _NAMES.get(first.dtype.char, ""), first.shape[1]
        rows, count, width = window.rows, window.count, window.width
        out, near = np.empty((count, traces), first.dtype), len(operands) == 1 and width * traces <= _NARROW
        if (near or width >= rows) and (library := kernel_library(name)) is not None:
            held = [x if x.flags.c_contiguous and x.flags.writeable else x.copy() for x in operands]
            places = [_BYTE.from_buffer(x) for x in (*held, out)]
            if width >= rows:
                library.end_all(*[None] * (3 - len(places)), *places, rows, count, traces, pick == "max")
            elif library.double_all(*places, rows, count, width, traces, pick == "max"):
                raise MemoryError
            return out
        kernel = window_kernel(name, traces, len(operands), pick, window)
        if kernel is None:
            return None
        arrays = (*operands, out)
        kernel.run([Strided(x.ctypes.data, *(stride // x.itemsize for stride in x.strides)) for x in arrays])
        return out

    def softmax(self, x: Array, k: float) -> Array:
        """Smooth maximum (`k` > 0) or smooth minimum (`k` < 0) over axis 0, which is kept with length 1."""
        top = self.amax(x) if k > 0 else self.amin(x)
        finite = np.where(np.isfinite(top), top, 0.0)
        with self.quiet():
            total = np.exp(np.minimum(k * (x - finite), 0.0)).sum(axis=0, keepdims=True)
            return top + np.log(total) / k

    def softmax2(self, a: Array, b: Array, k: float) -> Array:
        """Smooth maximum (`k` > 0) or smooth minimum (`k` < 0) of two arrays."""
        top = np.maximum(a, b) if k > 0 else np.minimum(a, b)
        with self.quiet():
            gap = np.where(np.isfinite(top), np.abs(a - b), np.inf)
            return top + np.log1p(np.exp(-abs(k) * gap)) / k

    def sigmoid(self, x: Array) -> Array:
        return 0.5 + 0.5 * np.tanh(0.5 * x)

    def full(self, shape: tuple[int, ...], value: float, like: Array) -> Array:
        return np.full(shape, value, dtype=like.dtype)

    def counted(self, first: int, count: int, like: Array) -> Array:
        """Array with the numbers `first`, `first + 1`, …, `first + count - 1` along time."""
        numbers = np.arange(first, first + count, dtype=like.dtype)
        return np.broadcast_to(numbers.reshape(-1, *(1,) * (like.ndim - 1)), (count, *like.shape[1:]))

    def empty(self, shape: tuple[int, ...], like: Array) -> Array:
        return np.empty(shape, dtype=like.dtype)

    def flip(self, x: Array) -> Array:
        return x[::-1]

    def rows(self, where: Sequence[range], x: Array, value: float) -> Array:
        out = x.copy() if where else x
        for each in where:
            out[each.start : each.stop] = value
        return out

    def columns(self, x: Array) -> Sequence[Array]:
        return list(np.ascontiguousarray(x.transpose(2, 1, 0)))

    def quiet(self) -> AbstractContextManager[object]:
        context: Any = np.errstate(all="ignore")
        return context  # type: ignore[no-any-return]


for _function in FUNCTIONS.values():
    if _function.numpy:
        setattr(NumpyOps, _function.name, staticmethod(getattr(np, _function.numpy)))

NUMPY: Ops = cast("Ops", NumpyOps())
