"""Traces as `.parquet` files (extra `parquet`): numbers, truth values, times, words and lists.

The unit of a column is in brackets after its name, `v [km/h]`, or in the field's metadata under `unit`.
Columns of other types, such as structures, are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError, UsageError
from stlc.files import atomic_path
from stlc.trace.formats.csv import split_head
from stlc.trace.formats.registry import MAX_LETTERS, damage, needed, require_room, unreadable
from stlc.trace.formats.table import OneTrace, Table, of_table
from stlc.trace.recording import MAX_COMPONENTS, Recording

Floats = NDArray[np.float64]


def read(path: Path) -> Recording:
    """Read the columns of numbers and words of a file.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        MissingError: R301, `pyarrow` is not installed.
        TraceError: E603, the file is of another format, or damaged; E605, columns that do not fit together.
    """
    opened = _open(path)
    require_room(path, opened.size)
    with damage(path):
        table = opened.file.read(columns=opened.names)
    return of_table(path, _table(path, table, {}))


@dataclass(frozen=True, slots=True)
class _Opened:
    """An open file.

    Attributes:
        file: the file, as pyarrow opened it.
        names: names of its columns of numbers or words.
        rows: number of its rows.
        size: bytes of these columns in memory, at most.
    """

    file: Any
    names: list[str]
    rows: int
    size: int


def _open(path: Path) -> _Opened:
    parquet = needed("pyarrow.parquet")
    if not path.is_file():
        raise UsageError(Diagnostic("U102", f"cannot read `{path}`: no such file or directory"))
    types = needed("pyarrow").types
    with damage(path):
        file = parquet.ParquetFile(path, memory_map=True)
        kinds = _kinds(file.schema_arrow, types)
        words = [name for name, kind in kinds.items() if _text(kind, types)]
        if words:  # each distinct word once, however often it occurs
            file = parquet.ParquetFile(path, metadata=file.metadata, memory_map=True, read_dictionary=words)
        return _Opened(file, list(kinds), file.metadata.num_rows, _size(file, kinds, types))


def _size(file: Any, kinds: Mapping[str, Any], types: Any) -> int:
    """Bytes that the columns `kinds`, name -> type, take in memory at most, by what the file declares."""
    metadata = file.metadata
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    total = 0
    for i in range(metadata.num_columns):
        path = metadata.schema.column(i).path  # such as `q.list.element`
        parts = accumulate(path.split("."), "{}.{}".format)
        kind = next((kinds[name] for name in parts if name in kinds), None)
        if kind is None:
            continue
        if not (_list(kind, types) or _text(kind, types)):
            total += 8 * metadata.num_rows
            continue
        file.scan_contents(columns=[path])  # `column` ends the process on damage that this reports
        columns = [group.column(i) for group in groups]
        if _list(kind, types):
            total += 8 * sum(max(column.num_values, 0) for column in columns)
        else:
            total += 4 * MAX_LETTERS * metadata.num_rows
            total += sum(max(column.total_uncompressed_size, 0) for column in columns)
    return total


def write_columns(path: Path, columns: Mapping[str, tuple[str, Sequence[Any]]]) -> None:
    """Write a table that is no trace: name -> type in Arrow's words (`string`, `float64`) and values.

    Raises:
        MissingError: R301, `pyarrow` is not installed; R201, the file cannot be written.
    """
    arrow = needed("pyarrow")
    arrays = {name: arrow.array(values, type=kind) for name, (kind, values) in columns.items()}
    with atomic_path(path) as temporary:
        needed("pyarrow.parquet").write_table(arrow.table(arrays), temporary)


def size(path: Path) -> int:
    """Size of all numbers and words in bytes, at most."""
    return _open(path).size


def chunks(path: Path, samples: int) -> Iterator[Recording]:
    """Yield the trace of a file in chunks of `samples` rows.

    Raises the errors of `read`, and E605 if the file contains several traces.
    """
    only = OneTrace(str(path))
    opened = _open(path)
    require_room(path, opened.size * min(samples, opened.rows) // max(opened.rows, 1), chunk=True)
    begins: dict[str, Any] = {}
    with damage(path):
        batches = opened.file.iter_batches(batch_size=samples, columns=opened.names)
    while True:
        with damage(path):
            batch = next(batches, None)
        if batch is None:
            return
        yield of_table(path, _table(path, needed("pyarrow").Table.from_batches([batch]), begins), only=only)


def _kinds(schema: Any, types: Any) -> dict[str, Any]:
    """Types of the columns of numbers or words, by name."""
    found = {}
    for field in schema:
        kind = field.type.value_type if _list(field.type, types) else field.type
        if _numeric(kind, types) or _text(field.type, types):
            found[field.name] = field.type
    return found


def _numeric(kind: Any, types: Any) -> bool:
    numbers = (types.is_integer, types.is_floating, types.is_boolean, types.is_decimal)
    return any(test(kind) for test in (*numbers, types.is_timestamp, types.is_duration))


def _text(kind: Any, types: Any) -> bool:
    plain = kind.value_type if types.is_dictionary(kind) else kind
    return bool(types.is_string(plain) or types.is_large_string(plain))


def _list(kind: Any, types: Any) -> bool:
    return bool(types.is_fixed_size_list(kind) or types.is_list(kind) or types.is_large_list(kind))


def _table(path: Path, table: Any, begins: dict[str, Any]) -> Table:
    """Convert an Arrow table to numbers and words; a missing number is NaN, a missing word empty.

    `begins` holds the first time stamp of each column, and is completed here: later chunks count from it.

    Raises:
        TraceError: E605, duplicate column names, or lists of different lengths; E603, there are no lines.
    """
    columns: dict[str, NDArray[Any]] = {}
    units: dict[str, str] = {}
    for field, chunked in zip(table.schema, table.columns, strict=True):
        name, unit = split_head(field.name)
        noted = (field.metadata or {}).get(b"unit", b"").decode("utf-8", "replace")
        for part, values in _values(path, name, chunked, begins):
            if part in columns:
                raise TraceError(Diagnostic("E605", f"two columns of `{path}` are called `{part}`"))
            columns[part], units[part] = values, unit or noted
    if all(values.dtype.kind == "U" for values in columns.values()) or not table.num_rows:
        raise unreadable(path, "it holds no line of numbers")
    return Table(columns, units)


def _values(
    path: Path, name: str, chunked: Any, begins: dict[str, Any]
) -> Iterator[tuple[str, NDArray[Any]]]:
    types = needed("pyarrow").types
    with damage(path):
        if _text(chunked.type, types):
            yield name, _words(chunked)
            return
        if not _list(chunked.type, types):
            yield name, _floats(name, chunked, begins)
            return
        lists = chunked.combine_chunks()
        rows, numbers = len(lists), lists.flatten()
    size, rest = divmod(len(numbers), max(rows, 1))
    if rest or not 1 <= size <= MAX_COMPONENTS or lists.null_count or not _even(lists, size):
        raise TraceError(Diagnostic("E605", f"the lists in `{name}` of `{path}` differ in length"))
    with damage(path):
        flat = _floats(name, numbers, begins)
    for i in range(size):
        yield f"{name}[{i}]", np.ascontiguousarray(flat[i::size])


def _even(lists: Any, size: int) -> bool:
    lengths = needed("pyarrow.compute").list_value_length(lists)
    return bool((np.asarray(lengths) == size).all())


def _words(values: Any) -> NDArray[np.str_]:
    """Texts as an array; each distinct text is converted once."""
    encoded = values if needed("pyarrow").types.is_dictionary(values.type) else values.dictionary_encode()
    array = encoded.unify_dictionaries().combine_chunks()
    texts = np.array(["", *(str(word)[:MAX_LETTERS].strip() for word in array.dictionary.to_pylist())])
    return np.asarray(texts[np.asarray(array.indices.fill_null(-1), dtype=np.int64) + 1])


def _floats(name: str, values: Any, begins: dict[str, Any]) -> Floats:
    """Convert the values of a column to floats: durations to seconds, time stamps to seconds since the first.

    `begins` holds the first time stamp of each column, and is completed here.
    """
    arrow = needed("pyarrow")
    kind = values.type
    if arrow.types.is_timestamp(kind) or arrow.types.is_duration(kind):
        scale = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[kind.unit]
        missing, ticks = np.asarray(values.is_null()), np.asarray(values.cast(arrow.int64()).fill_null(0))
        if arrow.types.is_timestamp(kind) and not missing.all():
            ticks = ticks - begins.setdefault(name, ticks[~missing][0])
        return np.where(missing, np.nan, ticks * scale)
    if arrow.types.is_boolean(kind):
        values = values.cast(arrow.uint8())
    return np.asarray(values.cast(arrow.float64(), safe=False), dtype=np.float64)
