"""Layout of a table of text, as its first lines tell it: delimiter, header, units; and its rows as cells."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from stlc.diagnostics import TraceError
from stlc.escape import from_spreadsheet
from stlc.source import Source
from stlc.trace.formats.cells import bare, is_missing, number_of
from stlc.trace.formats.registry import unreadable
from stlc.trace.recording import Wanted
from stlc.units import Unit

_SAMPLES = (20, 500)
"""Numbers of rows in which the header is looked for, one after the other."""
_LONG = 1000
"""Characters from which on a cell of the header is a name only."""
MAX_CELL = 10_000_000
BLANKS = " "
"""Delimiter of tables in which any number of blanks and tabs separates two cells."""
_DELIMITERS = ",;\t|"
_HEAD = re.compile(r"(?P<name>[^\[\]]*[^\[\]\s](?:\[\d+\])?)\s*(?:\[(?P<unit>[^\]]*)\])?")
_ROUND = re.compile(r"(?P<name>.*[^\s(])\s*\((?P<unit>[^()]+)\)")
COMMENT = re.compile(r" *(?:#(?!N/?A\b|(?:NUM|DIV/0|VALUE|REF)!)#*|%(?!time\b)%*|//+)[ \t]*", re.IGNORECASE)
_SEP = re.compile(r'"?sep=(.)"?[ \t,;]*\n', re.IGNORECASE)
_QUOTED = re.compile(r'"(?:[^"]|"")*"')
_LIKE_NUMBER = re.compile(r"[+-]?[.,]?\d")
_TIMES = re.compile(r"secs?|[mun]secs?|(?:milli|micro|nano)(?:s|seconds?)|seconds?|mins|hrs?", re.IGNORECASE)
"""Words for units of time, besides their symbols."""
_NO_UNIT = ("", "-", "--", "none", "n/a", "na", "1")


class Rows:
    """Rows of a table as lists of cells, by the rules of RFC 4180, without comments between rows.

    Iterating raises `csv.Error` if quotes are not closed, or if text follows closing quotes.

    Attributes:
        at: position at which the row that was read last ends; at first, that of the first line.
    """

    def __init__(self, lines: Iterable[str], delimiter: str, at: int = 0) -> None:
        self.at = at
        self._lines, self._delimiter = lines, delimiter
        self._taken: list[str] = []

    def __iter__(self) -> Iterator[list[str]]:
        csv.field_size_limit(MAX_CELL)  # files of images beside numbers; the limit is that of the process
        for row in csv.reader(self._usable(), delimiter=self._delimiter, skipinitialspace=True, strict=True):
            yield row
            self._taken.clear()

    @property
    def raw(self) -> str:
        """Text of the row that was read last."""
        return "".join(self._taken)

    def _usable(self) -> Iterator[str]:
        """Yield the lines of rows, without blanks behind quotes, and with one blank for many as delimiter."""
        blank = " " if self._delimiter == "\t" else r"[ \t]"
        loose = re.compile(rf'"{blank}+(?={re.escape(self._delimiter)}|$)')
        for line in self._lines:
            self.at += len(line)
            if not self._taken and COMMENT.match(line):
                continue
            self._taken.append(line)
            if self._delimiter == BLANKS:
                yield f"{' '.join(line.split())}\n"
            else:
                yield loose.sub('"', line) if '" ' in line or '"\t' in line else line


def lines_of(text: str, begin: int) -> Iterator[str]:
    """Yield the lines of a text from position `begin` on, with their line breaks."""
    while begin < len(text):
        end = text.find("\n", begin) + 1 or len(text)
        yield text[begin:end]
        begin = end


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of a table.

    Attributes:
        delimiter: character between two cells, or `BLANKS`.
        names: names of the columns; "" for a column without a name, which is not read.
        units: name -> unit as text, "" if there is none.
        clashes: as of `Recording`.
        lines: number of lines before the first row of data.
    """

    delimiter: str
    names: tuple[str, ...]
    units: Mapping[str, str]
    clashes: Mapping[str, Mapping[str, str]]
    lines: int


@dataclass(frozen=True, slots=True)
class _Row:
    """A row among the first of a file, from position `begin` to position `end` of the text.

    Attributes:
        cells: its cells, without quotes; of a comment, those of the text.
        kinds: for each cell `n` for a number, `d` for another text that begins like a number, such as a date,
            `w` for a word, and "" if it is missing.
        comment: whether the row is a comment, which may be a header all the same (`# t, x`).
    """

    cells: list[str]
    kinds: list[str]
    comment: bool
    begin: int
    end: int

    @property
    def is_data(self) -> bool:
        """True if the row contains numbers, at least two cells, and no words."""
        filled = [kind for kind in self.kinds if kind]
        return not self.comment and len(filled) > 1 and "n" in filled and "w" not in filled

    def fits(self, other: _Row) -> bool:
        """True if the other row has as many cells, apart from empty ones at the end."""
        return not any(self.cells[len(other.cells) :]) and not any(other.cells[len(self.cells) :])

    def is_like(self, other: _Row) -> bool:
        """True if both rows may be data of one table: numbers above numbers, and words above words."""
        pairs = [(a == "w", b == "w") for a, b in zip(self.kinds, other.kinds, strict=False) if a and b]
        return (False, False) in pairs and all(a == b for a, b in pairs) and self.fits(other)


