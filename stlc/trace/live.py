"""Reading of samples that arrive in pieces of text, as a table with a header or as JSON.

The samples are on one time grid. Names, units, words and times in a line are interpreted as in a file
(`stlc.trace.formats.csv`).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import TraceError
from stlc.jsontext import loads
from stlc.trace.clocks import StreamClock
from stlc.trace.enums import number_of_word
from stlc.trace.formats.cells import bare, number_of, read_lines, value_of
from stlc.trace.formats.csv import delimiter_of, filled, head_cells, split_head
from stlc.trace.formats.table import GROUPS
from stlc.trace.recording import CLOCK, absent
from stlc.trace.resample import FIRST, MAX_SAMPLES, ROUNDING, Between, longest_gap, track_of
from stlc.trace.time_grid import (
    NO_CLOCK,
    NO_STEP,
    TOLERANCE,
    gap_advice,
    require_span,
    require_step,
    resample_advice,
    snapped,
    usual_step,
)
from stlc.trace.trace import Reading
from stlc.trace.tracks import OneTrace

Floats = NDArray[np.float64]

PIECE = 1 << 16
"""Greatest size in bytes of a piece that is read at once."""
MAX_LINE = 1_000_000

_BEYOND_FLOATS = 2**1000
_AT_ONCE = 4096
_SLACK = 1e-9
_TIME = ""
"""Key of the time of a line; no signal is called so."""
_SHORT = 2048
"""Size in bytes of text that is read line by line if any of its lines is unusual."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Consecutive samples of the same signals, at least one.

    Attributes:
        count: number of samples.
        times: their times in seconds, (samples,); None if the stream contains no times.
        columns: signal -> its numbers, (samples,); NaN where unknown. The components of a vector are `q[0]`,
            `q[1]`, …
    """

    count: int
    times: Floats | None
    columns: Mapping[str, Floats]

    def timed(self, times: Floats) -> Samples:
        """Return as many of the first samples as there are `times`, which become theirs."""
        columns = {name: values[: len(times)] for name, values in self.columns.items()}
        return Samples(len(times), times, columns)


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
    _is_json: bool | None = None
    _heads: tuple[str, ...] = ()
    _clock: StreamClock | None = None
    _signals: dict[str, str] = field(default_factory=dict)
    _only: OneTrace = field(init=False)
    _number: int = 0

    def __post_init__(self) -> None:
        self._only = OneTrace(self.name)

    def samples(self, pieces: Iterable[bytes]) -> Iterator[Samples]:
        """Yield one sample per line, those of a piece together; empty lines and cells make no sample.

        A piece may end anywhere in a line, which the next one continues.

        Raises:
            TraceError: E601, a requested signal or time column is missing; E603, a line is not a sample, or a
                word is not a value of its signal; E605, an invalid header, a wrong number of cells, or
                several traces. Samples of the lines before are yielded first.
        """
        rest = b""
        for piece in pieces:
            whole, end, rest = (rest + piece).rpartition(b"\n")
            if end:
                yield from self._of_lines(whole + end)
            if len(rest) > MAX_LINE:
                yield from self._line_by_line(rest)
        if rest:
            yield from self._of_lines(rest)

    def _of_lines(self, text: bytes) -> Iterator[Samples]:
        """Yield the samples of whole lines; where some are unusual, those of each half."""
        middle = text.find(b"\n", len(text) // 2) + 1
        if (found := self._table(text)) is not None:
            yield found
        elif self._is_json or len(text) < _SHORT or middle in (0, len(text)):
            yield from self._line_by_line(text)
        else:
            yield from self._of_lines(text[:middle])
            yield from self._of_lines(text[middle:])

    def _table(self, text: bytes) -> Samples | None:
        """Samples of lines that are a table of numbers; None if any line or cell needs a closer look."""
        heads, clock = self._heads, self._clock
        if not heads or self._group(heads) is not None or b'"' in text or not text.isascii():
            return None
        places = {name: i for i, name in enumerate(heads)}
        wanted = dict.fromkeys([*self._signals] if clock is None else [clock.name, *self._signals])
        order = [places[name] for name in wanted]
        columns = read_lines(text, 0, len(heads), self._delimiter, order, each=True) if order else None
        if columns is None or (clock is None and np.isnan(columns).all(axis=0).any()):
            return None
        times = None if clock is None else clock.times(columns[0])
        if clock is not None and (times is None or not np.isfinite(times).all()):
            return None
        self._number += len(columns[0])
        found = dict(zip(wanted, columns, strict=True))
        return Samples(len(columns[0]), times, {name: found[old] for old, name in self._signals.items()})

    def _line_by_line(self, text: bytes) -> Iterator[Samples]:
        found: list[dict[str, float]] = []
        try:
            for raw in text.removesuffix(b"\n").split(b"\n"):
                self._number += 1
                line = self._line(raw)
                if line is None:
                    continue
                if found and line.keys() != found[0].keys():
                    yield _together(found)
                    found.clear()
                found.append(line)
        except TraceError:
            if found:
                yield _together(found)
            raise
        if found:
            yield _together(found)

    def _line(self, raw: bytes) -> dict[str, float] | None:
        """The sample in a line, with its time under `_TIME`; None if it is empty, or the header."""
        if len(raw) > MAX_LINE:
            raise self._bad(f"is longer than {MAX_LINE:,} bytes")
        try:
            line = raw.decode("utf-8-sig").strip(" \r\n")
        except UnicodeDecodeError:
            raise self._bad("is not UTF-8") from None
        text = line.strip()
        if text and self._is_json is None:
            self._is_json = text.startswith("{")
        if text and self._is_json:
            return self._object(text)
        if text and not self._heads:
            self._header(text)
            if not self.reading.columns:
                return None
        return self._row(line) if filled(text, self._delimiter) else None

    def _bad(self, what: str, code: str = "E603", *help_: str) -> TraceError:
        return TraceError.of(code, f"line {self._number} of the {self.name} {what}", help=help_)

    # ------------------------------------------------------------------------ names

    def _header(self, text: str) -> None:
        self._delimiter = delimiter_of(text)
        given = self.reading.columns
        cells = given or head_cells(text.removeprefix("#").strip(), self._delimiter)
        names, units = zip(*map(split_head, cells), strict=True)
        read = [name for name in names if self.reading.wanted.reads(name)]
        if len(set(read)) < len(read) or not all(read):
            raise self._bad("does not name every column, or names one twice", "E605")
        if not given and all(value_of(name) is not None for name in names):
            help_ = "--columns t,x,v  names the columns of a stream without a header"
            raise self._bad("has numbers where the columns are named", "E605", help_)
        self._heads = names
        self.units = dict(zip(names, units, strict=True))
        self._named(name for name in names if name and name != self._group(names))
        self.units = {signal: self.units[name] for name, signal in self._signals.items()}

    def _named(self, there: Iterable[str]) -> None:
        known, read = list(there), self.reading.read_in_file
        names = {signal: old for signal, old in self.reading.names.items() if signal != CLOCK}
        units = {name: self.units.get(name, "") for name in known}
        self._clock = StreamClock.of(self.name, units, self.reading.setting, read)
        if self._clock is not None and known.count(self._clock.name) > 1:
            raise self._bad("names its clock twice", "E605")
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
        wanted = self.reading.wanted.reads(name) if self.reading.read is not None else not is_clock
        return wanted and name != _TIME

    def _group(self, names: Iterable[str]) -> str | None:
        """Name of the column that gives the trace of each line; None if there is none."""
        there = set(names)
        return next((n for n in GROUPS if n in there and n not in (self.reading.read or ())), None)

    # ------------------------------------------------------------------------ values

    def _row(self, text: str) -> dict[str, float]:
        mark = self._delimiter
        cells = text.split(mark)
        if '"' in text:
            try:
                cells = next(csv.reader([text], delimiter=mark, skipinitialspace=True))
            except csv.Error as error:
                raise self._bad(f"is no row of cells: {error}") from None
        if len(cells) != len(self._heads):
            what = f"has {len(cells)} cells, and {len(self._heads)} columns are named"
            raise self._bad(what, "E605")
        values = [number_of(cell, comma=mark != ",") for cell in cells]
        texts = [
            bare(cell) if value is None or math.isnan(value) else value
            for cell, value in zip(cells, values, strict=True)
        ]
        return self._moment(dict(zip(self._heads, texts, strict=True)))

    def _object(self, text: str) -> dict[str, float]:
        try:
            found = loads(text)
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict):
            raise self._bad("is not a JSON object")
        flat: dict[str, object] = {}
        for name, value in found.items():
            many = isinstance(value, list)
            flat |= {f"{name}[{i}]": each for i, each in enumerate(value)} if many else {name: value}
        if not self._signals:
            self._named(name for name in flat if name != self._group(flat))
        for name in flat:
            if name not in self._signals and name not in self.reading.names and self._reads(name):
                self._signals[name] = name
        return self._moment(flat)

    def _moment(self, values: dict[str, object]) -> dict[str, float]:
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
                raise self._bad(f"has {shown}")
        found = {} if time is None else {_TIME: time}
        for name, signal in self._signals.items():
            if name in values and (value := self._worth(signal, values[name])) is not None:
                found[signal] = value
        return found

    def _worth(self, signal: str, value: object) -> float | None:
        """Return the number of a value; None if it is a word that no requirement needs."""
        found = math.nan if value is None else _plain(value)
        worth = (self.reading.words or {}).get(signal)
        if found is not None or worth is None:
            return found
        if worth and isinstance(value, str):
            return number_of_word(f"line {self._number} of the {self.name}", signal, value, worth)
        raise self._bad(f"has `{str(value)[:40]}` where a number is expected")


def _plain(value: object) -> float | None:
    """Return the number in a JSON value or in the text of a cell; None if there is no number."""
    if isinstance(value, int):
        return float(value) if abs(value) < _BEYOND_FLOATS else math.inf
    return value_of(value) if isinstance(value, str) else value if isinstance(value, float) else None


def _together(lines: list[dict[str, float]]) -> Samples:
    columns = {name: np.array([line[name] for line in lines]) for name in lines[0]}
    return Samples(len(lines), columns.pop(_TIME, None), columns)


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
    samples: Iterator[Samples]
    aside: Callable[[], int] = lambda: 0

    def without_step(self, name: str) -> TraceError:
        """Error E601 of a stream without a clock, whose time step is needed."""
        return TraceError.of("E601", f"the {name} has no `t`", help=(NO_CLOCK, NO_STEP))


def on_grid(samples: Iterator[Samples], reading: Reading, name: str) -> Uniform:
    """Return the samples of a stream on a uniform time grid; each one is yielded once it is known.

    The grid is the one that `stlc.trace.trace.trace_of` would use for a file with the same samples. The
    options `reading.resample` and `reading.max_gap` request resampling; without them, the times must be
    uniform. With resampling, a sample is known once every signal has a later value, or had no value for
    longer than the allowed gap.

    Raises:
        TraceError: E601, the times of the samples are unknown; E602, the times are not uniform, or decrease;
            E605, there are no samples.
    """
    first = next(samples, None)
    if first is None:
        raise TraceError.of("E605", f"the {name} holds no samples")
    if reading.resample is None and reading.max_gap is None:
        return _steady(first, samples, reading.dt, name)
    gridded = Gridded(name, reading)
    found = gridded.samples(chain([first], samples))
    head = next(found)
    return Uniform(gridded.t0, gridded.dt, chain([head], found), lambda: gridded.aside)


def _steady(first: Samples, rest: Iterator[Samples], dt: float | None, name: str) -> Uniform:
    if dt is not None:
        require_step(name, dt)
    begun = [first, *islice(rest, int(first.count == 1))]
    times = [time for each in begun for time in ([] if each.times is None else each.times[:2].tolist())]
    samples = chain(begun, rest)
    if len(times) < 2:
        return Uniform(times[0] if times else 0.0, dt, samples)
    step = snapped(times[1] - times[0]) if dt is None else dt
    if not step > 0:
        message = f"time in the {name} does not increase: {times[0]:g} s, {times[1]:g} s"
        raise TraceError.of("E602", message)
    require_step(name, step)
    return Uniform(times[0], step, _checked(samples, times[0], step, name, measured=dt is None))


def _checked(
    samples: Iterator[Samples], t0: float, step: float, name: str, *, measured: bool
) -> Iterator[Samples]:
    count = 0
    for each in samples:
        assert each.times is not None
        wanted = t0 + np.arange(count, count + each.count) * step
        with np.errstate(over="ignore"):
            wrong = ~(np.abs(each.times - wanted) <= TOLERANCE * step + _SLACK * np.abs(wanted))
        bad = int(np.argmax(np.append(wrong, True)))
        if bad:
            yield each.timed(each.times[:bad])
        count += bad
        if bad == each.count:
            continue
        now, due = float(each.times[bad]), float(wanted[bad])
        message = f"time in the {name} is not uniform: sample {count} has {now:.6g} s, not {due:.6g} s"
        missed, help_ = (now - due) / step, [resample_advice(step)]
        if 0.5 < missed < math.inf and abs(missed - round(missed)) <= TOLERANCE:
            help_ = [gap_advice(step)]
        elif measured:
            help_.append("--dt TIME  says what the step is; without it the first two samples do")
        raise TraceError.of("E602", message, help=tuple(help_))


@dataclass(slots=True)
class _Buffer:
    """Samples of one signal that are still needed for values between them."""

    between: Between
    times: Floats = field(default_factory=lambda: np.zeros(0))
    values: Floats = field(default_factory=lambda: np.zeros(0))

    def forget(self, before: float) -> None:
        """Drop samples that values at time `before` or later do not need."""
        there = int(np.searchsorted(self.times, before, side="right")) - 1
        if there > 0:
            self.times, self.values = self.times[there:], self.values[there:]

    def known_until(self, now: float, limit: float) -> float:
        """Return the time in seconds up to which values can no longer change, once `now` is reached."""
        last = float(self.times[-1]) if len(self.times) else -math.inf
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
    _waiting: Floats = field(default_factory=lambda: np.zeros(0))

    def samples(self, recorded: Iterator[Samples]) -> Iterator[Samples]:
        """Yield the samples on the time grid; none is yielded before the time step is known."""
        given = self.reading.resample or self.reading.dt
        least = FIRST if self.reading.max_gap is None or given is None else 1  # they tell the usual step
        for times in self._taken(recorded):
            self._waiting = np.append(self._waiting, times)
            if math.isnan(self.dt) and len(self._waiting) >= least:
                self._begin(self._waiting[:least], given)
            if not math.isnan(self.dt):
                yield from self._known()
        if math.isnan(self.dt):
            self._begin(self._waiting, given)
            yield from self._known()
        yield from self._before(math.inf)

    def _taken(self, recorded: Iterator[Samples]) -> Iterator[Floats]:
        """Take samples and yield their times, up to the first that is invalid, which raises TraceError."""
        for each in recorded:
            if each.times is not None:
                times = each.times
            elif self.reading.dt is not None:
                times = self.reading.dt * np.arange(self._came, self._came + each.count, dtype=np.float64)
            else:
                raise TraceError.of("E601", f"the {self.name} has no `t`", help=(NO_CLOCK, NO_STEP))
            self.t0 = self.t0 if self._came else float(times[0])
            before = np.append(self._last, times[:-1])
            with np.errstate(over="ignore"):
                wrong = ~((times >= before) & np.isfinite(times - self.t0))
            bad = int(np.argmax(np.append(wrong, True)))
            self._came, self._last = self._came + bad, float(np.append(self._last, times)[bad])
            for signal, values in each.timed(times[:bad]).columns.items():
                if signal not in self._buffers:
                    base, kinds, between = signal.partition("[")[0], self.reading.kinds, self.reading.between
                    held = (kinds.get(signal) or kinds.get(base) or "real") != "real"
                    usual = Between("hold" if held else "linear")
                    self._buffers[signal] = _Buffer(between.get(signal) or between.get(base) or usual)
                buffer, known = self._buffers[signal], ~np.isnan(values)
                buffer.times = np.append(buffer.times, times[:bad][known])
                buffer.values = np.append(buffer.values, values[known])
            yield times[:bad]
            if bad < each.count:
                if times[bad] < before[bad]:
                    message = f"time in the {self.name} runs backwards: {before[bad]:g} s, {times[bad]:g} s"
                    raise TraceError.of("E602", message)
                require_span(self.name, self.t0, float(times[bad]))

    def _begin(self, first: Floats, given: float | None) -> None:
        self.dt = given or snapped(usual_step(first[:FIRST]))
        require_step(self.name, self.dt)
        self._limit = longest_gap(self.dt, first, self.reading.max_gap)

    def _known(self) -> Iterator[Samples]:
        """Yield the samples on the grid that can no longer change, and count those recorded beside it."""
        with np.errstate(over="ignore", invalid="ignore"):
            steps = (self._waiting - self.t0) / self.dt
            self.aside += int(np.count_nonzero(~(np.abs(steps - np.round(steps)) <= ROUNDING)))
        self._waiting = self._waiting[:0]
        until = [each.known_until(self._last, self._limit) for each in self._buffers.values()]
        yield from self._before(min(until, default=self._last))

    def _before(self, stop: float) -> Iterator[Samples]:
        """Yield the next samples on the grid before the time `stop` in seconds, and up to the latest one."""
        if stop == -math.inf:
            return
        slack = ROUNDING * self.dt
        most = (min(stop, self._last) - self.t0 + slack) / self.dt + 1
        if most > MAX_SAMPLES:
            message = f"the {self.name} spans more than {MAX_SAMPLES:,} steps of {self.dt:g} s"
            raise TraceError.of("E605", message, help=("a larger step",))
        while True:
            last = min(math.floor(most), self._done + _AT_ONCE)
            grid = self.t0 + self.dt * np.arange(self._done, last, dtype=np.float64)
            grid = grid[grid + slack < stop]
            if not len(grid):
                return
            end = max(self._last, float(grid[-1]))
            columns = {}
            for name, each in self._buffers.items():
                track = track_of(each.times, each.values, each.between, self._limit, end)
                columns[name] = track.around(grid, slack)[0]
            self._done += len(grid)
            for each in self._buffers.values():
                each.forget(self.t0 + self.dt * self._done)
            yield Samples(len(grid), grid, columns)
