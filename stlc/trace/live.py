"""Reading of samples that arrive line by line, as a table with a header or as JSON.

The samples are on one time grid. Names, units, words and times in a line are interpreted as in a file
(`stlc.trace.formats.csv`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.jsontext import loads
from stlc.trace.enums import instant_of_word, number_of_word
from stlc.trace.formats.cells import bare, value_of
from stlc.trace.formats.csv import delimiter_of, filled, head_cells, split_head
from stlc.trace.formats.table import OneTrace, clock_scale, group_among
from stlc.trace.recording import CLOCK, absent, clock_among
from stlc.trace.resample import FIRST, MAX_SAMPLES, Spacing, usual_step, values_on
from stlc.trace.time_grid import (
    NO_CLOCK,
    NO_STEP,
    TOLERANCE,
    gap_advice,
    require_span,
    require_step,
    resample_advice,
    snapped,
)
from stlc.trace.trace import Reading

Floats = NDArray[np.float64]
Sample = Mapping[str, float]
"""Signal -> number; NaN where it is unknown. The components of a vector are `q[0]`, `q[1]`, …"""

MAX_LINE = 1_000_000

_BEYOND_FLOATS = 2**1000
_AT_ONCE = 4096
_SLACK = 1e-9


@dataclass(frozen=True, slots=True)
class TimedSample:
    """A sample with its time in seconds; the time is None if the stream contains no times."""

    time: float | None
    sample: Sample


@dataclass(slots=True)
class SampleStream:
    """Parser of a stream of lines, one sample per line.

    Attributes:
        name: name of the stream, for messages.
        reading: options. They give the names of the signals and of the time in the stream, and the numbers
            that stand for words.
        units: signal -> unit in the header, "" if there is none; known from the first sample on.
    """

    name: str
    reading: Reading
    units: dict[str, str] = field(default_factory=dict)
    _delimiter: str = ","
    _heads: tuple[str, ...] = ()
    _clock: str | None = None
    _scale: float = 1.0
    _begin: np.datetime64 | None = None
    _signals: dict[str, str] = field(default_factory=dict)
    _only: OneTrace = field(init=False)

    def __post_init__(self) -> None:
        self._only = OneTrace(self.name)

    def moments(self, lines: Iterable[bytes]) -> Iterator[TimedSample]:
        """Yield one sample per line; empty lines, and lines of empty cells, are skipped.

        Raises:
            TraceError: E601, a requested signal or time column is missing; E603, a line is not a sample, or a
                word is not a value of its signal; E605, an invalid header, a wrong number of cells, or
                several traces.
        """
        is_json: bool | None = None
        for number, raw in enumerate(lines, 1):
            text = self._text(raw, number)
            if not text:
                continue
            if is_json is None:
                is_json = text.startswith("{")
            if is_json:
                yield self._object(text, number)
            elif not self._heads:
                self._header(text, number)
            elif filled(text, self._delimiter):
                yield self._row(text, number)

    def _text(self, raw: bytes, number: int) -> str:
        if len(raw) > MAX_LINE:
            raise self._bad(number, f"is longer than {MAX_LINE:,} bytes")
        try:
            return raw.decode("utf-8-sig").strip()
        except UnicodeDecodeError:
            raise self._bad(number, "is not UTF-8") from None

    def _bad(self, number: int, what: str, code: str = "E603") -> TraceError:
        return TraceError(Diagnostic(code, f"line {number} of the {self.name} {what}"))

    # ------------------------------------------------------------------------ names

    def _named(self, there: Iterable[str]) -> None:
        """Assign the names in the stream, `there`, to the time and to the signals.

        Raises:
            TraceError: E601, a requested name is not in the stream.
        """
        known = list(there)
        names = dict(self.reading.names)
        self._clock = names.pop(CLOCK, None) or clock_among(known)
        missing = [old for old in (*names.values(), self._clock) if old is not None and old not in known]
        if missing:
            raise TraceError(*(absent(self.name, old, known) for old in missing))
        back = {old: new for new, old in names.items()}
        self._signals = {
            name: back.get(name, name)
            for name in known
            if name != self._clock and (name in back or name not in names)
        }

    def _header(self, text: str, number: int) -> None:
        self._delimiter = delimiter_of(text)
        cells = head_cells(text.removeprefix("#").strip(), self._delimiter)
        names, units = zip(*map(split_head, cells), strict=True)
        if len(set(names)) < len(names) or not all(names):
            raise self._bad(number, "does not name every column, or names one twice", "E605")
        if all(value_of(name) is not None for name in names):
            raise self._bad(number, "has numbers where the columns are named", "E605")
        self._heads = names
        self._named(name for name in names if name != group_among(names))
        unit_of = dict(zip(names, units, strict=True))
        self.units = {signal: unit_of[name] for name, signal in self._signals.items()}
        if self._clock is not None:
            self._scale = clock_scale(f"the {self.name}", self._clock, unit_of[self._clock])

    # ------------------------------------------------------------------------ values

    def _row(self, text: str, number: int) -> TimedSample:
        cells = [bare(cell) for cell in text.split(self._delimiter)]
        if len(cells) != len(self._heads):
            what = f"has {len(cells)} cells, the header names {len(self._heads)} columns"
            raise self._bad(number, what, "E605")
        if self._delimiter != ",":
            cells = [_with_point(cell) for cell in cells]
        return self._moment(self._of_one_trace(dict(zip(self._heads, cells, strict=True))), number)

    def _object(self, text: str, number: int) -> TimedSample:
        try:
            found = loads(text)
        except (ValueError, RecursionError):
            raise self._bad(number, "is not a JSON object") from None
        if not isinstance(found, dict):
            raise self._bad(number, "is not a JSON object")
        flat: dict[str, object] = {}
        for name, value in found.items():
            many = isinstance(value, list)
            flat |= {f"{name}[{i}]": each for i, each in enumerate(value)} if many else {name: value}
        flat = self._of_one_trace(flat)
        if not self._signals:
            self._named(flat)
        elif new := [name for name in flat if name not in self._signals and name != self._clock]:
            self._signals |= {name: name for name in new if name not in self.reading.names}
        return self._moment(flat, number)

    def _of_one_trace(self, values: dict[str, object]) -> dict[str, object]:
        """Remove the cell that names the trace of a line. Raises TraceError (E605) for a second trace."""
        group = group_among(values)
        if group is None:
            return values
        key = values.pop(group)
        if key is not None:
            number = _plain(key)
            self._only.require(group, key if number is None else number)
        return values

    def _moment(self, values: Mapping[str, object], number: int) -> TimedSample:
        time = None if self._clock is None else self._seconds(values.get(self._clock), number)
        found = {
            signal: self._number(signal, values[name], number)
            for name, signal in self._signals.items()
            if name in values
        }
        return TimedSample(time, {signal: value for signal, value in found.items() if value is not None})

    def _seconds(self, value: object, number: int) -> float:
        found = _plain(value)
        if found is not None and math.isfinite(seconds := found * self._scale):
            return seconds
        if isinstance(value, str) and found is None:
            instant = instant_of_word(value)
            if instant is not None:
                self._begin = instant if self._begin is None else self._begin
                return float((instant - self._begin) / np.timedelta64(1, "ns")) * 1e-9
        shown = "no time" if value is None or value == "" else f"`{str(value)[:40]}` for a time"
        raise self._bad(number, f"has {shown}")

    def _number(self, signal: str, value: object, number: int) -> float | None:
        """Convert a value in line `number` to a number; None if it is a word that no requirement needs.

        Raises:
            TraceError: E603, a needed signal has an unknown word or another value that is not a number.
        """
        if value is None:
            return math.nan
        found = _plain(value)
        if found is not None:
            return found
        worth = (self.reading.words or {}).get(signal)
        if worth is None:
            return None
        if worth and isinstance(value, str):
            return number_of_word(f"line {number} of the {self.name}", signal, value, worth)
        raise self._bad(number, f"has `{str(value)[:40]}` where a number is expected")


def _with_point(cell: str) -> str:
    """Return a cell with a point in place of its decimal comma, if this makes it a number."""
    changed = cell.replace(",", ".")
    return changed if value_of(cell) is None and value_of(changed) is not None else cell


def _plain(value: object) -> float | None:
    """Return the number in a JSON value or in the text of a cell; None if there is no number."""
    if isinstance(value, str):
        return value_of(value)
    if isinstance(value, int):
        return float(value) if abs(value) < _BEYOND_FLOATS else math.inf
    return value if isinstance(value, float) else None


# --------------------------------------------------------------------------------- time


@dataclass(frozen=True, slots=True)
class Uniform:
    """Samples on a uniform time grid.

    Attributes:
        t0: time of the first sample in seconds.
        dt: time step in seconds; None if unknown.
        samples: iterator over the samples; it raises TraceError for invalid input.
    """

    t0: float
    dt: float | None
    samples: Iterator[Sample]


def on_grid(moments: Iterator[TimedSample], reading: Reading, name: str) -> Uniform:
    """Return the samples of a stream on a uniform time grid; each one is yielded once it is known.

    The grid is the one that `stlc.trace.trace.trace_of` would use for a file with the same samples. The
    options `reading.resample` and `reading.max_gap` request resampling; without them, the times must be
    uniform. With resampling, a sample is known once every signal has a later value, or had no value for
    longer than the allowed gap.

    Raises:
        TraceError: E601, the times of the samples are unknown; E602, the times are not uniform, or decrease;
            E605, there are no samples.
    """
    first = next(moments, None)
    if first is None:
        raise TraceError(Diagnostic("E605", f"the {name} holds no samples"))
    if reading.resample is None and reading.max_gap is None:
        return _steady(first, moments, reading.dt, name)
    gridded = Gridded(name, reading)
    samples = gridded.samples(first, moments)
    head = next(samples, None)
    assert head is not None
    return Uniform(gridded.t0, gridded.dt, chain([head], samples))


def _steady(first: TimedSample, rest: Iterator[TimedSample], dt: float | None, name: str) -> Uniform:
    if dt is not None:
        require_step(name, dt)
    second = next(rest, None)
    if first.time is None or second is None or second.time is None:
        moments = chain([first] if second is None else [first, second], rest)
        return Uniform(first.time or 0.0, dt, (moment.sample for moment in moments))
    step = snapped(second.time - first.time) if dt is None else dt
    if not step > 0:
        message = f"time in the {name} does not increase: {first.time:g} s, {second.time:g} s"
        raise TraceError(Diagnostic("E602", message))
    require_step(name, step)
    return Uniform(first.time, step, _checked(first, second, rest, step, name, measured=dt is None))


def _checked(
    first: TimedSample,
    second: TimedSample,
    rest: Iterator[TimedSample],
    step: float,
    name: str,
    *,
    measured: bool,
) -> Iterator[Sample]:
    assert first.time is not None
    yield first.sample
    for number, moment in enumerate(chain([second], rest), 1):
        now, wanted = moment.time, first.time + number * step
        if now is None or not abs(now - wanted) <= TOLERANCE * step + _SLACK * abs(wanted):
            found = "no time" if now is None else f"{now:.6g} s"
            message = f"time in the {name} is not uniform: sample {number} has {found}, not {wanted:.6g} s"
            raise TraceError(
                Diagnostic("E602", message, help=_ways_out(now, wanted, step, measured=measured))
            )
        yield moment.sample


def _ways_out(now: float | None, wanted: float, step: float, *, measured: bool) -> tuple[str, ...]:
    if now is None:
        return ()
    missed = (now - wanted) / step
    if 0.5 < missed < math.inf and abs(missed - round(missed)) <= TOLERANCE:
        return (gap_advice(step),)
    advice = ("--dt TIME  says what the step is; without it the first two samples do",) if measured else ()
    return (resample_advice(step), *advice)


@dataclass(slots=True)
class _Track:
    """Buffer of the samples of one signal that are still needed for interpolation."""

    held: bool
    times: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def take(self, time: float, value: float) -> None:
        if not math.isnan(value):
            self.times.append(time)
            self.values.append(value)

    def forget(self, before: float) -> None:
        """Drop samples that interpolation at time `before` or later does not need."""
        there = int(np.searchsorted(self.times, before, side="right")) - 1
        if there > 0:
            del self.times[:there], self.values[:there]

    def on(self, grid: Floats, spacing: Spacing, end: float) -> Floats:
        """Return the values of the signal on a time grid, (points,).

        No further sample of the signal comes before the time `end`, in seconds.
        """
        times, values = np.array(self.times, dtype=np.float64), np.array(self.values, dtype=np.float64)
        return values_on(grid, times, values, spacing, held=self.held, end=end)

    def known_until(self, now: float, limit: float) -> float:
        """Return the time in seconds up to which interpolated values can no longer change.

        `now` is the time of the latest sample of the stream. `limit` is the longest gap between two samples,
        in seconds, that is bridged by interpolation.
        """
        last = self.times[-1] if self.times else -math.inf
        return now if now - last > limit else last


@dataclass(slots=True)
class Gridded:
    """Resampler of a stream: converts samples at arbitrary times to a uniform grid, as they arrive.

    Attributes:
        name: name of the stream, for messages.
        reading: the requested grid, and the kinds of the signals.
        t0: time of the first sample in seconds.
        dt: time step of the time grid in seconds; known once the first sample on the grid was yielded.
    """

    name: str
    reading: Reading
    t0: float = 0.0
    dt: float = math.nan
    _spacing: Spacing | None = None
    _tracks: dict[str, _Track] = field(default_factory=dict)
    _done: int = 0
    _came: int = 0
    _last: float = -math.inf

    def samples(self, first: TimedSample, rest: Iterator[TimedSample]) -> Iterator[Sample]:
        """Yield the samples on the time grid one by one; none is yielded before the time step is known."""
        waiting: list[float] = []
        for moment in chain([first], rest):
            now = self._take(moment)
            if self._spacing is None:
                waiting.append(now)
                if len(waiting) < FIRST and self._has_to_wait:
                    continue
                self._begin(waiting)
            yield from self._ready(now)
        if self._spacing is None:
            self._begin(waiting)
        yield from self._rest()

    @property
    def _has_to_wait(self) -> bool:
        """True if the first samples must be collected, since the usual time step is estimated from them."""
        return self.reading.max_gap is None or (self.reading.resample or self.reading.dt) is None

    def _take(self, moment: TimedSample) -> float:
        time = moment.time
        if time is None:
            if self.reading.dt is None:
                raise TraceError(Diagnostic("E601", f"the {self.name} has no `t`", help=(NO_CLOCK, NO_STEP)))
            time = self._came * self.reading.dt
        if time < self._last:
            message = f"time in the {self.name} runs backwards: {self._last:g} s, {time:g} s"
            raise TraceError(Diagnostic("E602", message))
        if not self._came:
            self.t0 = time
        require_span(self.name, self.t0, time)
        self._came, self._last = self._came + 1, time
        for signal, value in moment.sample.items():
            if signal not in self._tracks:
                self._tracks[signal] = _Track(self._is_held(signal))
            self._tracks[signal].take(time, value)
        return time

    def _is_held(self, signal: str) -> bool:
        kinds = self.reading.kinds
        return (kinds.get(signal) or kinds.get(signal.partition("[")[0]) or "real") != "real"

    def _begin(self, times: list[float]) -> None:
        first = np.array(times, dtype=np.float64)
        self.dt = self.reading.resample or self.reading.dt or snapped(usual_step(first))
        require_step(self.name, self.dt)
        self._spacing = Spacing.of(self.dt, first, self.reading.max_gap)

    def _ready(self, now: float) -> Iterator[Sample]:
        """Yield the samples on the time grid that are known once a sample at time `now` has arrived."""
        assert self._spacing is not None
        until = [track.known_until(now, self._spacing.limit) for track in self._tracks.values()]
        stop = min(until, default=now)
        if stop == -math.inf:
            return
        yield from self._upto(lambda grid: grid + self._slack < stop, (stop - self.t0) / self.dt + 1, now)

    def _rest(self) -> Iterator[Sample]:
        """Yield the remaining samples on the time grid at the end of the stream."""
        steps = (self._last - self.t0) / self.dt + self._slack / self.dt
        count = math.floor(min(steps, MAX_SAMPLES)) + 1
        yield from self._upto(lambda grid: np.ones(len(grid), dtype=np.bool_), count, self._last)

    @property
    def _slack(self) -> float:
        return 0.0 if self._spacing is None else self._spacing.slack

    def _upto(
        self, known: Callable[[Floats], NDArray[np.bool_]], most: float, end: float
    ) -> Iterator[Sample]:
        """Yield the next samples on the time grid, as long as they are known.

        Args:
            known: function from times of the grid, in seconds, to booleans: True if the sample at this time
                is known.
            most: greatest number of samples to yield since the start of the stream.
            end: no further sample of the stream comes before this time, in seconds.

        Raises:
            TraceError: E605, `most` is too large.
        """
        assert self._spacing is not None
        if most > MAX_SAMPLES:
            message = f"the {self.name} spans more than {MAX_SAMPLES:,} steps of {self.dt:g} s"
            raise TraceError(Diagnostic("E605", message, help=("a larger step",)))
        while True:
            stop = min(math.ceil(most), self._done + _AT_ONCE)
            grid = self.t0 + self.dt * np.arange(self._done, stop, dtype=np.float64)
            grid = grid[known(grid)]
            if not len(grid):
                return
            columns = {
                name: track.on(grid, self._spacing, max(end, float(grid[-1])))
                for name, track in self._tracks.items()
            }
            self._done += len(grid)
            following = self.t0 + self.dt * self._done
            for track in self._tracks.values():
                track.forget(following)
            rows = np.array(list(columns.values())).T.tolist() if columns else [[]] * len(grid)
            for row in rows:
                yield dict(zip(columns, row, strict=True))