@dataclass(frozen=True, slots=True)
class _Header:
    """A row that may be the header, and the row of units below it."""

    rank: tuple[bool, bool]
    delimiter: str
    row: _Row
    units: _Row | None = None

    @property
    def width(self) -> int:
        return len(self.row.cells)


def layout_of(path: Path, data: bytes, wanted: Wanted) -> Layout:
    """Return the layout of a table that begins with the lines `data`.

    Raises TraceError (E603, E605) if there is no row, or no header where `wanted` does not give it.
    """
    text = data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    if not text.strip():
        raise unreadable(path, "it is empty")
    stated = _SEP.match(text, len(text) - len(text.lstrip()))
    start = stated.end() if stated else 0
    marks = stated[1] if stated else [mark for mark in _DELIMITERS if mark == "," or mark in text]
    for most in _SAMPLES:
        tried = {mark: _first_rows(text, start, mark, most) for mark in marks}
        best = _likeliest(tried)
        if not stated and (best is None or best.width == 1):
            tried[BLANKS] = _first_rows(text, start, BLANKS, most)
            best = _likeliest(tried)
        if best is not None:
            break
    source, names = Source(str(path), text), wanted.columns
    if names and (best is None or best.row.comment):
        return _without_header(source, tried, names)
    header = best or _without_numbers(source, tried)
    row, units = header.row, header.units
    lines = text.count("\n", 0, (units or row).end) + 1
    layout = _named(header.delimiter, row.cells, units.cells if units else (), lines)
    if not names:
        return layout
    if layout.names != tuple(split_head(name)[0] for name in names):
        message = f"the file names its columns itself: {', '.join(row.cells)}"
        help_ = ("leave out --columns,  and use  --map SIGNAL=NAME",)
        raise TraceError.of("E605", message, source.span(row.begin, row.end), help=help_)
    return _named(header.delimiter, names, (), lines)


def _without_numbers(source: Source, tried: Mapping[str, list[_Row]]) -> _Header:
    """Return the first row as the header of a table in which no row of numbers follows a row of names."""
    usual = next(iter(tried))
    first = next((row for row in tried[usual] if not row.comment), None)
    if first is None:
        raise unreadable(source.name, "no line of numbers follows the header")
    mark = delimiter_of(source.text[first.begin : first.end])
    if mark not in tried or any(row.is_data for row in tried.get(BLANKS, ())):
        mark = BLANKS if BLANKS in tried else usual
    row = next((row for row in tried[mark] if not row.comment), first)
    if {"n", "d"} & set(row.kinds):
        help_ = ("--columns t,x,v  names the columns of a file without a header",)
        message = "the first line holds numbers, not names: it must name the columns"
        raise TraceError.of("E605", message, source.span(row.begin, row.end), help=help_)
    return _Header((True, True), mark, row)


def _without_header(source: Source, tried: Mapping[str, list[_Row]], names: Sequence[str]) -> Layout:
    for mark, rows in tried.items():
        for row in rows:
            fits = len(row.cells) >= len(names) and not any(row.cells[len(names) :])
            if not row.comment and "n" in row.kinds and fits:
                return _named(mark, names, (), source.text.count("\n", 0, row.begin))
    most = max((len(row.cells) for rows in tried.values() for row in rows if row.is_data), default=0)
    message = f"the lines of `{source.name}` have {most} numbers, --columns names {len(names)} columns"
    raise TraceError.of("E605", message, help=("an empty name leaves a column out: `t,,v`",))


def _named(delimiter: str, heads: Sequence[str], units: Sequence[str], lines: int) -> Layout:
    """Return the layout of a table whose header has the cells `heads`, and ends after `lines` lines."""
    names, stated = map(list, zip(*(split_head(from_spreadsheet(head)) for head in heads), strict=True))
    for i, cell in enumerate(units[: len(names)]):
        unit = cell[1:-1].strip() if _is_bracketed(cell) else cell
        stated[i] = stated[i] or ("" if unit.lower() in _NO_UNIT else unit)
    places: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        places.setdefault(name, []).append(i)
    clashes: dict[str, dict[str, str]] = {}
    for name, found in places.items():
        if name and len(found) > 1:
            mark = "#"
            while any(f"{name}{mark}{k}" in places for k in range(1, len(found) + 1)):
                mark += "#"
            for k, i in enumerate(found, 1):
                names[i] = clashes.setdefault(name, {})[f"column {i + 1}"] = f"{name}{mark}{k}"
    return Layout(delimiter, tuple(names), dict(zip(names, stated, strict=True)), clashes, lines)


