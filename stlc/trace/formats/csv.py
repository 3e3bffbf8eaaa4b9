"""Traces as `.csv` files.

A cell contains a number or a word, or is empty; any other content is an error. The first line names the
columns, with optional units in brackets: `t, x [m], v (km/h)`. If the file holds several traces, a column
`trace` or `agent` identifies the trace of each line. If the first cell of a column is a word, the column
contains words. In other columns an empty cell is NaN, an unknown value.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.escape import from_spreadsheet, spreadsheet
from stlc.files import write_atomic
from stlc.source import Source, Span
from stlc.trace.formats.cells import NUMBER, STRETCH, TableText, bare, load, read_lines, value_of
from stlc.trace.formats.registry import MAX_LETTERS, opened, unreadable
from stlc.trace.formats.table import GROUPS, OneTrace, Table, is_unit, of_table
from stlc.trace.recording import Recording

if TYPE_CHECKING:
    from stlc.trace.trace import Trace

Array = NDArray[Any]

MAX_BYTES = 1_000_000_000
LARGE = 4_000_000
"""Size in bytes from which on a file is parsed without decoding it to text."""

_HEAD_BYTES = 1 << 16
_END = re.compile(rb"\r\n|\r|\n")
_HEAD = re.compile(r"(?P<name>[^\[\]]*[^\[\]\s](?:\[\d+\])?)\s*(?:\[(?P<unit>[^\]]*)\])?")
_ROUND = re.compile(r"(?P<name>.*[^\s(])\s*\((?P<unit>[^()]+)\)")
_FILLED = re.compile(r"[^\n]*\S[^\n]*")
_COMMA = re.compile(r"(?<!\d),|,(?!\d)")
"""A comma that is not within a number."""
_MAX_FINDINGS = 20
_QUOTED = re.compile(r'"(?:[^"]|"")*"')


@dataclass(frozen=True, slots=True)
class _Sheet:
    """The text of a file, divided into its header and the lines that follow."""

    source: Source
    delimiter: str
    header: str
    header_at: int
    body_at: int


def read(path: Path) -> Recording:
    """Return the content of a `.csv` file. Raises the errors of `read_csv` and of `of_table`."""
    return of_table(path, read_csv(path))


def size(path: Path) -> int:
    """Size of the file in bytes, as an estimate of the memory that its numbers need."""
    return path.stat().st_size


def chunks(path: Path, samples: int) -> Iterator[Recording]:
    """Yield the trace of a file in chunks of `samples` lines.

    Raises the errors of `read`, and E605 if the file contains several traces.
    """
    only = OneTrace(str(path))
    with path.open(encoding="latin-1") as file:  # every byte a letter, and every line ending `\n`
        known, header = next(((at, line) for at, line in enumerate(file, 1) if line.strip()), (0, ""))
        blank, kinds = "\n" * (known - 1), dict[int, bool]()
        while lines := list(islice(file, samples)):
            if any(map(str.strip, lines)):
                body = "".join(lines).encode("latin-1")
                yield of_table(path, _table_of_chunk(path, header, body, blank, known, kinds), only=only)
            known += len(lines)


def _table_of_chunk(
    path: Path, header: str, body: bytes, blank: str, known: int, kinds: dict[int, bool]
) -> Table:
    """Columns of the lines `body`; `known` lines come before them, those of `blank` above the header."""
    head = header.encode("latin-1")
    try:
        return table_of_text(path, head + body, kinds)
    except TraceError:  # again, so that the finding has the number of the line in the file
        table_of_text(path, blank.encode() + head + b"\n" * (known - len(blank) - 1) + body, kinds)
        raise


def read_csv(path: Path) -> Table:
    """Return the columns of a `.csv` file as numbers, or as texts for columns of words.

    The file is in UTF-8. Commas, semicolons or tabs separate the columns. With semicolons or tabs, numbers
    may have decimal commas.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        TraceError: E603, the file is not text, or a cell is not a number; E605, the header is invalid, or a
            line has another number of cells.
    """
    return table_of_text(path, _read(path))


def table_of_text(path: Path, data: bytes, kinds: dict[int, bool] | None = None) -> Table:
    """Return the columns of a `.csv` file whose content is `data`; `path` is used in messages.

    Raises TraceError in the same cases as `read_csv`.

    Args:
        path: path of the file.
        data: its content, or the header and some lines of it.
        kinds: whether a column contains words: index -> True or False, as far as earlier lines tell. It is
            completed. None: there are no earlier lines.
    """
    kinds = {} if kinds is None else kinds
    if len(data) >= LARGE and (table := _read_large(path, data, kinds)) is not None:
        return table
    sheet = _sheet(path, data)
    names, units = _read_header(sheet)
    texts = _text_columns(sheet, len(names), kinds)
    return Table(dict(zip(names, _read_body(sheet, len(names), texts), strict=True)), units)


def _read(path: Path) -> bytes:
    with opened(path), path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise unreadable(path, f"it is larger than {MAX_BYTES / 1e9:.0f} GB", advice="save it as `.npz`")
    return data


def _read_large(path: Path, data: bytes, kinds: dict[int, bool]) -> Table | None:
    """Read the columns of a large file of numbers in one step; `kinds` as of `table_of_text`.

    None is returned if the file contains something that only the slower reader can read.
    """
    try:
        sheet = _sheet(path, data[: data.rfind(b"\n", 0, _HEAD_BYTES) + 1])
        names, units = _read_header(sheet)
    except TraceError:
        return None
    if _text_columns(sheet, len(names), kinds):
        return None
    start = 0
    for _ in range(sheet.source.text.count("\n", 0, sheet.body_at)):
        end = _END.search(data, start)
        start = len(data) if end is None else end.end()
    columns = read_lines(TableText(data, start, len(names), sheet.delimiter))
    return None if columns is None else Table(dict(zip(names, columns, strict=True)), units)


def _sheet(path: Path, data: bytes) -> _Sheet:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise unreadable(path, f"it is not UTF-8 (byte {error.start})") from None
    if "\0" in text:
        raise unreadable(path, "it is a binary file, not a table")
    body = text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text
    stripped = body.lstrip()
    if not stripped:
        raise unreadable(path, "it is empty")
    start = len(body) - len(stripped)
    end = body.find("\n", start)
    end = len(body) if end < 0 else end
    header = body[start:end]
    delimiter = delimiter_of(header)
    if delimiter != "," and "," in body[end:] and not _COMMA.search(body, end):
        body = body[:end] + body[end:].replace(",", ".")  # decimal commas, as many spreadsheets write them
    return _Sheet(Source(str(path), body), delimiter, header, start, min(end + 1, len(body)))


def _read_header(sheet: _Sheet) -> tuple[list[str], dict[str, str]]:
    findings: list[Diagnostic] = []
    units: dict[str, str] = {}
    names: list[str] = []
    for raw, span in _placed(sheet.source, sheet.header_at, _raw_heads(sheet.header, sheet.delimiter)):
        text = _head(raw)
        plain = text.removeprefix("#").strip() if not names else text  # np.savetxt begins a header with it
        name, unit = split_head(plain)
        if not _HEAD.fullmatch(plain):
            shown = f"`{text}` is not the name of a column" if text else "a column without a name"
            findings.append(Diagnostic("E605", shown, span, label="expected a signal's name"))
        elif name in units:
            findings.append(Diagnostic("E605", f"two columns are called `{name}`", span))
        elif NUMBER.fullmatch(name):
            message, advice = "the first line must name the columns", ("e.g. `t,x,v`",)
            findings.append(Diagnostic("E605", message, span, help=advice))
        names.append(name)
        units[name] = unit
    if findings:
        raise TraceError(*findings[:_MAX_FINDINGS])
    return names, units


def delimiter_of(header: str) -> str:
    """The delimiter of a header: comma, semicolon or tab."""
    return max(",;\t", key=_QUOTED.sub("", header).count)


def head_cells(header: str, delimiter: str) -> list[str]:
    """Split a header into its cells, without quotes.

    `write_csv` puts an apostrophe before a name such as `=1+1`, which a spreadsheet program would run as a
    formula. The apostrophe is removed here.
    """
    return [_head(raw) for raw in _raw_heads(header, delimiter)]


def _raw_heads(header: str, delimiter: str) -> list[str]:
    """Split a header into its unprocessed cells; a delimiter within quotes is part of a cell."""
    hidden = _QUOTED.sub(lambda match: "\0" * len(match[0]), header)
    edges = [-1, *(at for at, char in enumerate(hidden) if char == delimiter), len(header)]
    return [header[left + 1 : right] for left, right in pairwise(edges)]


def _head(raw: str) -> str:
    text = bare(raw)
    return from_spreadsheet(text.replace('""', '"') if _QUOTED.fullmatch(raw.strip()) else text)


def split_head(text: str) -> tuple[str, str]:
    """Split a header cell, `v [km/h]` or `v (km/h)`, into name and unit; any other text is just a name."""
    match = _HEAD.fullmatch(text.strip())
    if match is None:
        return text.strip(), ""
    round_ = _ROUND.fullmatch(match["name"])
    if match["unit"] is None and round_ is not None and is_unit(round_["unit"].strip()):
        return round_["name"], round_["unit"].strip()
    return match["name"], (match["unit"] or "").strip()


def _placed(source: Source, start: int, cells: Iterable[str]) -> Iterator[tuple[str, Span]]:
    """Yield the cells of a line with their source locations.

    `start` is the position in the file at which the line begins.
    """
    for raw in cells:
        at = start + (len(raw) - len(raw.lstrip()))
        yield raw, source.span(at, max(at + len(raw.strip()), at + 1))
        start += len(raw) + 1


def _text_columns(sheet: _Sheet, width: int, kinds: dict[int, bool]) -> frozenset[int]:
    """Indices of the columns whose first non-empty cell is a word; `kinds` as of `table_of_text`."""
    open_ = set(range(width)) - kinds.keys()
    for line in _FILLED.finditer(sheet.source.text, sheet.body_at):
        cells = line[0].split(sheet.delimiter)[:width]
        texts = {i: cell.strip().strip('"').strip() for i, cell in enumerate(cells) if i in open_}
        filled = {i for i, text in texts.items() if text}
        kinds |= {i: value_of(texts[i]) is None for i in filled}
        open_ -= filled
        if not open_:
            break
    return frozenset(i for i, word in kinds.items() if word)


def _read_body(sheet: _Sheet, width: int, texts: frozenset[int]) -> list[Array]:
    """Read the columns in blocks of lines; a block with unusual cells is read cell by cell.

    `width` is the number of columns, and `texts` are the indices of the columns of words.
    """
    findings: list[Diagnostic] = []
    parts: list[list[Array]] = [[] for _ in range(width)]
    text, begin = sheet.source.text, sheet.body_at
    while begin < len(text) and len(findings) < _MAX_FINDINGS:
        end = text.find("\n", begin + STRETCH) + 1 or len(text)
        columns = _read_fast(sheet, text[begin:end], width, texts)
        if columns is None:
            columns = _read_strict(sheet, begin, end, width, texts, findings)
        for part, column in zip(parts, columns, strict=True):
            part.append(column)
        begin = end
    if findings:
        raise TraceError(*findings)
    if not any(map(len, parts[0])):
        raise unreadable(sheet.source.name, "no line of numbers follows the header")
    return [np.concatenate(part) for part in parts]


def _read_fast(sheet: _Sheet, body: str, width: int, texts: frozenset[int]) -> list[Array] | None:
    """Read all lines of `body` at once with NumPy's reader; None if a cell is unusual."""
    if len(texts) == width or (texts and '"' in body):
        return None
    numbers = [i for i in range(width) if i not in texts]
    values = load(body, sheet.delimiter, numbers if texts else None)
    lines = [line for line in body.split("\n") if texts and filled(line, sheet.delimiter)]
    words = [line.split(sheet.delimiter) for line in lines]
    if values is None or values.shape[1] != len(numbers) or any(len(cells) != width for cells in words):
        return None
    columns: dict[int, Array] = {i: np.ascontiguousarray(values[:, k]) for k, i in enumerate(numbers)}
    columns |= {i: np.array([cells[i].strip()[:MAX_LETTERS] for cells in words]) for i in texts}
    return [columns[i] for i in range(width)]


