"""Traces as tables of text: `.csv`, `.tsv`, `.txt`, also packed as `.csv.gz`.

The first lines tell the dialect: the delimiter, comments, lines of text before the header, the header with
optional units in brackets (`t, x [m], v (km/h)`), a row of units. Rows are those of RFC 4180. A cell is a
number, a word, or missing. If the first cell of a column that is not missing is a word, the column contains
words. In other columns every cell is a number, or missing: NaN, an unknown value.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.escape import spreadsheet
from stlc.files import File
from stlc.source import Span
from stlc.trace.formats.cells import Array, bare, is_missing, number_of, numbers, read_lines
from stlc.trace.formats.layout import (
    BLANKS,
    COMMENT,
    MAX_CELL,
    Layout,
    Rows,
    delimiter_of,
    filled,
    head_cells,
    layout_of,
    lines_of,
    split_head,
)
from stlc.trace.formats.registry import MAX_LETTERS, unreadable
from stlc.trace.formats.table import GROUPS, MAX_LINE, endless, place, size, text_lines, unpacked, utf8
from stlc.trace.recording import ALL, ClockGroup, Recording, Wanted
from stlc.trace.trace import Trace

__all__ = ["chunks", "delimiter_of", "filled", "head_cells", "read", "size", "split_head", "write"]

LARGE = 1_000_000
"""Size in bytes from which on a file is parsed without decoding it to text."""

_HEAD_BYTES = 1 << 16
STRETCH = 1 << 15
"""Characters of a block of lines."""
_FIRST = 4096
"""Characters of the first block, which tells which columns hold words."""
_RAGGED = -1
"""Index of a column, for rows with another number of cells than the header."""
_MAX_FINDINGS = 20
_END = re.compile(rb"\r\n|\r|\n")


def read(path: Path, wanted: Wanted = ALL) -> Recording:
    """Return the wanted columns of a table as numbers, or as texts for columns of words.

    The text is in UTF-8, UTF-16 or Windows-1252, and may be packed (gzip). Commas, semicolons, tabs, `|` or
    blanks separate the columns. If they are no commas, numbers may have decimal commas.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        TraceError: E603, the file is not text, or a cell is not a number; E605, there is no header, or a line
            has another number of cells.
    """
    data = utf8(path, unpacked(path))
    start, head = 0, _after_line(data, _HEAD_BYTES)
    if head > _HEAD_BYTES + MAX_LINE:
        raise endless(path)
    layout = layout_of(path, data[:head], wanted)
    for _ in range(layout.lines):
        start = _after_line(data, start)
    found = _Body(path, layout, wanted).read(data, start)
    if found is None:
        raise unreadable(path, "no line of numbers follows the header")
    return found


def _after_line(data: bytes, at: int) -> int:
    """Number of the byte after the end of the line that contains the byte `at`."""
    end = _END.search(data, at)
    return end.end() if end else len(data)


def chunks(path: Path, samples: int, wanted: Wanted = ALL) -> Iterator[Recording]:
    """Yield the wanted columns of a table in chunks of `samples` lines. Raises the errors of `read`."""
    lines, head = text_lines(path), bytearray()
    while len(head) < _HEAD_BYTES and (line := next(lines, b"")):
        head += line
    if not head.strip():
        return
    layout = layout_of(path, utf8(path, bytes(head)), wanted)
    body = _Body(path, layout, wanted)
    rest = chain(bytes(head).splitlines(keepends=True)[layout.lines :], lines)
    while data := b"".join(_whole_rows(rest, samples, layout.delimiter)):
        if (found := body.read(utf8(path, data))) is not None:
            yield found


def _whole_rows(lines: Iterator[bytes], samples: int, delimiter: str) -> Iterator[bytes]:
    """Yield the next `samples` lines, and those that end a row whose quoted cells contain line breaks."""
    for line in islice(lines, samples):
        if b'"' in line and not COMMENT.match(line.decode("latin-1")):
            rows = Rows((each.decode("latin-1") for each in chain([line], lines)), delimiter)
            with suppress(csv.Error):  # it is told once the row is read
                next(iter(rows), None)
            yield rows.raw.encode("latin-1")
        else:
            yield line


class _Body:
    """Reader of the rows of a table below its header, all at once or in pieces.

    Attributes:
        kept: index -> name of the columns that are read.
        kinds: index of a column -> whether it contains words, as far as the rows so far tell.
        above: number of lines of the file before the rows that are read next.
        text: the rows that are being read.
        parts: index of a column -> its values in each block of the text.
        wrong: index of a column -> rows whose cell is not a number: for each block with such rows its
            position, the number of the first of them in it, and how many they are.
    """

    def __init__(self, path: Path, layout: Layout, wanted: Wanted) -> None:
        self.path, self.layout, self.wanted = path, layout, wanted
        self.mark, self.width = layout.delimiter, len(layout.names)
        self.kept = {i: name for i, name in enumerate(layout.names) if name and wanted.keeps(name)}
        self.kinds: dict[int, bool] = {}
        self.above, self.text = layout.lines, ""
        self.parts: dict[int, list[Array]] = {}
        self.wrong: dict[int, list[tuple[int, int, int]]] = {}

    def read(self, data: bytes, start: int = 0) -> Recording | None:
        """Return the kept columns of the rows in `data`, UTF-8, from byte `start` on; None without rows.

        Raises TraceError (E603, E605).
        """
        columns = (self._by_kernel(data, start) or self._by_blocks(data, start)) if self.kept else []
        first, rows, ends = self.above + 1, len(columns[0]) if columns else 0, data.count(b"\n", start)
        self.above += ends
        if self.kept and not columns:
            return None
        names, units = self.layout.names, self.layout.units
        return Recording(
            str(self.path),
            (ClockGroup(dict(zip(self.kept.values(), columns, strict=True)), None),),
            units={name: units[name] for name in self.kept.values() if units[name]},
            others=tuple(name for i, name in enumerate(names) if name and i not in self.kept),
            clashes=self.layout.clashes,
            line=(lambda row: first + row) if 0 <= rows - ends <= 1 else None,
        )

    def _by_kernel(self, data: bytes, start: int) -> list[Array] | None:
        """Return the columns of a large table of plain numbers; None for others."""
        if any(map(self.kinds.get, self.kept)) or len(data) < LARGE or self.mark == BLANKS:
            return None
        columns = read_lines(data, start, self.width, self.mark, list(self.kept))
        for i, values in zip(self.kept, columns or (), strict=False):
            if not np.isnan(values).all():
                self.kinds[i] = False
        return columns

    def _by_blocks(self, data: bytes, start: int) -> list[Array]:
        """Return the columns of any table, read in blocks of lines."""
        text = str(memoryview(data)[start:], "utf-8")
        self.text = text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text
        self.parts, self.wrong, at = {i: [] for i in self.kept}, {}, 0
        while at < len(self.text):
            size = STRETCH if at else _FIRST
            at = self._block(at, self.text.find("\n", at + size) + 1 or len(self.text))
        if _RAGGED in self.wrong:
            raise TraceError(self._finding(_RAGGED))
        if wrong := [i for i in self.wrong if self.wanted.reads(self.kept[i])]:
            raise TraceError(*map(self._finding, wrong[:_MAX_FINDINGS]))
        if self.wrong:  # columns that might have been a clock: words and numbers are words
            self.kinds |= dict.fromkeys(self.wrong, True)
            return self._by_blocks(data, start)
        self.text = ""
        if not any(map(len, next(iter(self.parts.values())))):
            return []
        columns: list[Array] = []
        for i in self.kept:
            parts, word = self.parts.pop(i), self.kinds.get(i)
            if word is None:
                word = any(is_missing(cell) for part in parts for cell in np.unique(part) if cell)
            if not word:
                parts = [p if p.dtype.kind == "f" else np.full(len(p), np.nan) for p in parts]
            columns.append(np.concatenate(parts))
        return columns

    def _block(self, begin: int, end: int) -> int:
        block = self.text[begin:end]
        if any(mark in block for mark in ('"', "#", "%", "//")):
            rows, end = self._rows(begin, end)
        else:
            rows = [line.split(None if self.mark == BLANKS else self.mark) for line in block.split("\n")]
        full: dict[int, list[str]] = {}  # rows with a cell for each column
        ragged: list[int] = []
        for k, row in enumerate(rows):
            if not self._is_filled(row):
                continue
            if len(row) == self.width:
                full[k] = row
            elif self._is_filled(row[self.width :]) or any(self.layout.names[len(row) :]):
                ragged.append(k)
            else:
                full[k] = (row + [""] * self.width)[: self.width]
        if ragged:
            self.wrong.setdefault(_RAGGED, []).append((begin, ragged[0], len(ragged)))
        for i in self.kept:
            self._take(i, [row[i] for row in full.values()], begin, list(full))
        return end

    def _rows(self, begin: int, end: int) -> tuple[list[list[str]], int]:
        found, rows = list[list[str]](), Rows(lines_of(self.text, begin), self.mark, begin)
        try:
            for cells in rows:
                found.append(cells)
                if rows.at >= end:
                    break
        except csv.Error as error:
            raise TraceError(self._misquoted(rows, str(error))) from None
        return found, rows.at

    def _is_filled(self, cells: list[str]) -> bool:
        return bool("".join(cells).strip(" " if self.mark == "\t" else " \t"))

    def _take(self, i: int, cells: list[str], begin: int, places: list[int]) -> None:
        """Append the cells of a block to the column `i`; `places` are the numbers of their rows in it."""
        comma = self.mark != ","
        if i not in self.kinds:
            known = (number_of(cell, comma=comma) for cell in cells if not is_missing(bare(cell)))
            first = next((value for value in known if value is None or value == value), math.nan)
            if first is None or first == first:
                self.kinds[i] = first is None
        if self.kinds.get(i) is False:
            values, bad = numbers(cells, comma=comma)
            if bad:
                self.wrong.setdefault(i, []).append((begin, places[bad[0]], len(bad)))
        else:
            values = np.array([bare(cell)[:MAX_LETTERS] for cell in cells], dtype=str)
        self.parts[i].append(values)

    def _finding(self, i: int) -> Diagnostic:
        """Return what is wrong with the first row of `wrong[i]`, and how many more there are."""
        begin, number, _ = self.wrong[i][0]
        rows = Rows(lines_of(self.text, begin), self.mark, begin)
        next(islice(rows, number, None))
        cells = _spans(rows.raw, rows.at - len(rows.raw), self.mark)
        more = sum(count for _, _, count in self.wrong[i]) - 1
        help_: tuple[str, ...] = ()
        if i == _RAGGED:
            code, span = "E605", self._span(cells[0][0], cells[-1][1])
            message = f"this line has {len(cells)} cells, the header names {self.width} columns"
            note = f"{more} more line{'s' * (more > 1)} with another number of cells"
            if self.mark == "," and len(cells) == 2 * self.width:
                help_ = ("decimal commas? write a point, or separate the columns with `;`",)
        else:
            code, span = "E603", self._span(*cells[i])
            message = f"`{bare(span.text)[:80]}` is not a number"
            note = f"{more} more cell{'s' * (more > 1)} of `{self.kept[i]}` not a number"
        return Diagnostic(code, message, span, help=help_, note=(note,) if more else ())

    def _misquoted(self, rows: Rows, error: str) -> Diagnostic:
        begin, line = rows.at - len(rows.raw), rows.raw.partition("\n")[0].rstrip()
        span = self._span(begin, begin + len(line))
        if "limit" in error:
            return Diagnostic("E603", f"a cell of this row has more than {MAX_CELL:,} letters", span)
        help_ = ('a quote within a quoted cell is written twice: "say ""go"""',)
        ended = "end of data" in error
        what = "opens a quote that nothing closes" if ended else "has text behind closing quotes"
        return Diagnostic("E603", f"this row {what}", span, help=help_)

    def _span(self, start: int, end: int) -> Span:
        return place(self.path, self.above, self.text, start, end)


