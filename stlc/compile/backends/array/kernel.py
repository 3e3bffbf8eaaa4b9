"""Sliding extrema and `until` with exact subgradients by a C kernel, for NumPy and torch in any layout.

`windows.c` is compiled on first use (`stlc.native`), once per dtype and vector width. If it cannot be
compiled, or for other operands, `stlc.compile.backends.array.windows` computes the same with array
operations.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple, final

from stlc import native
from stlc.compile.backends.array.namespace import Sliding
from stlc.compile.schedule.schedule import Pick

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
        pick: "max" for the maximum and `until`; "min" for the minimum and `release`.
        window: layout of the windows.
        traces: length of the batch axis.
    """

    library: ctypes.CDLL
    pick: Pick
    window: Sliding
    traces: int

    def run(self, arrays: Sequence[Strided], operands: int, *, back: bool) -> None:
        """Compute extrema or `until`; with `back`, compute the gradients of the operands instead.

        Args:
            arrays: without `back`, the operands, then the array for the values. With `back`, the operands,
                then the gradients of the values, then one array for the gradient of each operand.
            operands: 1 for extrema, 2 for `until` and `release`.
            back: whether to compute gradients.

        Raises:
            MemoryError: working memory cannot be allocated.
        """
        window = self.window
        numbers = [window.rows, window.count, window.width, self.traces]
        for array in arrays:
            numbers += (array.time, array.batch)
        places = (ctypes.c_void_p * len(arrays))(*[array.address for array in arrays])
        shape = (ctypes.c_int64 * len(numbers))(*numbers)
        call = self.library.slide_all if operands == 1 else self.library.until_all
        if call(places, shape, self.pick == "max", back):
            raise MemoryError


def window_kernel(dtype: str, traces: int, operands: int, pick: Pick, window: Sliding) -> WindowKernel | None:
    """Return the kernel for operands `(time, batch)` of a dtype; None if no kernel can be used.

    The dtype must be float32 or float64, and the kernel must compile. Its working memory grows with the width
    of the windows; it must not exceed the greater of `_ROOM` bytes and the size of one operand.

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
    vector = _NARROW if traces * size <= _FEW_BYTES else _WIDE
    width = min(window.width, window.rows)
    chunk = min(window.count, max(8 * width, _CHUNK))
    rows = min(window.rows, chunk + width)
    room = vector * (2 * operands * (rows + width) + chunk)
    if room > max(_ROOM, window.rows * traces * size):
        return None
    library = _library(dtype, vector)
    return None if library is None else WindowKernel(library, pick, window, traces)


@cache
def _library(dtype: str, vector: int) -> ctypes.CDLL | None:
    """Return the library for a dtype and a vector width in bytes; None if it cannot be compiled or loaded."""
    real, index, _ = _TYPES[dtype]
    defined = f"#define REAL {real}\n#define INDEX {index}\n#define BYTES {vector}\n#define CHUNK {_CHUNK}\n"
    return native.load(defined + _SOURCE.read_text(encoding="utf-8"))
