"""Traces: signal descriptions, a time step and arrays, read and written without pickles.

An `.npz` trace contains `t` (samples,) in seconds, one array (samples,) or (traces, samples) per signal,
arrays `extra.NAME` of any shape, and `meta`, a JSON text on the origin of the trace and its specification.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError, UsageError
from stlc.signature import Column, Kind, Signature
from stlc.trace.enums import Words, in_numbers, wordless
from stlc.trace.formats.registry import SUFFIXES, WRITTEN, format_of, needed, unreadable
from stlc.trace.meta import TraceMeta
from stlc.trace.recording import CLOCK, EXTRA, ClockGroup, Recording, absent, fit
from stlc.trace.resample import ResampleGrid, resampled, usual_step
from stlc.trace.time_grid import read_clock, require_same_step, resample_advice

__all__ = [
    "Reading",
    "Trace",
    "TraceMeta",
    "as_fraction",
    "load_trace",
    "read_recording",
    "save_trace",
    "trace_of",
]

Floats = NDArray[np.float64]

RESERVED = ("t", "meta")


@dataclass(frozen=True, slots=True)
class Trace:
    """Signals of one or several agents on one uniform time grid.

    Attributes:
        signature: name, unit and kind of every signal, in the order of the file.
        dt: time step in seconds.
        data: signal -> (traces, samples), float64, in the units of the signature.
        t0: time of the first sample in seconds.
        extras: all other arrays in the file, of any shape; never evaluated.
        meta: origin of the trace.
        name: the path as the user gave it, for messages.
    """

    signature: Signature
    dt: float
    data: Mapping[str, Floats]
    t0: float = 0.0
    extras: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    meta: TraceMeta = field(default_factory=TraceMeta)
    name: str = "trace"

    @property
    def traces(self) -> int:
        """Number of agents or repetitions."""
        return next((len(values) for values in self.data.values()), 0)

    @property
    def samples(self) -> int:
        """Number of samples per trace."""
        return next((values.shape[1] for values in self.data.values()), 0)

    @property
    def times(self) -> Floats:
        """Time of every sample in seconds, shape (samples,)."""
        return self.t0 + self.dt * np.arange(self.samples, dtype=np.float64)

    def renamed(self, names: Mapping[str, str]) -> Trace:
        """Return a copy with renamed signals: `names` maps each new name to the current name.

        Raises:
            TraceError: E601, a signal is not in the trace.
        """
        if not names:
            return self
        findings = [absent(self.name, old, self.data) for old in names.values() if old not in self.data]
        if findings:
            raise TraceError(*findings)
        back = {old: new for new, old in names.items()}
        kept = [c for c in self.signature.columns if c.name in back or c.name not in names]
        columns = tuple(replace(c, name=back.get(c.name, c.name)) for c in kept)
        data = {back.get(c.name, c.name): self.data[c.name] for c in kept}
        return replace(self, signature=Signature(columns), data=data)


@dataclass(frozen=True, slots=True)
class Reading:
    """Options for reading a trace file.

    Attributes:
        names: signal -> its name in the file; the key `t` gives the name of the time column.
        resample: time step in seconds of a new grid; None keeps the grid of the file, which must be uniform.
        dt: time step in seconds, if the file does not give it; must not contradict the file.
        max_gap: longest gap in seconds within which values are known. If it is given, the file is resampled.
            The time step is then `resample`, or else the usual time step of the file.
        kinds: signal -> kind of its numbers, which determines how it is resampled.
        words: numbers that stand for words, such as `{"sign": {"stop": 0, "light": 1}}`. The keys are the
            names of all needed signals. Other signals of words become extras (arrays that are never
            evaluated). If None, all signals of words become extras.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    resample: float | None = None
    dt: float | None = None
    max_gap: float | None = None
    kinds: Mapping[str, Kind] = field(default_factory=dict)
    words: Mapping[str, Words] | None = None


AS_IT_IS = Reading()


# ----------------------------------------------------------------------- reading


def read_recording(path: Path) -> Recording:
    """Read a trace file of any format.

    Raises:
        UsageError: U102, there is no such file.
        MissingError: R301, the format needs a package that is not installed.
        TraceError: E603, the file cannot be read; E605, its arrays do not fit together.
    """
    if path.suffix.lower() not in SUFFIXES and path.is_file() and not is_zipfile(path):
        why = f"its suffix is none of {' '.join(SUFFIXES)}"
        raise unreadable(path, why, advice="give it the suffix of its format")
    found: Recording = format_of(path).function("read")(path)
    return found


def load_trace(path: Path | str, reading: Reading = AS_IT_IS) -> Trace:
    """Read a trace; the suffix of the file determines the format.

    Suffixes are `.csv`, `.tsv`, `.parquet`, `.mat`, `.mcap`, `.bag` and `.db3`; a folder is a ROS 2 bag, and
    any other file is read as `.npz`. Values may be NaN or infinite. The monitor, however, refuses infinite
    values that a requirement needs.

    Raises:
        UsageError: U102, there is no such file.
        MissingError: R301, the format needs a package that is not installed.
        TraceError: E601, no times, or no such signal; E602, times are not uniform; E603, the file cannot be
            read safely; E605, its arrays do not fit together.
    """
    return trace_of(read_recording(Path(path)), reading)