def _spans(row: str, at: int, delimiter: str) -> list[tuple[int, int]]:
    """Places of the cells of a row at position `at`: first character and end."""
    mark, spans = re.escape(delimiter), list[tuple[int, int]]()
    cell = r'("(?:[^"]|"")*"\S*|\S+)'
    if delimiter != BLANKS:
        cell = rf'(?:\A|{mark})((?: *"(?:[^"]|"")*")?[^{mark}]*)'
    for found in re.finditer(cell, row.rstrip("\n")):
        first = found.end(1) - len(found[1].lstrip())
        end = found.start(1) + len(found[1].rstrip())
        spans.append((at + first, at + max(end, first + 1)))
    return spans


def write(path: Path | str, trace: Trace) -> None:
    """Write the signals of a trace, one line per sample.

    If there are several traces, a column `trace` contains the number of the trace.

    Raises:
        TraceError: E605, a signal is called `trace` or `agent`, or has a name that would be read back
            differently.
        MissingError: R201, no space left or no permission.
    """
    if grouped := [name for name in trace.data if name in GROUPS]:
        message = f"the column `{grouped[0]}` of a `.csv` says which trace a line is of"
        raise TraceError.of("E605", message, help=("write a `.npz`, which has no such column",))
    columns: dict[str, NDArray[Any]] = {"t": np.tile(trace.times, trace.traces)}
    if trace.traces > 1:
        columns = {GROUPS[0]: np.repeat(np.arange(trace.traces), trace.samples), **columns}
    columns |= {name: values.ravel() for name, values in trace.data.items()}
    write_csv(path, columns, {column.name: column.unit.text for column in trace.signature.columns})