def _first_rows(text: str, at: int, delimiter: str, most: int) -> list[_Row]:
    rows: list[_Row] = []
    while at < len(text) and len(rows) < most:
        begin, comment = at, COMMENT.match(text, at)
        first = comment.end() if comment else begin
        line = next(lines_of(text, first), "")
        records = Rows([line] if comment else lines_of(text, first), delimiter, first)
        try:
            raw, at = next(iter(records), []), records.at
        except csv.Error:
            raw, at = line.split(None if delimiter == BLANKS else delimiter), first + len(line)
        cells = [bare(cell) for cell in raw]
        if any(cells):
            kinds = [_kind(cell, delimiter) for cell in cells]
            end = begin + len(text[begin:at].rstrip())
            rows.append(_Row(cells, kinds, comment is not None, begin, end))
    return rows


def _kind(cell: str, delimiter: str) -> str:
    if is_missing(cell):
        return ""
    if number_of(cell, comma=delimiter != ",") is not None:
        return "n"
    return "d" if _LIKE_NUMBER.match(cell) else "w"


def _likeliest(tried: Mapping[str, list[_Row]]) -> _Header | None:
    """Return the likeliest header, by delimiter and first rows; None if no row is one."""
    each = [max(_headers(mark, rows), key=lambda h: h.rank, default=None) for mark, rows in tried.items()]
    found = [header for header in each if header and (header.width > 1 or header.delimiter != BLANKS)]
    return max(found, key=lambda h: (h.width > 1, h.rank, h.width), default=None)


def _headers(delimiter: str, rows: list[_Row]) -> Iterator[_Header]:
    """Yield rows that have words where the next row has numbers, and no data of the same table above them."""
    for i, row in enumerate(rows):
        if row.is_data:
            return
        data = (each for each in rows[i + 1 :] if not each.comment and any(each.kinds))
        below = list(islice(data, 3))
        units = below.pop(0) if len(below) > 1 and _is_units(below[0], row, below[1]) else None
        if not below or not row.fits(below[0]):
            continue
        numbers = ("n",) if len(row.cells) == 1 else ("n", "d")
        pairs = zip(row.kinds, below[0].kinds, strict=False)
        above = any(each.is_like(below[0]) for each in rows[:i] if not each.comment)
        if not above and any(name == "w" and kind in numbers for name, kind in pairs):
            words = "n" not in row.kinds
            yield _Header((words and all(map(below[0].is_like, below[1:])), words), delimiter, row, units)


def _is_units(row: _Row, header: _Row, data: _Row) -> bool:
    """True if a row between the header and data contains units, at least one of them above numbers."""
    cells = zip(row.cells, row.kinds, strict=True)
    numbers = any(kind == "d" or (kind == "n" and cell != "1") for cell, kind in cells)
    if row.comment or numbers or not (row.fits(header) and row.fits(data)):
        return False
    return any(
        kind == "w" and below in ("n", "d") and (_is_bracketed(cell) or is_unit(cell))
        for cell, kind, below in zip(row.cells, row.kinds, data.kinds, strict=False)
    )


def _is_bracketed(cell: str) -> bool:
    return cell[:1] + cell[-1:] in ("[]", "()")


def is_unit(text: str) -> bool:
    """True if a text is a known unit."""
    try:
        return _TIMES.fullmatch(text) is not None or (len(text) < _LONG and bool(Unit.parse(text)))
    except ValueError:
        return False


def delimiter_of(header: str) -> str:
    """The delimiter of a header: comma, semicolon, tab or `|`."""
    return max(_DELIMITERS, key=_QUOTED.sub("", header).count)


def head_cells(header: str, delimiter: str) -> list[str]:
    """Split a header into its cells, without quotes, and without the apostrophe that `write_csv` puts."""
    line = header.replace("\r", " ").replace("\n", " ")
    cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return [from_spreadsheet(bare(cell)) for cell in cells]


def split_head(text: str) -> tuple[str, str]:
    """Split a header cell, `v [km/h]` or `v (km/h)`, into name and unit; any other text is just a name."""
    text = text.strip()
    match = _HEAD.fullmatch(text) if len(text) < _LONG else None
    if match is None:
        return text, ""
    name, unit = match["name"], match["unit"]
    round_ = _ROUND.fullmatch(name)
    if unit is None and round_ is not None and is_unit(round_["unit"].strip()):
        return round_["name"], round_["unit"].strip()
    if unit is not None and text.startswith(f"{name}["):  # `v_[m/s]`
        name = name.rstrip("_") or name
    return name, (unit or "").strip()


def filled(line: str, delimiter: str) -> bool:
    """True if any cell of a line is not empty."""
    return bool(line.strip(f" \t{delimiter}"))
