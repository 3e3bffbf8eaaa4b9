"""Traces: signal descriptions, a time step and arrays, read and written without pickles.

An `.npz` trace contains `t` (samples,) in seconds, one array (samples,) or (traces, samples) per signal,
arrays `extra.NAME` of any shape, and `meta`, a JSON text on the origin of the trace and its specification.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError, usage
from stlc.escape import shell
from stlc.files import File
from stlc.signature import Kind, Signature
from stlc.tabular import frame
from stlc.trace.clocks import ClockSetting, clocked
from stlc.trace.enums import Words, in_numbers, wordless
from stlc.trace.formats.registry import (
    FORMATS,
    WRITTEN,
    format_of,
    opened,
    suffix_of,
    suffixes,
    unreadable,
)
from stlc.trace.formats.table import GROUPS
from stlc.trace.meta import TraceMeta
from stlc.trace.recording import ALL, CLOCK, EXTRA, Clock, ClockGroup, Recording, Wanted, absent, fit
from stlc.trace.resample import Between, Moments, TimeRange, resampled
from stlc.trace.time_grid import read_clock, resample_advice, usual_step
from stlc.trace.tracks import separated

__all__ = [
    "Reading",
    "Trace",
    "TraceMeta",
    "as_fraction",
    "read_recording",
    "trace_of",
    "traces_of",
]

Floats = NDArray[np.float64]


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
        moments: all instants at which signals were recorded, if they were resampled.
        spans: signal -> time in which it was seen, if signals were resampled.
        clocks: clocks of the file from which the times are.
        remarks: warnings about the file.
        track: the object in a table that this is, such as `agent=2`; "" if the file holds one.
        others: names of arrays of the file that were not read.
        sources: signal -> its name in the file, for those that were renamed.
        labels: column that seems to tell objects apart -> number of its values.
    """

    signature: Signature
    dt: float
    data: Mapping[str, Floats]
    t0: float = 0.0
    extras: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    meta: TraceMeta = field(default_factory=TraceMeta)
    name: str = "trace"
    moments: Moments | None = None
    spans: Mapping[str, TimeRange] = field(default_factory=dict)
    clocks: tuple[Clock, ...] = ()
    remarks: tuple[Diagnostic, ...] = ()
    track: str = ""
    others: tuple[str, ...] = ()
    sources: Mapping[str, str] = field(default_factory=dict)
    labels: Mapping[str, int] = field(default_factory=dict)

    RESERVED: ClassVar = ("t", "meta")
    """Names that signals cannot have."""

    def __repr__(self) -> str:
        size = f"{self.traces} x {self.samples} samples of {len(self.signature)} signals"
        return f"Trace({self.name}: {size}, dt {self.dt:g} s)"

    def to_frame(self) -> Any:
        """Return a data frame of pandas or polars: times and signals, and which trace if there are several.

        Raises MissingError (R301) if neither package is installed.
        """
        several = {"trace": np.repeat(np.arange(self.traces), self.samples)} if self.traces > 1 else {}
        signals = {name: values.ravel() for name, values in self.data.items()}
        return frame({**several, "t": np.tile(self.times, self.traces), **signals})

    @staticmethod
    def load(path: Path | str, reading: Reading | None = None) -> Trace:
        """Read a trace; the suffix of the file determines the format.

        Suffixes are `.csv`, `.tsv`, `.jsonl`, `.parquet`, `.mat`, `.mcap`, `.bag`, `.db3`, `.ulg` and `.mf4`;
        a folder is a ROS 2 bag, and any other file is an `.npz`. Values may be NaN (unknown) or infinite.

        Raises:
            UsageError: U102, there is no such file.
            MissingError: R301, the format needs a package that is not installed.
            TraceError: E601, no times, or no such signal; E602, times are not uniform; E603, the file cannot
                be read safely; E605, its arrays do not fit together, or it holds objects of different times.
        """
        reading = reading or AS_IT_IS
        return trace_of(read_recording(Path(path), reading.wanted), reading)

    def save(self, path: Path | str) -> None:
        """Write the trace; the suffix of the path determines the format.

        A `.csv` file contains the signals only. An `.mcap` file does not contain the arrays `extras`.

        Raises:
            UsageError: U101, the suffix is none of `.npz`, `.csv` and `.mcap`.
            MissingError: R301, an `.mcap` file needs a package that is not installed.
            TraceError: E605, a signal has a name that the format reserves.
            MissingError: R201, no space left or no permission; an existing file is not changed.
        """
        self.check_writable(path)
        taken = [name for name in self.data if name in self.RESERVED or name.startswith(EXTRA)]
        if taken:
            raise TraceError.of("E605", f"a recorded signal cannot be called `{taken[0]}`")
        format_of(Path(path)).function("write")(path, self)

    @staticmethod
    def check_writable(path: Path | str) -> None:
        """Check that the format of a path can be written.

        Raises:
            UsageError: U101, files with this suffix cannot be written.
            MissingError: R301, an `.mcap` file needs a package that is not installed.
        """
        suffix, found = Path(path).suffix.lower(), format_of(Path(path))
        if found.writes and suffix == found.suffixes[0]:
            found.require()
        elif not Path(path).is_char_device():
            message = f"`{path}`: a trace is written as {', '.join(WRITTEN[:-1])} or {WRITTEN[-1]}"
            raise usage(message, f"e.g. {Path(path).stem or 'trace'}{WRITTEN[0]}")

    @property
    def file(self) -> str:
        """Path of the file as the user gave it."""
        return self.name.removesuffix(f" ({self.track})")

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
        kept_names = {c.name: back.get(c.name, c.name) for c in kept}

        def moved(values: Mapping[str, Any]) -> dict[str, Any]:
            return {new: values[old] for old, new in kept_names.items() if old in values}

        moments = self.moments
        if moments is not None:
            before, after, clocks = map(moved, (moments.before, moments.after, moments.clocks))
            moments = replace(moments, before=before, after=after, clocks=clocks)
        return replace(
            self,
            signature=Signature(columns),
            data=moved(self.data),
            moments=moments,
            spans=moved(self.spans),
            others=(*self.others, *(name for name in self.data if name in names and name not in back)),
            sources={new: old for new, old in names.items() if new != old},
        )


