"""Conversion of the cells of a table to numbers: of one cell, of a column, or of many lines at once.

`value_of` says what is a number. `cells.c` gives the same numbers of large texts faster, if there is a C
compiler (`stlc.native`). It rejects texts with unusual cells.
"""

from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_MISSING = re.compile(
    r"n\.?/?a\.?|null|none|nil|nat|<na>|#na|#n/a(?: n/a)?|#(?:num|div/0|value|ref)!|-{1,3}|[?.]",
    re.IGNORECASE,
)
"""Words that stand for a missing value, as an empty cell and `nan` do."""
_WORDS = {"true": 1.0, "false": 0.0}
_OF_WINDOWS = re.compile(r"([+-]?)(?:1\.#(inf|ind|qnan|snan)0*|nan\((?:ind|snan)\))", re.IGNORECASE)
"""Infinity and NaN, as C programs under Windows print them."""
_SOURCE = Path(__file__).with_name("cells.c")
_DOUBTS = 32
"""Inverse of the greatest share of cells that may be unusual."""


def bare(raw: str) -> str:
    """Return the text of a cell without surrounding blanks and quotes."""
    text = raw.strip()
    return text[1:-1].strip() if len(text) >= 2 and text[0] == text[-1] == '"' else text


def value_of(text: str) -> float | None:
    """Return the number in a cell's text: NaN if it is empty or `NA`, None if it is not a number."""
    try:
        value = float(text)
    except ValueError:
        if found := _OF_WINDOWS.fullmatch(text):
            return float(f"{found[1]}{'inf' if (found[2] or '').lower() == 'inf' else 'nan'}")
        return math.nan if is_missing(text) else _WORDS.get(text.lower())
    return None if "_" in text else value


def is_missing(text: str) -> bool:
    """True if a cell's text is empty, or a word that stands for a missing value."""
    return not text or _MISSING.fullmatch(text) is not None


def number_of(cell: str, *, comma: bool) -> float | None:
    """Return the number in a cell, as `value_of`; if `comma` is set, it may have a decimal comma."""
    text = bare(cell)
    value = value_of(text)
    return value_of(text.replace(",", ".")) if value is None and comma and "," in text else value


def numbers(cells: Sequence[str], *, comma: bool) -> tuple[Array, list[int]]:
    """Return the numbers in cells, and the indices of the cells that are not numbers, which are NaN.

    If `comma` is set, numbers may have decimal commas.
    """
    if "_" not in "".join(cells):
        with suppress(ValueError):
            return np.fromiter(map(float, cells), np.float64, len(cells)), []
    values = [number_of(cell, comma=comma) for cell in cells]
    return np.array(values, dtype=np.float64), [i for i, value in enumerate(values) if value is None]


@cache
def _library() -> ctypes.CDLL | None:
    """The compiled library of `cells.c`; None if there is no C compiler."""
    from stlc.native import load

    library = load(_SOURCE.read_text(encoding="utf-8"))
    if library is not None:
        library.read_cells.argtypes = [ctypes.c_void_p] * 5
        library.read_cells.restype = ctypes.c_int64
    return library


def read_lines(
    data: bytes, start: int, width: int, delimiter: str, wanted: Sequence[int], *, each: bool = False
) -> list[Array] | None:
    """Return the columns `wanted` of a table of numbers in UTF-8 from byte `start` on, (lines,) each.

    The table has `width` columns. If the delimiter is no comma, numbers may have decimal commas. Any line
    ending is allowed. Lines of empty cells are left out; in others, empty cells are NaN. If `each` is set,
    each line must have `width` cells that are not all empty, and end with a line feed. None is returned if
    there is no C compiler, or if a line or a wanted cell is unusual.
    """
    library = _library()
    if library is None:
        return None
    text, comma = np.frombuffer(data, dtype=np.uint8)[start:], delimiter != ","
    ends = sum(data.count(end) for end in (b"\n", b"\r") if end in data)  # `in` is far cheaper
    rows = min(ends, len(text) // width) + 1
    most = rows * len(wanted) // _DOUBTS + 1
    point = "," if comma else "."
    shape = np.array([len(text), width, rows, most, ord(delimiter), ord(point), each], dtype=np.int64)
    places = np.full(width, -1, dtype=np.int64)
    places[list(wanted)] = range(len(wanted))
    try:
        out, doubts = np.empty((len(wanted), rows)), np.empty(1 + 4 * most, dtype=np.int64)
    except MemoryError:
        return None
    found: int = library.read_cells(*(array.ctypes.data for array in (text, shape, places, out, doubts)))
    if found < 1:
        return None
    vague: set[int] = set()
    for row, place, first, last in doubts[1 : 1 + 4 * int(doubts[0])].reshape(-1, 4).tolist():
        cell = data[start + first : start + last].decode()
        value = number_of(cell, comma=comma)
        if value is None:
            return None
        out[place, row] = value
        if is_missing(bare(cell)):
            vague.add(place)
    if any(np.isnan(out[place, :found]).all() for place in vague):  # words, as far as anybody can tell
        return None
    return list(out[:, :found])
