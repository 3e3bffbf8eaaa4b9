"""Sliding extrema and `until` with exact subgradients by a kernel in C, for NumPy and torch in any layout.

`windows.c` is built on first use (`stlc.native`), once for a dtype and a width of vectors. Where it cannot be
built, or the operands are of another kind, there is no kernel, and `stlc.compile.backends.array.windows` does
the same in array operations.
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
"""Bytes of a vector, for many traces and for a few."""

_FEW_BYTES = 32
"""Bytes of one instant up to which there are few traces."""

_ROOM = 1 << 25
"""Bytes of working memory that are allowed whatever the size of the operands."""

_CHUNK = 4096
"""Windows that are taken at a time, at least; `CHUNK` in C."""


class Strided(NamedTuple):
    """An array `(time, batch)` in memory: address of its first number, and strides in numbers."""

    address: int
    time: int
    batch: int


@final
@dataclass(frozen=True, slots=True)
class WindowKernel:
    """The compiled kernel for one kind of extremum over one layout of windows.

    Attributes:
        library: the kernel for the dtype of the operands.
        pick: "max" is the maximum, and `until`; "min" the minimum, and `release`.
        window: the windows.
        traces: length of the batch axis.
    """

    library: ctypes.CDLL
    pick: Pick
    window: Sliding
    traces: int

    def run(self, arrays: Sequence[Strided], operands: int, *, back: bool) -> None:
        """Fill values from operands; with `back` the gradients of the operands from that of the values.

        Args:
            arrays: operands; values, or with `back` their gradient and then those of the operands.
            operands: 1 for extrema, 2 for `until` and `release`.
            back: whether gradients are wanted.

        Raises:
            MemoryError: there is no room.
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
    """The kernel for operands `(time, batch)` of a dtype; None where there is none for them.

    Working memory grows with the width of the windows; beyond `_ROOM` bytes and the size of an operand there
    is no kernel.
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
    """The kernel for a dtype and a width of vectors in bytes; None where it cannot be built or loaded."""
    real, index, _ = _TYPES[dtype]
    defined = f"#define REAL {real}\n#define INDEX {index}\n#define BYTES {vector}\n#define CHUNK {_CHUNK}\n"
    return native.load(defined + _SOURCE.read_text(encoding="utf-8"))
