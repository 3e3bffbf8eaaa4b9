"""Tables with one line per sample, converted to signals; a table may contain several traces."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.signature import Column
from stlc.trace.formats.registry import MAX_LETTERS
from stlc.trace.meta import TraceMeta
from stlc.trace.recording import CLOCK, ROSTOPIC, ClockGroup, Recording, clock_among, unit_of
from stlc.units import parse_unit

Array = NDArray[Any]

GROUPS = ("trace", "agent")
"""Names of columns that give the trace of each line."""

_SPELLINGS = {
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("msec", "millis", "milliseconds"), "ms"),
    **dict.fromkeys(("usec", "micros", "microseconds"), "us"),
    **dict.fromkeys(("nsec", "nanos", "nanoseconds"), "ns"),
}


@dataclass(frozen=True, slots=True)
class Table:
    """Content of a table file.

    Attributes:
        columns: name -> values, one per line of the file; numbers, or texts.
        units: name -> unit in brackets after the name; "" if there is none.
    """

    columns: dict[str, Array]
    units: dict[str, str]

    @property
    def rows(self) -> int:
        """Number of lines."""
        return len(next(iter(self.columns.values())))


@dataclass(slots=True)
class OneTrace:
    """Check of a table that is read in pieces: all of its lines belong to one trace.

    Attributes:
        name: name of the table, for messages.
    """

    name: str
    _key: object = None

    def require(self, group: str, key: object) -> None:
        """Check a line whose cell in the column `group` is `key`, a number or a word.

        Raises TraceError (E605) if an earlier line belongs to another trace.
        """
        if self._key is None:
            self._key = key
        elif str(key) != str(self._key):  # as texts: an empty cell, NaN, equals itself
            raise several_traces(self.name, f"the traces {_label(self._key)} and {_label(key)} ({group})")


def several_traces(name: str, traces: str) -> TraceError:
    """Return the error E605: a recording that is read in pieces holds several traces.

    `traces` says which or how many.
    """
    message = f"`{name}` holds {traces}; in pieces only one can be read"
    return TraceError(Diagnostic("E605", message, help=("put each trace into a file of its own",)))


def group_among(names: Iterable[str]) -> str | None:
    """Return the name of the column that gives the trace of each line; None if there is none."""
    known = set(names)
    return next((name for name in GROUPS if name in known), None)


def of_table(
    path: Path, table: Table, meta: TraceMeta | None = None, *, only: OneTrace | None = None
) -> Recording:
    """Convert a table to signals with one time column.

    If the table is one piece of a file, `only` checks that all pieces belong to one trace.

    Raises:
        TraceError: E605, traces that differ in length or in their times, or an invalid unit.
    """
    group = group_among(table.columns)
    arrays = {name: values for name, values in table.columns.items() if name != group}
    if group is not None:
        _require_whole_names(path, group, table.columns[group])
    if group is not None and only is not None:
        for key in np.unique(table.columns[group]):
            only.require(group, key)
    elif group is not None:
        arrays = _grouped(path, arrays, group, table.columns[group])
    named = clock_among(arrays)
    clock = None if named is None else arrays.pop(named)
    if clock is not None and clock.ndim == 2:
        clock = _common(path, clock)
    if clock is not None and named is not None:
        clock = _in_seconds(path, named, clock, table.units.get(named, ""))
    units = {name: Column(name, unit_of(path, name, table.units.get(name, ""))) for name in arrays}
    return Recording(str(path), (ClockGroup(arrays, clock, named or CLOCK),), units, meta or TraceMeta())


def is_unit(text: str) -> bool:
    """True if the text in parentheses after a column name is a known unit."""
    if text.lower() in _SPELLINGS:
        return True
    try:
        parse_unit(text)
    except ValueError:
        return False
    return True


def _in_seconds(path: Path, name: str, clock: Array, unit: str) -> Array:
    """Times of a column in seconds. Raises TraceError (E605) for a unit that is not a unit of time."""
    scale = clock_scale(f"`{path}`", name, unit)
    return clock if scale == 1 or clock.dtype.kind == "U" else clock * scale


def clock_scale(trace: str, name: str, unit: str) -> float:
    """Return the number of seconds in the unit of a time column.

    Raises TraceError (E605) for a unit that is not a unit of time.
    """
    text = _SPELLINGS.get(unit.lower(), unit) or ("ns" if name == ROSTOPIC else "s")
    try:
        time = parse_unit(text)
    except ValueError as error:
        raise TraceError(Diagnostic("E605", f"column `{name}` of {trace}: {error}")) from None
    if time.dims != parse_unit("s").dims:
        message = f"the clock `{name}` of {trace} is in [{unit}], which is not a time"
        raise TraceError(Diagnostic("E605", message))
    return float(time.scale)


def _require_whole_names(path: Path, group: str, keys: Array) -> None:
    """Raise TraceError (E605) if names of traces in the column `group` may have been cut to equal ones."""
    if keys.dtype.kind == "U" and (np.char.str_len(keys) >= MAX_LETTERS).any():
        message = f"the traces in `{path}` have names of {MAX_LETTERS} letters or more in `{group}`"
        raise TraceError(Diagnostic("E605", message, help=("number them",)))


def _grouped(path: Path, columns: dict[str, Array], group: str, keys: Array) -> dict[str, Array]:
    """Reshape columns (lines,) to (traces, samples).

    The column `group` identifies the trace of each line; `keys` contains its values.

    Raises:
        TraceError: E605, traces differ in length.
    """
    labels, sizes = np.unique(keys, return_counts=True)
    if len(set(sizes.tolist())) > 1:
        i = int(np.argmax(sizes != sizes[0]))
        message = (
            f"traces in `{path}` differ in length: {group} {_label(labels[0])} has {sizes[0]} samples, "
            f"{_label(labels[i])} has {sizes[i]}"
        )
        help_ = ("put traces of other lengths into files of their own",)
        raise TraceError(Diagnostic("E605", message, help=help_))
    order = np.argsort(keys, kind="stable").reshape(len(labels), -1)
    return {name: values[order] for name, values in columns.items()}


def _label(key: Any) -> str:
    return str(key) if isinstance(key, str) else f"{key:g}"


def _common(path: Path, clock: Array) -> Array:
    if not np.array_equal(clock, np.broadcast_to(clock[0], clock.shape), equal_nan=clock.dtype.kind == "f"):
        raise TraceError(Diagnostic("E605", f"the traces in `{path}` were not sampled at the same times"))
    return np.asarray(clock[0])