def filled(line: str, delimiter: str) -> bool:
    """True if any cell of a line is not empty."""
    return bool(line.strip(f" \t{delimiter}"))


def _read_strict(
    sheet: _Sheet, start: int, end: int, width: int, texts: frozenset[int], findings: list[Diagnostic]
) -> list[Array]:
    """Read the lines of a block cell by cell, and append the location of every error to `findings`."""
    rows: list[list[float | str]] = []
    for line in sheet.source.text[start:end].removesuffix("\n").split("\n"):
        if filled(line, sheet.delimiter):
            placed = _placed(sheet.source, start, line.split(sheet.delimiter))
            cells = [(bare(raw), span) for raw, span in placed]
            rows.append(_read_row(sheet, cells, width, texts, findings))
        start += len(line) + 1
        if len(findings) >= _MAX_FINDINGS:
            break
    whole = [] if findings else rows
    return [
        np.array([row[i] for row in whole], dtype=str if i in texts else np.float64) for i in range(width)
    ]


def _read_row(
    sheet: _Sheet,
    cells: Sequence[tuple[str, Span]],
    width: int,
    texts: frozenset[int],
    findings: list[Diagnostic],
) -> list[float | str]:
    if len(cells) != width:
        span = cells[0][1].to(cells[-1][1])
        message = f"this line has {len(cells)} cells, the header names {width} columns"
        findings.append(Diagnostic("E605", message, span, help=_decimal_comma(sheet, cells, width)))
        return []
    row: list[float | str] = []
    for i, (text, span) in enumerate(cells):
        if i in texts:
            row.append(text[:MAX_LETTERS])
        elif (value := value_of(text)) is not None:
            row.append(value)
        else:
            findings.append(Diagnostic("E603", f"`{text}` is not a number", span))
    return row


