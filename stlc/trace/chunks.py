"""Chunked reading of traces that are larger than memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import TraceError
from stlc.trace.clocks import SPELLINGS, ClockSetting, clocked
from stlc.trace.formats.registry import format_of, suffix_of, unreadable
from stlc.trace.formats.table import GROUPS
from stlc.trace.recording import CLOCK, ClockGroup, Recording
from stlc.trace.time_grid import TOLERANCE, resample_advice
from stlc.trace.trace import Reading, Trace, trace_of
from stlc.trace.tracks import OneTrace

LARGE = 1_500_000_000
"""Files whose numbers take more bytes than this are read in chunks."""


def size_of(path: Path) -> int:
    """Return approximately how many bytes of memory the numbers in a file need.

    The result is 0 if the file cannot be read in chunks.

    Raises:
        StlcError: the file cannot be opened, or is damaged.
    """
    found = format_of(path)
    size: int = found.function("size")(path) if found.chunked and suffix_of(path) in found.suffixes else 0
    return size


def pieces(path: Path, samples: int, reading: Reading) -> Iterator[Trace]:
    """Yield the trace of a file in chunks of `samples` samples, whose times continue from chunk to chunk.

    Raises:
        TraceError: the errors of `Trace.load`; E605, the file holds several traces, or its
            format cannot be read in chunks.
    """
    found = format_of(path)
    if not found.chunked or suffix_of(path) not in found.suffixes:
        raise TraceError.of("E605", f"`{path}` is of a format that cannot be read in pieces")
    clock: _Clock | None = None
    only = OneTrace(str(path))
    for recording in found.function("chunks")(path, samples, reading.wanted):
        for name in GROUPS if recording.groups else ():
            if name in recording.groups[0].arrays and name not in (reading.read or ()):
                for key in np.unique(recording.groups[0].arrays[name]):
                    only.require(name, key)
        if clock is None:
            trace = trace_of(recording, reading)
            clock = _Clock(trace)
        else:
            trace = clock.next(recording, reading)
        if trace.traces > 1:
            raise only.error(f"{trace.traces} traces")
        yield trace
    if clock is None:
        raise unreadable(path, "it holds no samples")


class _Clock:
    """Converter of consecutive chunks of a file to traces on one time grid."""

    def __init__(self, first: Trace) -> None:
        self.name, self.dt, self.t0, self.samples = first.name, first.dt, first.t0, first.samples
        self.origin = first.meta.origin
        self.clock = next(iter(first.clocks), None)

    def next(self, recording: Recording, reading: Reading) -> Trace:
        """Convert the next chunk to a trace whose times continue those of the previous chunks.

        Raises:
            TraceError: E602, a time is not on the time grid; also errors of `stlc.trace.trace.trace_of`.
        """
        setting = reading.setting
        if self.clock is not None and any(self.clock.name in group.arrays for group in recording.groups):
            unit = self.clock.unit if self.clock.unit in SPELLINGS else setting.unit
            setting = replace(setting, name=self.clock.name, unit=unit)
        found = clocked(recording, setting, reading.read_in_file)
        (group,) = found.groups
        if group.clock is not None:
            shift = 0 if found.meta.origin is None or self.origin is None else found.meta.origin - self.origin
            self._check(group.clock.astype(np.float64) + shift * 1e-9)
        meta = replace(recording.meta, dt=self.dt)
        arrays = {name: values for name, values in group.arrays.items() if name not in GROUPS}
        unclocked = replace(found, groups=(ClockGroup(arrays, None),), meta=meta)
        names = {signal: name for signal, name in reading.names.items() if signal != CLOCK}
        trace = trace_of(unclocked, replace(reading, names=names, clock=ClockSetting(), group="none"))
        start = self.t0 + self.samples * self.dt
        self.samples += trace.samples
        return replace(trace, t0=start)

    def _check(self, times: NDArray[np.float64]) -> None:
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
            raise TraceError.of("E602", message, help=(first, resample_advice(self.dt)))
