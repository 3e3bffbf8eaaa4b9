"""Cells of a table -> numbers: one at a time, or all of a large file in little more than their memory.

`cells.c` reads large texts where there is a C compiler (`stlc.native`), else NumPy's reader does, a stretch
at a time. Both leave what is unusual to others.
"""

from __future__ import annotations

import ctypes
import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.IGNORECASE)

_WORDS = {"true": 1.0, "false": 0.0}
_ANY = re.compile(r"\S")
_SOURCE = Path(__file__).with_name("cells.c")
_STRETCH = 1 << 18
"""Bytes that NumPy's reader is given at a time."""
_DOUBTS = 32
"""One cell in so many may be unusual."""
_TOO_MANY = -2


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines of a table: the bytes from `start` on, so many cells a line, and what stands between them."""

    data: bytes
    start: int
    width: int
    delimiter: str


def bare(raw: str) -> str:
    """The text of a cell, blanks and quotes taken off."""
    text = raw.strip()
    quoted = len(text) >= 2 and text[0] == text[-1] == '"'
    return text[1:-1].strip() if quoted else text


def value_of(text: str) -> float | None:
    """What the bare text of a cell is worth: NaN where it is empty, None where it is no number."""
    if NUMBER.fullmatch(text):
        return float(text)
    return _WORDS.get(text.lower()) if text else math.nan


def load(body: str, delimiter: str, columns: Sequence[int] | None = None) -> Array | None:
    """The numbers of these columns, (lines, columns); None where something is none, or nothing is there."""
    if not _ANY.search(body):
        return None
    lines = io.TextIOWrapper(io.BytesIO(body.encode()), "utf-8")  # a StringIO is four times as large
    try:
        with lines:
            return np.loadtxt(
                lines, delimiter=delimiter, comments=None, ndmin=2, dtype=np.float64, usecols=columns
            )
    except ValueError:
        return None


def read_lines(lines: Lines) -> list[Array] | None:
    """The columns of a table of numbers; None where a line or a cell is not what it should be.

    Lines may end in any way. Lines of empty cells are left out; an empty cell beside others is NaN.
    """
    library = _library()
    return _by_numpy(lines) if library is None else _by_kernel(library, lines)


@cache
def _library() -> ctypes.CDLL | None:
    """The built `cells.c`; None where there is no compiler for it."""
    from stlc.native import load

    library = load(_SOURCE.read_text(encoding="utf-8"))
    if library is None:
        return None
    library.read_cells.argtypes = [ctypes.c_void_p] * 4
    library.read_cells.restype = ctypes.c_int64
    return library


def _by_kernel(library: ctypes.CDLL, lines: Lines) -> list[Array] | None:
    text, width = np.frombuffer(lines.data, dtype=np.uint8)[lines.start :], lines.width
    size = len(text)
    rows = min(lines.data.count(b"\n") + lines.data.count(b"\r") + 1, size // width + 1)
    most = rows * width // _DOUBTS + 1
    shape = np.array([size, width, rows, most, ord(lines.delimiter)], dtype=np.int64)
    try:
        out, doubts = np.empty((width, rows)), np.empty(1 + 4 * most, dtype=np.int64)
    except MemoryError:
        return None
    found: int = library.read_cells(*(array.ctypes.data for array in (text, shape, out, doubts)))
    if found == _TOO_MANY:
        return _by_numpy(lines)
    if found < 1:
        return None
    for row, column, first, last in doubts[1 : 1 + 4 * int(doubts[0])].reshape(-1, 4).tolist():
        value = _doubted(lines.data[lines.start + first : lines.start + last])
        if value is None:
            return None
        out[column, row] = value
    return list(out[:, :found])


def _doubted(cell: bytes) -> float | None:
    try:
        return value_of(bare(cell.decode()))
    except UnicodeDecodeError:
        return None


def _by_numpy(lines: Lines) -> list[Array] | None:
    """A stretch after the other; every column is put together, and its stretches are let go."""
    parts: list[list[Array]] = [[] for _ in range(lines.width)]
    for stretch in _stretches(lines):
        try:
            values = load(stretch.decode(), lines.delimiter)
        except UnicodeDecodeError:
            return None
        if values is None or values.shape[1] != lines.width:
            return None
        for part, column in zip(parts, values.T, strict=True):
            part.append(column.copy())
    columns: list[Array] = []
    for part in filter(None, parts):
        columns.append(np.concatenate(part))
        part.clear()
    return columns or None


def _stretches(lines: Lines) -> Iterator[bytes]:
    data, begin = lines.data, lines.start
    while begin < len(data):
        end = data.find(b"\n", begin + _STRETCH) + 1 or len(data)
        yield data[begin:end]
        begin = end