@dataclass(frozen=True, slots=True)
class Reading:
    """Options for reading a trace file.

    Attributes:
        names: signal -> its name in the file; the key `t` gives the name of the time column, and `trace` or
            `agent` that of the column that tells objects apart.
        resample: time step in seconds of a new grid; None keeps the grid of the file, which must be uniform.
        dt: time step in seconds, if the file does not give it; must not contradict the file.
        max_gap: longest gap in seconds within which values are known. If it is given, the file is resampled.
            The time step is then `resample`, or else the usual time step of the file.
        kinds: signal -> kind of its numbers, which determines how it is resampled.
        words: numbers that stand for words, such as `{"sign": {"stop": 0, "light": 1}}`. The keys are the
            names of all needed signals. Other signals of words become extras (arrays that are never
            evaluated). If None, all signals of words become extras.
        read: signal that is read -> whether it may be the time itself; all others are left out of the file.
            If None, all signals are read.
        clock: the clock, if the user names it.
        group: name of the column that tells the objects in a table apart, or one of them, such as
            `agent=2`; "" if the file decides.
        columns: names of the columns of a table without a header.
        between: signal -> its values between samples, for resampling.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    resample: float | None = None
    dt: float | None = None
    max_gap: float | None = None
    kinds: Mapping[str, Kind] = field(default_factory=dict)
    words: Mapping[str, Words] | None = None
    read: Mapping[str, bool] | None = None
    clock: ClockSetting = ClockSetting()  # noqa: RUF009 - frozen
    group: str = ""
    columns: tuple[str, ...] = ()
    between: Mapping[str, Between] = field(default_factory=dict)

    @property
    def read_in_file(self) -> dict[str, bool] | None:
        """Names in the file of the signals that are read, as `read`; None for all."""
        if self.read is None:
            return None
        return {self.names.get(name, name): timelike for name, timelike in self.read.items()}

    @property
    def setting(self) -> ClockSetting:
        """The clock that is asked for, by any option."""
        given = self.clock if self.clock.name else replace(self.clock, name=self.names.get(CLOCK, ""))
        return given if given.step is not None else replace(given, step=self.dt)

    @property
    def grouping(self) -> str:
        """The column that tells objects apart, as asked for by any option; "" if the file decides."""
        keys = (name for name in GROUPS if name in self.names and name not in (self.read or ()))
        return self.group or next((self.names[name] for name in keys), "")

    @property
    def wanted(self) -> Wanted:
        """The arrays that a reader has to give."""
        read = self.read_in_file
        names = None if read is None else frozenset(read)
        groups = tuple(each.partition("=")[0] for each in self.grouping.split(",") if each)
        return Wanted(names, self.setting.name, groups, self.columns)


AS_IT_IS = Reading()


# ----------------------------------------------------------------------- reading


def read_recording(path: Path, wanted: Wanted = ALL) -> Recording:
    """Read what is wanted of a trace file of any format.

    Raises:
        UsageError: U102, there is no such file.
        MissingError: R301, the format needs a package that is not installed.
        TraceError: E603, the file cannot be read; E605, its arrays do not fit together.
    """
    chosen = format_of(path)
    guessed = chosen is FORMATS[0] and suffix_of(path) not in chosen.suffixes
    if guessed and path.is_file() and not is_zipfile(path):
        why = f"its suffix is none of {' '.join(suffixes())}"
        raise unreadable(path, why, advice="give it the suffix of its format")
    if not path.is_dir():
        with opened(path):
            File(path).require_regular()
    found: Recording = chosen.function("read")(path, wanted)
    return found


def trace_of(recording: Recording, reading: Reading = AS_IT_IS) -> Trace:
    """Convert the content of a trace file to one trace, with renamed signals, on one uniform grid.

    Raises:
        TraceError: the errors of `Trace.load`.
    """
    traces = traces_of(recording, reading)
    if len(traces) > 1:
        message = f"`{recording.name}` holds {len(traces)} objects of different times"
        help_ = ("stlc check  judges each of them; in Python:  stlc.trace.traces_of",)
        raise TraceError.of("E605", message, help=help_)
    return traces[0]


def traces_of(recording: Recording, reading: Reading = AS_IT_IS) -> tuple[Trace, ...]:
    """Convert the content of a trace file to traces, one for each object with times of its own.

    Raises:
        TraceError: the errors of `Trace.load`.
    """
    read = reading.read_in_file
    _require_readable(recording, read)
    parts = separated(recording, reading.grouping, reading.setting, read)
    short = {i for i, p in enumerate(parts) if p.track and len(next(iter(p.groups[0].arrays.values()))) < 2}
    several = {i: _one_trace(part, reading, read) for i, part in enumerate(parts) if i not in short}
    step = next((trace.dt for trace in several.values()), None)  # which one sample does not tell
    for i in range(len(parts)):
        part = replace(parts[i], meta=replace(parts[i].meta, dt=parts[i].meta.dt or step))
        several.setdefault(i, several[i] if i in several else _one_trace(part, reading, read))
    return tuple(several[i] for i in range(len(parts)))


def _require_readable(recording: Recording, read: Mapping[str, bool] | None) -> None:
    findings = []
    for name in recording.signals if read is None else read:
        if name in recording.refused:
            findings.append(Diagnostic("E603", f"`{name}` in `{recording.name}` {recording.refused[name]}"))
        elif name in recording.clashes:
            sources = recording.clashes[name]
            message = f"`{name}` in `{recording.name}` is ambiguous: {' and '.join(map(str, sources))}"
            help_ = tuple(
                f"{shell(('--map', f'SIGNAL={one}'))}  reads {source}" for source, one in sources.items()
            )
            findings.append(Diagnostic("E605", message, help=help_))
    if findings:
        raise TraceError(*findings)


def _one_trace(recording: Recording, reading: Reading, read: Mapping[str, bool] | None) -> Trace:
    names = {signal: name for signal, name in reading.names.items() if signal not in (CLOCK, *GROUPS)}
    names |= {s: n for s, n in reading.names.items() if reading.read is not None and s in reading.read}
    recording = clocked(recording, reading.setting, read)
    if reading.words is None:
        recording = wordless(recording)
    else:
        recording = in_numbers(recording, {names.get(n, n): worth for n, worth in reading.words.items()})
    gridded = reading.resample is not None or reading.max_gap is not None
    if read and not recording.signals and (gridded or not recording.groups):
        raise TraceError(*(absent(recording.name, name, recording.others) for name in read))
    if not gridded:
        trace = _uniform(recording, reading.dt, read)
    else:
        kinds = {names.get(name, name): kind for name, kind in reading.kinds.items()}
        between = {names.get(name, name): each for name, each in reading.between.items()}
        if (step := reading.dt or recording.meta.dt) is not None:  # of signals without times
            groups = (
                group if group.clock is not None else replace(group, clock=step * np.arange(_longest(group)))
                for group in recording.groups
            )
            recording = replace(recording, groups=tuple(groups))
        on_grid = resampled(recording, reading.resample or reading.dt, reading.max_gap, between, kinds)
        trace = _trace(recording, on_grid.t0, on_grid.dt, on_grid.data)
        trace = replace(trace, moments=on_grid.moments, spans=on_grid.spans)
    present = {s: n for s, n in names.items() if n in trace.data or read is None}
    return trace.renamed(present)


def _longest(group: ClockGroup) -> int:
    """Number of samples of the longest signal; of three axes the last one numbers components."""
    shapes = (values.shape for values in group.arrays.values() if values.ndim)
    return max((shape[-1] if len(shape) < 3 else shape[-2] for shape in shapes), default=0)


def _uniform(recording: Recording, step: float | None, read: Mapping[str, bool] | None) -> Trace:
    """Return the trace of a recording whose signals share one uniform time column."""
    name = recording.name
    groups = [group for group in recording.groups if group.arrays]
    groups = groups or [*recording.groups, ClockGroup({}, None)][:1]
    if len(groups) > 1:
        message = f"the signals of `{name}` follow {len(groups)} clocks"
        usual = [usual_step(s.clock.astype(np.float64).reshape(-1)) for s in groups if s.clock is not None]
        help_ = (resample_advice(min((each for each in usual if each > 0), default=0.0)),)
        raise TraceError.of("E602", message, help=help_)
    (group,) = groups
    known_step = recording.meta.dt if step is None else step
    others = (*group.arrays, *recording.others)
    t0, dt, samples = read_clock(name, group.clock, known_step, _longest(group), others=others)
    if step is not None and abs(dt - step) > 1e-3 * step:
        message = f"`{name}` has a sample every {dt:.6g} s, not every {step:.6g} s"
        help_ = ("leave out --dt: the file says what its step is",)
        raise TraceError.of("E602", message, help=help_)
    if not group.arrays and read:  # the monitor tells what is missing
        return _trace(recording, t0, dt, {})
    data = fit(name, group.arrays, samples)
    whole = {n: np.ascontiguousarray(values, dtype=np.float64) for n, values in data.items()}
    return _trace(recording, t0, dt, whole)


def _trace(recording: Recording, t0: float, dt: float, data: dict[str, Floats]) -> Trace:
    columns = [recording.column(name) for name in data]
    return Trace(
        *(Signature(tuple(columns)), dt, data, t0, recording.extras, recording.meta, recording.name),
        clocks=recording.clocks,
        remarks=recording.remarks,
        track=recording.track,
        others=recording.others,
        labels=recording.labels,
    )


def as_fraction(dt: float | Fraction) -> Fraction:
    """Return the exact fraction that a time step in seconds stands for: 0.1 is 1/10, 0.0333… is 1/30."""
    near = Fraction(dt).limit_denominator(1_000_000)
    return near if near > 0 and abs(float(near) - float(dt)) <= 1e-9 * float(dt) else Fraction(dt)
