"""Traces as `.parquet` files (extra `parquet`): numbers, truth values, times, words and lists.

The unit of a column is in brackets after its name, `v [km/h]`, or in the field's metadata under `unit`. The
field `x` of a structure `pos` is called `pos.x`; a list is a vector if it has the same length everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from stlc.diagnostics import TraceError, usage
from stlc.extras import needed
from stlc.files import File
from stlc.signature import Column
from stlc.trace.formats.arrays import Array, Arrays
from stlc.trace.formats.csv import split_head
from stlc.trace.formats.registry import MAX_LETTERS, damage, require_room, unreadable
from stlc.trace.recording import ALL, Recording, Wanted

_DEEPEST = 8
"""Structures inside each other that are read."""


def read(path: Path, wanted: Wanted = ALL) -> Recording:
    """Read the wanted columns. Raises UsageError (U102), MissingError (R301) or TraceError (E603, E605)."""
    opened = _open(path, wanted)
    require_room(path, opened.size)
    with damage(path):
        return _recording(path, opened, opened.file.read(columns=list(opened.kinds)))


@dataclass(frozen=True, slots=True)
class _Opened:
    """An open file: what is kept, with fields of structures as `column.field`, and its bytes in memory."""

    file: Any
    kinds: Mapping[str, str]
    rows: int
    size: int
    found: Arrays


def _open(path: Path, wanted: Wanted) -> _Opened:
    parquet = needed("pyarrow.parquet")
    if not path.is_file():
        raise usage(f"cannot read `{path}`: no such file or directory", code="U102")
    found, kinds = Arrays(wanted), {}
    with damage(path):
        file = parquet.ParquetFile(path, memory_map=True)
        for field in _flat(file.schema_arrow.empty_table()).schema:
            signal, kind = split_head(field.name)[0], _kind(field.type)
            if not kind:
                found.refuse(signal, f"holds `{str(field.type)[:40]}`, not numbers or words")
            elif found.takes(signal, signal.rpartition("[")[0]):
                kinds[field.name] = kind
        words = [name for name, kind in kinds.items() if kind == "words"]
        if words:  # each distinct word once, however often it occurs
            file = parquet.ParquetFile(path, metadata=file.metadata, memory_map=True, read_dictionary=words)
        return _Opened(file, kinds, file.metadata.num_rows, _size(file, kinds), found)


def _flat(table: Any) -> Any:
    for _ in range(_DEEPEST):
        if any(needed("pyarrow").types.is_struct(kind) for kind in table.schema.types):
            table = table.flatten()
    return table


def _kind(kind: Any) -> str:
    """Kind of values in a column of an Arrow type: `numbers`, `words`, `lists` of numbers, or ""."""
    types = needed("pyarrow").types
    plain = kind.value_type if types.is_dictionary(kind) else kind
    if types.is_string(plain) or types.is_large_string(plain):
        return "words"
    lists = types.is_fixed_size_list(kind) or types.is_list(kind) or types.is_large_list(kind)
    plain = kind.value_type if lists else kind
    numbers = (types.is_integer, types.is_floating, types.is_boolean, types.is_decimal, types.is_null)
    if types.is_interval(plain) or not any(test(plain) for test in (*numbers, types.is_temporal)):
        return ""
    return "lists" if lists else "numbers"


def _size(file: Any, kinds: Mapping[str, str]) -> int:
    metadata = file.metadata
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    total = 0
    for i in range(metadata.num_columns):
        path = metadata.schema.column(i).path  # such as `q.list.element`
        parts = accumulate(path.split("."), "{}.{}".format)
        kind = next((kinds[name] for name in parts if name in kinds), None)
        if kind in (None, "numbers"):
            total += 8 * metadata.num_rows if kind else 0
            continue
        file.scan_contents(columns=[path])  # `column` ends the process on damage that this reports
        columns = [group.column(i) for group in groups]
        if kind == "lists":
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
    with File(path).replaced() as temporary:
        needed("pyarrow.parquet").write_table(arrow.table(arrays), temporary)


def size(path: Path, wanted: Wanted = ALL) -> int:
    """Size of the columns that are kept in bytes, at most."""
    return _open(path, wanted).size


def chunks(path: Path, samples: int, wanted: Wanted = ALL) -> Iterator[Recording]:
    """Yield the trace of a file in chunks of `samples` rows. Raises the errors of `read`."""
    opened = _open(path, wanted)
    require_room(path, opened.size * min(samples, opened.rows) // max(opened.rows, 1), chunk=True)
    with damage(path):
        for batch in opened.file.iter_batches(batch_size=samples, columns=list(opened.kinds)):
            yield _recording(path, opened, needed("pyarrow").Table.from_batches([batch]))


def _recording(path: Path, opened: _Opened, table: Any) -> Recording:
    """Convert an Arrow table; a missing number is NaN, a missing word empty."""
    if not table.num_rows and opened.kinds:
        raise unreadable(path, "it holds no line of numbers")
    found, table = replace(opened.found, kept={}, units={}), _flat(table)
    for field, chunked in zip(table.schema, table.columns, strict=True):
        name, unit = split_head(field.name)
        noted = (field.metadata or {}).get(b"unit", b"").decode("utf-8", "replace")
        try:
            values = _values(name, chunked)
        except (ValueError, needed("pyarrow").ArrowException) as error:
            found.refuse(name, f"cannot be converted: {str(error)[:80]}")
            continue
        for part in values:
            if part in found.kept:
                raise TraceError.of("E605", f"two columns of `{path}` are called `{part}`")
            found.kept[part], found.units[part] = values[part], unit or noted
    return found.recording(path)


def _values(name: str, chunked: Any) -> Mapping[str, Array]:
    """Return the values of a column, or of each component of a vector; raise ValueError if it has none."""
    kind = _kind(chunked.type)
    if kind == "words":
        dictionary = needed("pyarrow").types.is_dictionary(chunked.type)
        encoded = chunked if dictionary else chunked.dictionary_encode()
        array = encoded.unify_dictionaries().combine_chunks()
        texts = np.array(["", *(str(word)[:MAX_LETTERS].strip() for word in array.dictionary.to_pylist())])
        return {name: np.asarray(texts[np.asarray(array.indices.fill_null(-1), dtype=np.int64) + 1])}
    if kind != "lists":
        return {name: _numbers(chunked)}
    lists = chunked.combine_chunks()
    there = np.asarray(lists.is_valid())
    lengths = np.asarray(needed("pyarrow.compute").list_value_length(lists.drop_null()))
    size = int(lengths.max(initial=0))
    if not 1 <= size <= Column.MAX_COMPONENTS or (lengths != size).any():
        raise ValueError(f"lists of differing lengths, or of more than {Column.MAX_COMPONENTS} numbers")
    flat = _numbers(lists.flatten()).reshape(-1, size)
    if not there.all():
        flat, given = np.full((len(there), size), np.nan), flat
        flat[there] = given
    return {f"{name}[{i}]": np.ascontiguousarray(flat[:, i]) for i in range(size)}


def _numbers(values: Any) -> Array:
    arrow = needed("pyarrow")
    kind, missing = values.type, values.null_count > 0
    if arrow.types.is_timestamp(kind) or arrow.types.is_date(kind):
        ticks = values.cast(arrow.timestamp("ns")).cast(arrow.int64())
        return np.asarray(ticks.fill_null(np.iinfo(np.int64).min)).view("M8[ns]")
    if arrow.types.is_temporal(kind):
        scale = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[kind.unit]
        whole = arrow.int64() if kind.bit_width == 64 else arrow.int32()
        return np.asarray(values.cast(whole).cast(arrow.float64(), safe=False)) * scale
    if arrow.types.is_boolean(kind) and missing:
        values = values.cast(arrow.uint8())
    if missing or arrow.types.is_decimal(kind) or arrow.types.is_null(kind):
        values = values.cast(arrow.float64(), safe=False)
    return np.asarray(values)