def write_csv(path: Path | str, columns: Mapping[str, NDArray[Any]], units: Mapping[str, str]) -> None:
    """Write columns of equal length so that reading the file gives the same numbers again.

    The first line names the columns. A spreadsheet program would run a name such as `=1+1` as a formula. An
    apostrophe is therefore put before it, which the reader removes.

    Raises:
        TraceError: E605, a name would be read back differently, such as a name with a unit in brackets.
        MissingError: R201, no space left or no permission; an existing file is not changed.
    """
    names = list(columns)
    heads = [f"{name} [{units[name]}]" if units.get(name) else name for name in names]
    if _names_in(heads) != names:
        odd = next((name for name in names if _names_in([name]) != [name]), names[0])
        message = f"no column of a `.csv` can be called `{odd}`"
        raise TraceError.of("E605", message, help=("write a `.npz`, which holds any name",))
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    File(path).write(_line(heads) + "".join(f"{','.join(map(repr, row))}\n" for row in rows))


def _names_in(heads: Sequence[str]) -> list[str]:
    """Names that the reader finds in a header with the cells `heads` above numbers; [] if it finds none."""
    text = f"{_line(heads)}{','.join('0' * len(heads))}\n"
    with suppress(TraceError):
        return list(layout_of(Path(), text.encode("utf-8", "replace"), ALL).names)
    return []


def _line(cells: Sequence[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(map(spreadsheet, cells))
    return text.getvalue()
