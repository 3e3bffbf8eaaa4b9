"""Chunked reading of traces that are larger than memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.trace.enums import instants_of
from stlc.trace.formats.registry import SUFFIXES, format_of, unreadable
from stlc.trace.formats.table import several_traces
from stlc.trace.recording import CLOCK, ClockGroup, Recording
from stlc.trace.time_grid import TOLERANCE, resample_advice
from stlc.trace.trace import Reading, Trace, trace_of

LARGE = 1_500_000_000
"""Files whose numbers take more bytes than this are read in chunks."""


def size_of(path: Path) -> int:
    """Return approximately how many bytes of memory the numbers in a file need.

    The result is 0 if the file cannot be read in chunks.

    Raises:
        StlcError: the file cannot be opened, or is damaged.
    """
    found = format_of(path)
    size: int = found.function("size")(path) if found.chunked and path.suffix.lower() in SUFFIXES else 0
    return size


def pieces(path: Path, samples: int, reading: Reading) -> Iterator[Trace]:
    """Yield the trace of a file in chunks of `samples` samples, whose times continue from chunk to chunk.

    Raises:
        TraceError: the errors of `stlc.trace.trace.load_trace`; E605, the file holds several traces, or its
            format cannot be read in chunks.
    """
    clock: _Clock | None = None
    for recording in _recordings(path, samples):
        if clock is None:
            first = _single(trace_of(recording, reading))
            clock = _Clock(first, _begin(recording, reading))
            yield first
        else:
            yield _single(clock.next(recording, reading))
    if clock is None:
        raise unreadable(path, "it holds no samples")


def _recordings(path: Path, samples: int) -> Iterator[Recording]:
    found = format_of(path)
    if not found.chunked or path.suffix.lower() not in SUFFIXES:
        raise TraceError(Diagnostic("E605", f"`{path}` is of a format that cannot be read in pieces"))
    return cast("Iterator[Recording]", found.function("chunks")(path, samples))


def _single(trace: Trace) -> Trace:
    if trace.traces > 1:
        raise several_traces(trace.name, f"{trace.traces} traces")
    return trace


def _begin(recording: Recording, reading: Reading) -> np.datetime64 | None:
    """Return the first date in the time column.

    None is returned if the time column contains numbers, or if there is no time column.
    """
    clock = reading.names.get(CLOCK)
    (group,) = (recording if clock is None else recording.clocked_by(clock)).groups
    if group.clock is None or group.clock.dtype.kind != "U":
        return None
    first: np.datetime64 = instants_of(recording.name, group).flat[0]
    return first


class _Clock:
    """Converter of consecutive chunks of a file to traces on one time grid.

    The first chunk determines the grid.
    """

    def __init__(self, first: Trace, begin: np.datetime64 | None) -> None:
        self.name, self.dt, self.t0, self.samples = first.name, first.dt, first.t0, first.samples
        self.begin = begin

    def next(self, recording: Recording, reading: Reading) -> Trace:
        """Convert the next chunk to a trace whose times continue those of the previous chunks.

        Raises:
            TraceError: E602, a time is not on the time grid; also errors of `stlc.trace.trace.trace_of`.
        """
        names = dict(reading.names)
        renamed = names.pop(CLOCK, None)
        recording = recording if renamed is None else recording.clocked_by(renamed)
        (group,) = recording.groups
        if group.clock is not None:
            self._check(self._seconds(group))
        meta = replace(recording.meta, dt=self.dt)
        unclocked = replace(recording, groups=(ClockGroup(group.arrays, None),), meta=meta)
        trace = trace_of(unclocked, replace(reading, names=names))
        start = self.t0 + self.samples * self.dt
        self.samples += trace.samples
        return replace(trace, t0=start)

    def _seconds(self, group: ClockGroup) -> NDArray[np.float64]:
        """Times of a chunk in seconds; dates are converted to seconds since the first date of the file."""
        assert group.clock is not None
        if group.clock.dtype.kind not in "Uc":
            return group.clock.astype(np.float64)
        instants = instants_of(self.name, group)
        begin = instants.flat[0] if self.begin is None else self.begin
        return np.asarray((instants - begin) / np.timedelta64(1, "ns") * 1e-9, dtype=np.float64)

    def _check(self, times: NDArray[np.float64]) -> None:
        """Check that every time is on the time grid, up to rounding. Raises TraceError (E602)."""
        wanted = self.t0 + self.dt * (self.samples + np.arange(len(times)))
        off = np.abs(times - wanted)
        bad = ~(off <= TOLERANCE * self.dt + 1e-9 * np.abs(wanted))
        if bad.any():
            i = int(np.argmax(bad))
            message = (
                f"time in `{self.name}` is not uniform: t[{self.samples + i}] = {times[i]:.6g} s, "
                f"where {wanted[i]:.6g} s was expected"
            )
            first = "a larger --chunk  if the times are rounded: the first chunk determines their step"
            raise TraceError(Diagnostic("E602", message, help=(first, resample_advice(self.dt))))
