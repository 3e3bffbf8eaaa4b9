"""Traces that are larger than memory: the same files, a stretch of samples at a time, with one clock."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.trace.enums import instants_of
from stlc.trace.formats.csv import table_of_text
from stlc.trace.formats.extras import needed
from stlc.trace.formats.npz import Member, open_members, unreadable
from stlc.trace.formats.parquet import damage, open_parquet, signal_fields, table_of
from stlc.trace.formats.table import of_table
from stlc.trace.meta import TraceMeta, read_meta
from stlc.trace.recording import CLOCK, EXTRA, Recording, Strand, of_arrays
from stlc.trace.time_grid import TOLERANCE, resample_advice
from stlc.trace.trace import Reading, Trace, trace_of

Array = NDArray[Any]

SUFFIXES = (".npz", ".csv", ".parquet", ".pq")
LARGE = 1_500_000_000
"""Files whose numbers take more bytes than this are not read as a whole."""


def size_of(path: Path) -> int:
    """Bytes that the numbers of a file take in memory, roughly; 0 where the format cannot be read in pieces.

    Raises:
        StlcError: the file cannot be opened, or is damaged.
    """
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return path.stat().st_size
    if suffix in (".parquet", ".pq"):
        metadata = open_parquet(path, whole=False).metadata
        return int(metadata.num_rows * metadata.num_columns * 8)
    if suffix != ".npz" or not zipfile.is_zipfile(path):
        return 0
    try:
        with zipfile.ZipFile(path) as archive:
            return sum(member.file_size for member in archive.infolist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return 0


def pieces(path: Path, samples: int, reading: Reading) -> Iterator[Trace]:
    """The trace of a file, so many samples at a time; times go on from piece to piece.

    Raises:
        TraceError: as `stlc.trace.trace.load_trace`; E605, the file holds several traces, or its format
            cannot be read in pieces.
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
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return _from_csv(path, samples)
    if suffix in (".parquet", ".pq"):
        return _from_parquet(path, samples)
    if suffix in SUFFIXES:
        return _from_npz(path, samples)
    raise TraceError(Diagnostic("E605", f"`{path}` is of a format that cannot be read in pieces"))


def _single(trace: Trace) -> Trace:
    if trace.traces > 1:
        message = f"`{trace.name}` holds {trace.traces} traces; in pieces only one can be read"
        raise TraceError(Diagnostic("E605", message, help=("put each trace into a file of its own",)))
    return trace


def _begin(recording: Recording, reading: Reading) -> np.datetime64 | None:
    """The first date of a clock that is written in dates."""
    clock = reading.names.get(CLOCK)
    (strand,) = (recording if clock is None else recording.clocked_by(clock)).strands
    if strand.clock is None or strand.clock.dtype.kind != "U":
        return None
    first: np.datetime64 = instants_of(recording.name, strand).flat[0]
    return first


class _Clock:
    """Time that goes on from one piece to the next."""

    def __init__(self, first: Trace, begin: np.datetime64 | None) -> None:
        self.name, self.dt, self.t0, self.samples = first.name, first.dt, first.t0, first.samples
        self.begin = begin

    def next(self, recording: Recording, reading: Reading) -> Trace:
        """The piece on the grid of those before it."""
        names = dict(reading.names)
        renamed = names.pop(CLOCK, None)
        recording = recording if renamed is None else recording.clocked_by(renamed)
        (strand,) = recording.strands
        if strand.clock is not None:
            self._check(self._seconds(strand))
        meta = replace(recording.meta, dt=self.dt)
        unclocked = replace(recording, strands=(Strand(strand.arrays, None),), meta=meta)
        trace = trace_of(unclocked, replace(reading, names=names))
        start = self.t0 + self.samples * self.dt
        self.samples += trace.samples
        return replace(trace, t0=start)

    def _seconds(self, strand: Strand) -> NDArray[np.float64]:
        """The times of a piece, of dates since the first of the file."""
        assert strand.clock is not None
        if strand.clock.dtype.kind not in "Uc":
            return strand.clock.astype(np.float64)
        instants = instants_of(self.name, strand)
        begin = instants.flat[0] if self.begin is None else self.begin
        return np.asarray((instants - begin) / np.timedelta64(1, "ns") * 1e-9, dtype=np.float64)

    def _check(self, times: NDArray[np.float64]) -> None:
        """Every sample is where the grid says; small errors of rounding may add up slowly."""
        wanted = self.t0 + self.dt * (self.samples + np.arange(len(times)))
        off = np.abs(times - wanted)
        bad = ~(off <= TOLERANCE * self.dt + 1e-9 * np.abs(wanted))
        if bad.any():
            i = int(np.argmax(bad))
            message = (
                f"time in `{self.name}` is not uniform: t[{self.samples + i}] = {times[i]:.6g} s, "
                f"where {wanted[i]:.6g} s was expected"
            )
            raise TraceError(Diagnostic("E602", message, help=(resample_advice(self.dt),)))


# -------------------------------------------------------------------------- formats


def _from_npz(path: Path, samples: int) -> Iterator[Recording]:
    with ExitStack() as stack, damage(path):
        members = open_members(path, stack)
        meta, columns = read_meta(path, _meta_array(members))
        signals = {name: m for name, m in members.items() if name != "meta" and not name.startswith(EXTRA)}
        length = max((member.length for member in signals.values()), default=0)
        odd = [name for name, member in signals.items() if member.length != length]
        if odd:
            message = (
                f"`{odd[0]}` in `{path}` is not one value per sample: such a file cannot be read in pieces"
            )
            raise TraceError(Diagnostic("E605", message))
        for begin in range(0, length, samples):
            count = min(samples, length - begin)
            arrays = {name: member.read(count) for name, member in signals.items()}
            yield replace(of_arrays(path, arrays, meta), columns=columns)


def _meta_array(members: dict[str, Member]) -> Array | None:
    return None if "meta" not in members else members["meta"].whole()


def _from_csv(path: Path, samples: int) -> Iterator[Recording]:
    with path.open("rb") as file:
        header = _header(file)
        while lines := list(islice(file, samples)):
            if any(map(bytes.strip, lines)):
                yield of_table(path, table_of_text(path, header + b"".join(lines)))


def _header(file: IO[bytes]) -> bytes:
    """The first line that is not empty."""
    for line in file:
        if line.strip():
            return line
    return b""


def _from_parquet(path: Path, samples: int) -> Iterator[Recording]:
    file = open_parquet(path, whole=False)
    names = [name for name, _ in signal_fields(file.schema_arrow)]
    with damage(path):
        batches = file.iter_batches(batch_size=samples, columns=names)
    while True:
        with damage(path):
            batch = next(batches, None)
        if batch is None:
            return
        table = needed("pyarrow").Table.from_batches([batch])
        yield of_table(path, table_of(path, table), TraceMeta())
