"""Traces as JSON lines (`.jsonl`, `.ndjson`): one object per sample.

Nested objects have dotted names, `pose.x`, and elements of lists have numbers, `q[0]`; a list that is read as
a whole is a vector. A key that a line lacks, or that is `null`, is a missing value there.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from stlc.diagnostics import Diagnostic, TraceError
from stlc.escape import encodable
from stlc.signature import Column
from stlc.trace.formats.cells import Array, bare, is_missing, value_of
from stlc.trace.formats.registry import MAX_LETTERS, require_room, unreadable
from stlc.trace.formats.table import MAX_LINE, place, size, text_lines, unpacked, utf8
from stlc.trace.recording import ALL, ClockGroup, Recording, Wanted

__all__ = ["chunks", "read", "size"]

_MAX_FINDINGS = 20
_DECODER = json.JSONDecoder(object_pairs_hook=tuple, parse_int=float)


def read(path: Path, wanted: Wanted = ALL) -> Recording:
    """Return the wanted values of a file.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        TraceError: E603, a line is not a JSON object, or a value is not a number.
    """
    found = _recording(path, unpacked(path), 0, {}, wanted)
    if found is None:
        raise unreadable(path, "it holds no samples")
    return found


def chunks(path: Path, samples: int, wanted: Wanted = ALL) -> Iterator[Recording]:
    """Yield the wanted values of a file in chunks of `samples` lines. Raises the errors of `read`."""
    known, kinds, lines = 0, dict[str, bool](), text_lines(path)
    while body := list(islice(lines, samples)):
        found = _recording(path, b"".join(body), known, kinds, wanted)
        if found is not None:
            yield found
        known += len(body)


def _recording(
    path: Path, data: bytes, above: int, kinds: dict[str, bool], wanted: Wanted
) -> Recording | None:
    """Return the values in the lines `data`, with `above` lines before them; None if they are empty."""
    columns: dict[str, dict[int, Any]] = {}
    others, refused, rows = dict[str, None](), dict[str, str](), list[int]()
    remarks: tuple[Diagnostic, ...] = ()
    lines = utf8(path, data).decode("utf-8-sig").split("\n")
    for number, line in enumerate(lines):
        if not line.strip():
            continue
        named = None
        with suppress(ValueError, RecursionError):
            found = _DECODER.decode(line) if len(line) <= MAX_LINE else None
            named = list(_flat(found, "", wanted)) if isinstance(found, tuple) else None
        if named is None:
            if number == len(lines) - 1 and above + number:
                remarks = (Diagnostic("W305", f"the last line of `{path}` is cut short, and is left out"),)
                break
            raise TraceError(_finding(path, line, above + number, "this line is not a JSON object"))
        for name, value in named:
            if not wanted.keeps(name) or (isinstance(value, list) and name not in (wanted.names or ())):
                others[name] = None
            elif columns.setdefault(name, {}).setdefault(len(rows), value) is not value:
                refused[name] = "occurs twice in one line"
        rows.append(number)
    if not rows:
        return None
    require_room(path, 8 * len(columns) * len(rows))
    arrays: dict[str, Array] = {}
    findings: list[Diagnostic] = []
    for name, column in columns.items():
        values = [column.get(k) for k in range(len(rows))]
        array, bad = _array(values, name, kinds, needed=wanted.reads(name))
        if bad is not None:
            what = f"`{name}` is not a number: `{str(values[bad])[:80]}`"
            findings.append(_finding(path, lines[rows[bad]], above + rows[bad], what))
        elif array is None:
            why = "is a list of changing length, or not of numbers"
            refused[name] = f"{why}: its elements are `{name}[0]`, …"
        elif name not in refused:
            arrays[name] = array
    if findings:
        raise TraceError(*findings[:_MAX_FINDINGS])
    group = ClockGroup(arrays, None)
    return Recording(str(path), (group,), others=tuple(others), refused=refused, remarks=remarks)


def _finding(path: Path, line: str, above: int, message: str) -> Diagnostic:
    return Diagnostic("E603", message, place(path, above, line, 0, max(len(line.rstrip()), 1)))


def _flat(value: Any, name: str, wanted: Wanted) -> Iterator[tuple[str, Any]]:
    """Yield the names and values in a value of JSON, in which objects are tuples of pairs."""
    if isinstance(value, tuple):
        for key, each in value:
            yield from _flat(each, f"{name}.{encodable(key)}" if name else encodable(key), wanted)
    elif isinstance(value, list) and len(value) <= Column.MAX_COMPONENTS and name not in (wanted.names or ()):
        for i, each in enumerate(value):
            yield from _flat(each, f"{name}[{i}]", wanted)
    else:
        yield name, value


def _array(
    values: list[Any], name: str, kinds: dict[str, bool], *, needed: bool
) -> tuple[Array | None, int | None]:
    """Return an array of values, and the first one that is not a number, if numbers are needed."""
    sizes = {len(value) for value in values if isinstance(value, list)}
    if sizes:
        vectors = [[None] * max(sizes) if value is None else value for value in values]
        rows = [list(map(_number, value)) if isinstance(value, list) else [None] for value in vectors]
        whole = len(sizes) == 1 and not any(None in row for row in rows)
        return np.array(rows, dtype=np.float64) if whole else None, None
    if name not in kinds:
        there = (v for v in values if not (v is None or (isinstance(v, str) and is_missing(bare(v)))))
        if (first := next(there, None)) is not None:
            kinds[name] = _number(first) is None
    numbers = [_number(value) for value in values]
    bad = numbers.index(None) if None in numbers else None
    words = kinds.get(name, any(isinstance(value, str) for value in values))
    if not words and (bad is None or needed):
        return np.array(numbers, dtype=np.float64) if bad is None else None, bad
    return np.array([_text(value)[:MAX_LETTERS] for value in values], dtype=str), None


def _number(value: Any) -> float | None:
    if isinstance(value, str):
        return value_of(bare(value))
    return math.nan if value is None else float(value) if isinstance(value, bool | float) else None


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.17g}"
    return "" if value is None else encodable(value) if isinstance(value, str) else str(value).lower()
