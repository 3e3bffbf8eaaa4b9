"""Conversion of the cells of a table to numbers: one cell at a time or, for large files, all at once.

There are three readers of large texts. `cells.c` is used if there is a C compiler (`stlc.native`), else Arrow
if it is installed, else NumPy in blocks. All give the same numbers. All reject texts with unusual cells. A
slower reader then reads these texts.
"""

from __future__ import annotations

import ctypes
import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.IGNORECASE)

_WORDS = {"true": 1.0, "false": 0.0}
_ANY = re.compile(r"\S")
_SOURCE = Path(__file__).with_name("cells.c")
STRETCH = 1 << 18
"""Bytes, or characters, per block for NumPy's reader."""
_PLAIN = bytes({*range(32, 127), *b"\t\n\r"} - {*b'"('})
"""Characters that Arrow reads correctly: neither quotes nor `nan(1)`."""
_DOUBTS = 32
"""Inverse of the greatest share of cells that may be unusual."""
_TOO_MANY = -2


@dataclass(frozen=True, slots=True)
class TableText:
    """The text of a table: it begins at byte `start`, after the header, and has `width` columns."""

    data: bytes
    start: int
    width: int
    delimiter: str


def bare(raw: str) -> str:
    """Return the text of a cell without surrounding blanks and quotes."""
    text = raw.strip()
    quoted = len(text) >= 2 and text[0] == text[-1] == '"'
    return text[1:-1].strip() if quoted else text


def value_of(text: str) -> float | None:
    """Return the number in a cell's text: NaN if it is empty, None if it is not a number."""
    if NUMBER.fullmatch(text):
        return float(text)
    return _WORDS.get(text.lower()) if text else math.nan


def load(body: str, delimiter: str, columns: Sequence[int] | None = None) -> Array | None:
    """Return the numbers in the columns with indices `columns`, (lines, columns).

    Empty cells are NaN, truth values are 0 and 1. Quotes around a number are removed. None is returned if
    there are no lines, or if any other cell is not a number.
    """
    if not _ANY.search(body):
        return None
    values = _loaded(body, delimiter, columns)
    if values is not None:
        return values
    mended = _mended(body.replace("\r\n", "\n").replace("\r", "\n"), delimiter)
    return _loaded(mended, delimiter, columns) if mended else None


def _loaded(body: str, delimiter: str, columns: Sequence[int] | None) -> Array | None:
    lines = io.TextIOWrapper(io.BytesIO(body.encode()), "utf-8")  # a StringIO is four times as large
    try:
        with lines:
            return np.loadtxt(
                lines, delimiter=delimiter, comments=None, ndmin=2, dtype=np.float64, usecols=columns
            )
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class _Repair:
    """Patterns of cells that NumPy's reader refuses, such as empty or quoted ones.

    The function `_mended` uses them to rewrite these cells.
    """

    empty: re.Pattern[str]
    quoted: re.Pattern[str]
    truth: re.Pattern[str]
    gap: re.Pattern[str]


@cache
def _repair(delimiter: str) -> _Repair:
    mark = re.escape(delimiter)
    blank, ends = "[ ]" if delimiter == "\t" else "[ \t]", f"(?={mark}|$)"
    return _Repair(
        re.compile(rf"^[ \t{mark}]*\n|^[ \t{mark}]+\Z", re.MULTILINE),
        re.compile(rf'(^|{mark}){blank}*"([^"\n{mark}]*)"{blank}*{ends}', re.MULTILINE),
        re.compile(rf"(^|{mark}){blank}*(true|false){blank}*{ends}", re.MULTILINE | re.IGNORECASE | re.ASCII),
        re.compile(rf"(?<={mark}){blank}*{ends}|^{blank}*(?={mark})", re.MULTILINE),
    )


def _mended(body: str, delimiter: str) -> str:
    """Text without empty lines, and with numbers in place of empty cells, truth values and quoted cells."""
    repair = _repair(delimiter)
    body = repair.empty.sub("", body)
    if '"' in body:
        body = repair.quoted.sub(lambda found: found[1] + (found[2].strip() or "nan"), body)
    if any(letter in body for letter in "tTfF"):
        body = repair.truth.sub(lambda found: found[1] + ("1" if found[2].lower() == "true" else "0"), body)
    if " " in body or "\t" in body:
        return repair.gap.sub("nan", body)
    for _ in range(2):  # of `,,,` the second is found once the first has got its number
        body = body.replace(delimiter * 2, f"{delimiter}nan{delimiter}")
    body = body.replace(f"{delimiter}\n", f"{delimiter}nan\n").replace(f"\n{delimiter}", f"\nnan{delimiter}")
    return f"{'nan' * body.startswith(delimiter)}{body}{'nan' * body.endswith(delimiter)}"


def read_lines(lines: TableText) -> list[Array] | None:
    """Return the columns of a table of numbers, (lines,) each; None if a line or cell is unusual.

    Any line ending is allowed. A line is left out if all its cells are empty. In other lines, empty cells are
    NaN.
    """
    library = _library()
    if library is not None:
        return _by_kernel(library, lines)
    found = _by_arrow(lines)
    return _by_numpy(lines) if found is None else found


# ----------------------------------------------------------------------------- the kernel


@cache
def _library() -> ctypes.CDLL | None:
    """The compiled library of `cells.c`; None if there is no C compiler."""
    from stlc.native import load

    library = load(_SOURCE.read_text(encoding="utf-8"))
    if library is None:
        return None
    library.read_cells.argtypes = [ctypes.c_void_p] * 4
    library.read_cells.restype = ctypes.c_int64
    return library


def _by_kernel(library: ctypes.CDLL, lines: TableText) -> list[Array] | None:
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


# ------------------------------------------------------------------------ without a compiler


@cache
def _arrow() -> Any:
    """Arrow's module for reading tables; None if Arrow is not installed."""
    try:
        return import_module("pyarrow.csv")
    except ImportError:
        return None


def _by_arrow(lines: TableText) -> list[Array] | None:
    """Read all lines with Arrow; None if Arrow is not installed or a line is unusual."""
    csv = _arrow()
    if csv is None or lines.data[lines.start :].translate(None, _PLAIN):
        return None
    arrow = import_module("pyarrow")
    names = [str(i) for i in range(lines.width)]
    try:
        table = csv.read_csv(
            arrow.py_buffer(lines.data).slice(lines.start),
            read_options=csv.ReadOptions(column_names=names),
            parse_options=csv.ParseOptions(delimiter=lines.delimiter, quote_char=False),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(names, arrow.float64()), null_values=[""], check_utf8=False
            ),
        )
    except (arrow.ArrowException, ValueError, OverflowError, MemoryError):
        return None
    columns = [np.asarray(column, dtype=np.float64) for column in table.columns]
    if all(column.null_count for column in table.columns):  # some lines may be empty
        filled = ~np.logical_and.reduce([np.asarray(column.is_null()) for column in table.columns])
        columns = [column[filled] for column in columns]
    return columns if len(columns[0]) else None


def _by_numpy(lines: TableText) -> list[Array] | None:
    """Read the columns with NumPy, in blocks of lines to bound memory; None if a line is unusual."""
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


def _stretches(lines: TableText) -> Iterator[bytes]:
    data, begin = lines.data, lines.start
    while begin < len(data):
        end = data.find(b"\n", begin + STRETCH) + 1 or len(data)
        yield data[begin:end]
        begin = end