def trace_of(recording: Recording, reading: Reading = AS_IT_IS) -> Trace:
    """Convert the content of a trace file to a trace, with renamed signals, on one uniform grid.

    Raises:
        TraceError: the errors of `load_trace`.
    """
    names = dict(reading.names)
    clock = names.pop(CLOCK, None)
    if clock is not None:
        recording = recording.clocked_by(clock)
    if reading.words is None:
        recording = wordless(recording)
    else:
        recording = in_numbers(recording, {names.get(n, n): worth for n, worth in reading.words.items()})
    if reading.resample is None and reading.max_gap is None:
        trace = _uniform(recording, reading.dt)
    else:
        kinds = {names.get(name, name): kind for name, kind in reading.kinds.items()}
        grid = ResampleGrid(reading.resample or reading.dt, reading.max_gap)
        on_grid = resampled(_clocked(recording, reading.dt), grid, kinds)
        trace = _trace(recording, on_grid.t0, on_grid.dt, on_grid.data)
    return trace.renamed(names)


def _clocked(recording: Recording, dt: float | None) -> Recording:
    """Return the recording with times added to the signals that have none.

    The time step is `dt` or, if that is None, the one in the metadata. Without either, nothing is added.
    """
    step = dt or recording.meta.dt
    if step is None:
        return recording
    groups = tuple(
        group if group.clock is not None else replace(group, clock=step * np.arange(_longest(group)))
        for group in recording.groups
    )
    return replace(recording, groups=groups)


def _longest(group: ClockGroup) -> int:
    """Number of samples of the longest signal; of three axes the last one numbers components."""
    shapes = (values.shape for values in group.arrays.values() if values.ndim)
    return max((shape[-1] if len(shape) < 3 else shape[-2] for shape in shapes), default=0)


def _uniform(recording: Recording, step: float | None) -> Trace:
    """Return the trace of a recording whose signals share one uniform time column.

    `step` is the time step in seconds that the user gives, or None. A given step must agree with the times.
    """
    name = recording.name
    groups = [group for group in recording.groups if group.arrays] or list(recording.groups)
    if len(groups) > 1:
        message = f"the signals of `{name}` follow {len(groups)} clocks"
        usual = [usual_step(s.clock.astype(np.float64).reshape(-1)) for s in groups if s.clock is not None]
        help_ = (resample_advice(min((each for each in usual if each > 0), default=0.0)),)
        raise TraceError(Diagnostic("E602", message, help=help_))
    (group,) = groups
    known_step = recording.meta.dt if step is None else step
    t0, dt, samples = read_clock(name, group.clock, known_step, _longest(group), others=group.arrays)
    if step is not None:
        require_same_step(name, dt, step)
    data = fit(name, group.arrays, samples)
    whole = {n: np.ascontiguousarray(values, dtype=np.float64) for n, values in data.items()}
    return _trace(recording, t0, dt, whole)


def _trace(recording: Recording, t0: float, dt: float, data: dict[str, Floats]) -> Trace:
    signature = Signature(tuple(recording.columns.get(name, Column(name)) for name in data))
    return Trace(signature, dt, data, t0, recording.extras, recording.meta, recording.name)


# ----------------------------------------------------------------------- writing


def save_trace(path: Path | str, trace: Trace) -> None:
    """Write a trace; the suffix of the path determines the format.

    A `.csv` file contains the signals only. An `.mcap` file does not contain the arrays `trace.extras`.

    Raises:
        UsageError: U101, the suffix is none of `.npz`, `.csv` and `.mcap`.
        MissingError: R301, an `.mcap` file needs a package that is not installed.
        TraceError: E605, a signal has a name that the format reserves.
        MissingError: R201, no space left or no permission; an existing file is not changed.
    """
    check_writable(path)
    taken = [name for name in trace.data if name in RESERVED or name.startswith(EXTRA)]
    if taken:
        raise TraceError(Diagnostic("E605", f"a recorded signal cannot be called `{taken[0]}`"))
    format_of(Path(path)).function("write")(path, trace)


def check_writable(path: Path | str) -> None:
    """Check that the format of a path can be written.

    Raises:
        UsageError: U101, files with this suffix cannot be written.
        MissingError: R301, an `.mcap` file needs a package that is not installed.
    """
    suffix, found = Path(path).suffix.lower(), format_of(Path(path))
    if suffix in WRITTEN and found.packages:
        needed(found.packages[0])
    if suffix not in WRITTEN and not Path(path).is_char_device():
        message = f"`{path}`: a trace is written as {', '.join(WRITTEN[:-1])} or {WRITTEN[-1]}"
        raise UsageError(
            Diagnostic("U101", message, help=(f"e.g. {Path(path).stem or 'trace'}{WRITTEN[0]}",))
        )


def as_fraction(dt: float | Fraction) -> Fraction:
    """Return the exact fraction that a time step in seconds stands for: 0.1 is 1/10, 0.0333… is 1/30."""
    near = Fraction(dt).limit_denominator(1_000_000)
    return near if near > 0 and abs(float(near) - float(dt)) <= 1e-9 * float(dt) else Fraction(dt)