def _decimal_comma(sheet: _Sheet, cells: Sequence[object], width: int) -> tuple[str, ...]:
    if sheet.delimiter == "," and len(cells) == 2 * width:
        return ("decimal commas? write a point, or separate the columns with `;`",)
    return ()


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
        raise TraceError(Diagnostic("E605", message, help=("write a `.npz`, which has no such column",)))
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
    head = _row(f"{name} [{units[name]}]" if units.get(name) else name for name in columns)
    _require_names(Path(path), head, list(columns))
    text = io.StringIO(head)
    text.seek(0, io.SEEK_END)
    writer = csv.writer(text, lineterminator="\n")
    for row in zip(*(values.tolist() for values in columns.values()), strict=True):
        writer.writerow([repr(value) for value in row])
    write_atomic(path, text.getvalue())


def _require_names(path: Path, header: str, names: Sequence[str]) -> None:
    """Check that the reader finds the names `names` in `header`. Raises TraceError (E605) if not."""
    if _names_in(path, header) == list(names):
        return
    odd = next((name for name in names if _names_in(path, _row((name,))) != [name]), names[0])
    message = f"no column of a `.csv` can be called `{odd}`"
    raise TraceError(Diagnostic("E605", message, help=("write a `.npz`, which holds any name",)))


def _names_in(path: Path, header: str) -> list[str]:
    """Names that the reader finds in a header; [] if the header is invalid."""
    try:
        return _read_header(_sheet(path, header.encode("utf-8", "replace")))[0]
    except TraceError:
        return []


def _row(heads: Iterable[str]) -> str:
    """Text of a header line with the given cells."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(map(spreadsheet, heads))
    return text.getvalue()
