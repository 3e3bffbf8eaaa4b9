"""C kernel for extrema over sliding windows and for `until`, with exact subgradients.

It works on arrays of NumPy and torch with any memory layout. `windows.c` is compiled on first use
(`stlc.native`), once for each dtype and vector width. If the code cannot be compiled, or the operands do not
suit the kernel, `stlc.compile.backends.array.windows` computes the same with array operations.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias, final, get_args

from stlc import native
from stlc.compile.namespace import Pick, Sliding

Direction: TypeAlias = Literal["values", "pull", "push"]
"""Results of a kernel: values, gradients of the operands, or changes of the values."""

_SOURCE = Path(__file__).with_name("windows.c")
_TYPES = {"float32": ("float", "int32_t", 4), "float64": ("double", "int64_t", 8)}
"""dtype -> its C type, an integer type as wide, and bytes."""

_WIDE, _NARROW = 64, 16
"""Vector widths in bytes, for many traces and for few."""

_FEW_BYTES = 32
"""Row size in bytes up to which the narrow vectors are used."""

_ROOM = 1 << 25
"""Working memory in bytes that is always allowed."""

_CHUNK = 4096
"""Minimum number of windows per chunk; `CHUNK` in C."""


class Strided(NamedTuple):
    """Memory layout of an array `(time, batch)`: address of its first element, and strides in elements."""

    address: int
    time: int
    batch: int


@final
@dataclass(frozen=True, slots=True)
class WindowKernel:
    """Compiled kernel for one kind of extremum and one layout of windows.

    Attributes:
        library: compiled C library for the dtype of the operands.
        operands: 1 for extrema, 2 for `until` and `release`.
        pick: "max" for the maximum and `until`; "min" for the minimum and `release`.
        window: layout of the windows.
        traces: length of the batch axis.
    """

    library: ctypes.CDLL
    operands: int
    pick: Pick
    window: Sliding
    traces: int

    def run(self, arrays: Sequence[Strided], direction: Direction = "values") -> None:
        """Compute extrema or `until`, or their derivatives.

        Args:
            arrays: the operands; then for "pull" the gradient of the values, for "push" a change of each
                operand; then the arrays that receive the results: the values, the gradient of each operand,
                or the change of the values.
            direction: which of these are computed.

        Raises:
            MemoryError: working memory cannot be allocated.
        """
        window = self.window
        numbers = [window.rows, window.count, window.width, self.traces]
        for array in arrays:
            numbers += (array.time, array.batch)
        places = (ctypes.c_void_p * len(arrays))(*[array.address for array in arrays])
        shape = (ctypes.c_int64 * len(numbers))(*numbers)
        call = self.library.slide_all if self.operands == 1 else self.library.until_all
        if call(places, shape, self.pick == "max", get_args(Direction).index(direction)):
            raise MemoryError


def window_kernel(dtype: str, traces: int, operands: int, pick: Pick, window: Sliding) -> WindowKernel | None:
    """Return the kernel for operands `(time, batch)` of the type `dtype`; None if no kernel can be used.

    A kernel can be used if `dtype` is float32 or float64, if the kernel compiles, and if its working memory
    is small enough. This memory grows with the width of the windows. The limit is `_ROOM` bytes or the size
    of one operand, whichever is greater.

    Args:
        dtype: name of the dtype.
        traces: length of the batch axis.
        operands: 1 for an extremum, 2 for `until` and `release`.
        pick: "max" for a maximum or `until`, "min" for a minimum or `release`.
        window: layout of the windows.
    """
    if dtype not in _TYPES:
        return None
    size = _TYPES[dtype][2]
    few = traces * size <= _FEW_BYTES
    vector = _NARROW if few else _WIDE
    width = min(window.width, window.rows)
    chunk = min(window.count, max(8 * width, _CHUNK))
    rows = min(window.rows, chunk + width)
    room = vector * (2 * operands * (rows + width) + chunk)
    if room > max(_ROOM, window.rows * traces * size):
        return None
    library = kernel_library(dtype, few=few)
    return None if library is None else WindowKernel(library, operands, pick, window, traces)


@cache
def kernel_library(dtype: str, *, few: bool = True) -> ctypes.CDLL | None:
    """Return the compiled library for a dtype, and for few traces or for many; None if it is unavailable."""
    if dtype not in _TYPES:
        return None
    real, index, _ = _TYPES[dtype]
    vector = _NARROW if few else _WIDE
    defined = f"#define REAL {real}\n#define INDEX {index}\n#define BYTES {vector}\n#define CHUNK {_CHUNK}\n"
    library = native.load(defined + _SOURCE.read_text(encoding="utf-8"))
    if library is not None:
        pointers, numbers = [ctypes.c_void_p] * 3, [ctypes.c_int64] * 4
        library.double_all.argtypes = [*pointers[1:], *numbers, ctypes.c_int]
        library.end_all.argtypes = [*pointers, *numbers[1:], ctypes.c_int]
        library.run_all.argtypes = [ctypes.c_char_p, numbers[0], pointers[0], *numbers[:2]]
    return library
