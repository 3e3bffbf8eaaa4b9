"""Reading of samples that arrive line by line, as a table with a header or as JSON.

The samples are on one time grid. Names, units, words and times in a line are interpreted as in a file
(`stlc.trace.formats.csv`).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from stlc.diagnostics import Diagnostic, TraceError
from stlc.jsontext import loads
from stlc.trace.clocks import StreamClock
from stlc.trace.enums import number_of_word
from stlc.trace.formats.cells import bare, value_of
from stlc.trace.formats.csv import delimiter_of, filled, head_cells, split_head
from stlc.trace.formats.table import GROUPS
from stlc.trace.recording import CLOCK, absent
from stlc.trace.resample import FIRST, MAX_SAMPLES, ROUNDING, Between, longest_gap, track_of, usual_step
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
from stlc.trace.tracks import OneTrace

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
    _clock: StreamClock | None = None
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
            if len(raw) > MAX_LINE:
                raise self._bad(number, f"is longer than {MAX_LINE:,} bytes")
            try:
                text = raw.decode("utf-8-sig").strip()
            except UnicodeDecodeError:
                raise self._bad(number, "is not UTF-8") from None
            if text and is_json is None:
                is_json = text.startswith("{")
            if text and is_json:
                yield self._object(text, number)
            elif text and not self._heads:
                self._header(text, number)
            elif filled(text, self._delimiter):
                yield self._row(text, number)

    def _bad(self, number: int, what: str, code: str = "E603") -> TraceError:
        return TraceError(Diagnostic(code, f"line {number} of the {self.name} {what}"))

    # ------------------------------------------------------------------------ names

    def _header(self, text: str, number: int) -> None:
        self._delimiter = delimiter_of(text)
        cells = head_cells(text.removeprefix("#").strip(), self._delimiter)
        names, units = zip(*map(split_head, cells), strict=True)
        read = [name for name in names if self.reading.wanted.reads(name)]
        if len(set(read)) < len(read) or not all(read):
            raise self._bad(number, "does not name every column, or names one twice", "E605")
        if all(value_of(name) is not None for name in names):
            raise self._bad(number, "has numbers where the columns are named", "E605")
        self._heads = names
        self.units = dict(zip(names, units, strict=True))
        self._named(name for name in names if name and name != self._group(names))
        self.units = {signal: self.units[name] for name, signal in self._signals.items()}

    def _named(self, there: Iterable[str]) -> None:
        known, read = list(there), self.reading.read_in_file
        names = {signal: old for signal, old in self.reading.names.items() if signal != CLOCK}
        units = {name: self.units.get(name, "") for name in known}
        self._clock = StreamClock.of(self.name, units, self.reading.setting, read)
        missing = [old for old in names.values() if old not in known and (read is None or old in read)]
        if missing:
            raise TraceError(*(absent(self.name, old, known) for old in missing))
        back = {old: new for new, old in names.items()}
        self._signals = {
            name: back.get(name, name)
            for name in known
            if (name in back or name not in names) and self._reads(name)
        }

    def _reads(self, name: str) -> bool:
        is_clock = self._clock is not None and name == self._clock.name
        return self.reading.wanted.reads(name) if self.reading.read is not None else not is_clock

    def _group(self, names: Iterable[str]) -> str | None:
        """Name of the column that gives the trace of each line; None if there is none."""
        there = set(names)
        return next((n for n in GROUPS if n in there and n not in (self.reading.read or ())), None)

    # ------------------------------------------------------------------------ values

    def _row(self, text: str, number: int) -> TimedSample:
        mark = self._delimiter
        cells = text.split(mark)
        if '"' in text:
            cells = next(csv.reader([text], delimiter=mark, skipinitialspace=True))
        if len(cells) != len(self._heads):
            what = f"has {len(cells)} cells, the header names {len(self._heads)} columns"
            raise self._bad(number, what, "E605")
        found: dict[str, object] = {}
        for name, cell in zip(self._heads, map(bare, cells), strict=True):
            pointed = cell if mark == "," else cell.replace(",", ".")  # if that makes a number
            found[name] = pointed if value_of(cell) is None and value_of(pointed) is not None else cell
        return self._moment(found, number)

    def _object(self, text: str, number: int) -> TimedSample:
        try:
            found = loads(text)
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict):
            raise self._bad(number, "is not a JSON object")
        flat: dict[str, object] = {}
        for name, value in found.items():
            many = isinstance(value, list)
            flat |= {f"{name}[{i}]": each for i, each in enumerate(value)} if many else {name: value}
        if not self._signals:
            self._named(name for name in flat if name != self._group(flat))
        for name in flat:
            if name not in self._signals and name not in self.reading.names and self._reads(name):
                self._signals[name] = name
        return self._moment(flat, number)

    def _moment(self, values: dict[str, object], number: int) -> TimedSample:
        group = self._group(values)
        if group is not None and (key := values.pop(group)) is not None:
            plain = _plain(key)
            self._only.require(group, key if plain is None else plain)
        time = None
        if self._clock is not None:
            value = values.get(self._clock.name)
            with suppress(OverflowError):
                time = self._clock.seconds(value)
            if time is None or not math.isfinite(time):
                shown = "no time" if value is None or value == "" else f"`{str(value)[:40]}` for a time"
                raise self._bad(number, f"has {shown}")
        found = {
            signal: self._number(signal, values[name], number)
            for name, signal in self._signals.items()
            if name in values
        }
        return TimedSample(time, {signal: value for signal, value in found.items() if value is not None})

    def _number(self, signal: str, value: object, number: int) -> float | None:
        """Return the number of a value; None if it is a word that no requirement needs."""
        found = math.nan if value is None else _plain(value)
        worth = (self.reading.words or {}).get(signal)
        if found is not None or worth is None:
            return found
        if worth and isinstance(value, str):
            return number_of_word(f"line {number} of the {self.name}", signal, value, worth)
        raise self._bad(number, f"has `{str(value)[:40]}` where a number is expected")


def _plain(value: object) -> float | None:
    """Return the number in a JSON value or in the text of a cell; None if there is no number."""
    if isinstance(value, int):
        return float(value) if abs(value) < _BEYOND_FLOATS else math.inf
    return value_of(value) if isinstance(value, str) else value if isinstance(value, float) else None


# --------------------------------------------------------------------------------- time


@dataclass(frozen=True, slots=True)
class Uniform:
    """Samples on a uniform time grid.

    Attributes:
        t0: time of the first sample in seconds.
        dt: time step in seconds; None if unknown.
        samples: iterator over the samples; it raises TraceError for invalid input.
        aside: function that counts the samples so far that lay between two instants of the grid.
    """

    t0: float
    dt: float | None
    samples: Iterator[Sample]
    aside: Callable[[], int] = lambda: 0


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
    return Uniform(gridded.t0, gridded.dt, chain([head], samples), lambda: gridded.aside)


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
            help_ = _ways_out(now, wanted, step, measured=measured)
            raise TraceError(Diagnostic("E602", message, help=help_))
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
class _Buffer:
    """Samples of one signal that are still needed for values between them."""

    between: Between
    times: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def forget(self, before: float) -> None:
        """Drop samples that values at time `before` or later do not need."""
        there = int(np.searchsorted(self.times, before, side="right")) - 1
        if there > 0:
            del self.times[:there], self.values[:there]

    def known_until(self, now: float, limit: float) -> float:
        """Return the time in seconds up to which values can no longer change, once `now` is reached."""
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
        aside: number of samples that lay between two instants of the grid.
    """

    name: str
    reading: Reading
    t0: float = 0.0
    dt: float = math.nan
    aside: int = 0
    _limit: float = math.nan
    _buffers: dict[str, _Buffer] = field(default_factory=dict)
    _done: int = 0
    _came: int = 0
    _last: float = -math.inf

    def samples(self, first: TimedSample, rest: Iterator[TimedSample]) -> Iterator[Sample]:
        """Yield the samples on the time grid one by one; none is yielded before the time step is known."""
        given = self.reading.resample or self.reading.dt
        waits = self.reading.max_gap is None or given is None  # the first samples tell the usual step
        waiting: list[float] = []
        for moment in chain([first], rest):
            waiting.append(self._take(moment))
            if math.isnan(self.dt):
                if len(waiting) < FIRST and waits:
                    continue
                self._begin(waiting, given)
            self._count(waiting)
            until = [each.known_until(self._last, self._limit) for each in self._buffers.values()]
            yield from self._before(min(until, default=self._last), self._last)
        if math.isnan(self.dt):
            self._begin(waiting, given)
        self._count(waiting)
        yield from self._before(math.inf, self._last)

    def _count(self, times: list[float]) -> None:
        """Count the times that lie between two instants of the grid, and forget them."""
        while times:
            steps = (times.pop() - self.t0) / self.dt
            self.aside += not math.isfinite(steps) or abs(steps - round(steps)) > ROUNDING

    def _take(self, moment: TimedSample) -> float:
        time = moment.time
        if time is None:
            if self.reading.dt is None:
                raise TraceError(Diagnostic("E601", f"the {self.name} has no `t`", help=(NO_CLOCK, NO_STEP)))
            time = self._came * self.reading.dt
        if time < self._last:
            message = f"time in the {self.name} runs backwards: {self._last:g} s, {time:g} s"
            raise TraceError(Diagnostic("E602", message))
        self.t0 = self.t0 if self._came else time
        require_span(self.name, self.t0, time)
        self._came, self._last = self._came + 1, time
        for signal, value in moment.sample.items():
            if signal not in self._buffers:
                base, kinds, between = signal.partition("[")[0], self.reading.kinds, self.reading.between
                held = (kinds.get(signal) or kinds.get(base) or "real") != "real"
                usual = Between("hold" if held else "linear")
                self._buffers[signal] = _Buffer(between.get(signal) or between.get(base) or usual)
            if not math.isnan(value):
                self._buffers[signal].times.append(time)
                self._buffers[signal].values.append(value)
        return time

    def _begin(self, times: list[float], given: float | None) -> None:
        first = np.array(times, dtype=np.float64)
        self.dt = given or snapped(usual_step(first[:FIRST]))
        require_step(self.name, self.dt)
        self._limit = longest_gap(self.dt, first, self.reading.max_gap)

    def _before(self, stop: float, end: float) -> Iterator[Sample]:
        """Yield the next samples on the grid before the time `stop`, and up to the time `end`, in seconds."""
        if stop == -math.inf:
            return
        slack = ROUNDING * self.dt
        most = (min(stop, end) - self.t0 + slack) / self.dt + 1
        if most > MAX_SAMPLES:
            message = f"the {self.name} spans more than {MAX_SAMPLES:,} steps of {self.dt:g} s"
            raise TraceError(Diagnostic("E605", message, help=("a larger step",)))
        while True:
            last = min(math.floor(most), self._done + _AT_ONCE)
            grid = self.t0 + self.dt * np.arange(self._done, last, dtype=np.float64)
            grid = grid[grid + slack < stop]
            if not len(grid):
                return
            columns = {}
            for name, each in self._buffers.items():
                times, values = np.array(each.times, np.float64), np.array(each.values, np.float64)
                track = track_of(times, values, each.between, self._limit, max(end, float(grid[-1])))
                columns[name] = track.around(grid, slack)[0]
            self._done += len(grid)
            for each in self._buffers.values():
                each.forget(self.t0 + self.dt * self._done)
            rows = np.array(list(columns.values())).T.tolist() if columns else [[]] * len(grid)
            for row in rows:
                yield dict(zip(columns, row, strict=True))
