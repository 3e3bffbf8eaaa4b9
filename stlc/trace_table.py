"""Tables with one line a sample, from whatever file -> a recording; lines may belong to several traces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.signature import Column
from stlc.trace_meta import TraceMeta
from stlc.trace_recording import CLOCK, Recording, Strand, unit_of

Floats = NDArray[np.float64]

GROUPS = ("trace", "agent")
"""Columns of these names say to which of several traces a line belongs."""


@dataclass(frozen=True, slots=True)
class Table:
    """A file as read.

    Attributes:
        columns: name -> values, one per line of the file.
        units: unit in brackets behind a name, "" where there is none.
    """

    columns: dict[str, Floats]
    units: dict[str, str]

    @property
    def rows(self) -> int:
        """How many lines of numbers."""
        return len(next(iter(self.columns.values())))


def of_table(path: Path, table: Table, meta: TraceMeta | None = None) -> Recording:
    """A recording with one strand.

    Raises:
        TraceError: E605, traces that differ in length or in their times, or a unit that is none.
    """
    group = next((name for name in GROUPS if name in table.columns), None)
    columns = {name: values for name, values in table.columns.items() if name != group}
    arrays = columns if group is None else _grouped(path, columns, group, table.columns[group])
    clock = arrays.pop(CLOCK, None)
    if clock is not None and clock.ndim == 2:
        clock = _common(path, clock)
    units = {name: Column(name, unit_of(path, name, table.units.get(name, ""))) for name in arrays}
    return Recording(str(path), (Strand(arrays, clock),), units, meta or TraceMeta())


def _grouped(path: Path, columns: dict[str, Floats], group: str, keys: Floats) -> dict[str, Floats]:
    """Columns (lines,) -> (traces, samples)."""
    labels, sizes = np.unique(keys, return_counts=True)
    if len(set(sizes.tolist())) > 1:
        i = int(np.argmax(sizes != sizes[0]))
        message = (
            f"traces in `{path}` differ in length: {group} {labels[0]:g} has {sizes[0]} samples, "
            f"{labels[i]:g} has {sizes[i]}"
        )
        help_ = ("put traces of other lengths into files of their own",)
        raise TraceError(Diagnostic("E605", message, help=help_))
    order = np.argsort(keys, kind="stable").reshape(len(labels), -1)
    return {name: values[order] for name, values in columns.items()}


def _common(path: Path, clock: Floats) -> Floats:
    if not np.array_equal(clock, np.broadcast_to(clock[0], clock.shape), equal_nan=True):
        raise TraceError(Diagnostic("E605", f"the traces in `{path}` were not sampled at the same times"))
    return np.asarray(clock[0])
