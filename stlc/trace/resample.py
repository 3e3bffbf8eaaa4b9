"""Resampling of signals to one time grid, in which every recorded sample counts.

A grid shows a signal at regular instants. Between two of them there may be several samples, or none. The
samples are therefore kept as *moments*: all instants at which a signal was recorded, and the instants of the
grid. At a moment between two samples of a signal, its value is that of the earlier sample (`hold`), a point
on the line or arc between both (`linear`, `angle`), or either of them (`either`, the default for real
signals): then a verdict rests on values that were recorded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import TraceError
from stlc.signature import Kind
from stlc.trace.recording import ClockGroup, Recording, fit
from stlc.trace.time_grid import NO_CLOCK, NO_STEP, check_finite, require_step, snapped, usual_step

Array = NDArray[Any]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
How: TypeAlias = Literal["hold", "linear", "angle", "either"]

MAX_SAMPLES = 100_000_000
FREE_SAMPLES = 1_000_000
"""A grid may have this many samples, or `MAX_RATIO` for each recorded one."""
MAX_RATIO = 50

ROUNDING = 1e-6
"""Share of a step by which times may be off the grid."""

_GAPS = 9
"""Number of gaps between the first samples from which the usual step of a stream is computed."""

BRIDGED = 3
"""Default longest gap that is bridged, in usual steps."""

_SAME = 1 + 1e-9


@dataclass(frozen=True, slots=True)
class Between:
    """Values of a signal between its samples.

    Attributes:
        how: `hold`: that of the last sample; `linear`; `angle`: along the shorter arc; `either`: that of the
            last or the next sample.
        age: for `hold`, seconds after which a value is unknown; None: never.
        period: for `angle`, a full turn in the unit of the signal.
    """

    how: How
    age: float | None = None
    period: float = 2.0 * math.pi


FIRST = _GAPS + 1
"""Number of first samples from which the usual step of a stream is computed."""


def longest_gap(dt: float, times: Floats, max_gap: float | None, *, events: bool = False) -> float:
    """Return the longest gap between samples, in seconds, within which values are known.

    It is `max_gap`, if that is given. Otherwise it is unlimited for `events`, whose values hold until the
    next sample, and else three steps: of the grid (`dt`), or of the samples at `times`, whichever are longer.
    """
    if max_gap is not None:
        return max_gap * _SAME
    return math.inf if events else BRIDGED * max(dt, usual_step(times)) * _SAME


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Samples of a signal of one trace, without those that are unknown (NaN).

    Attributes:
        times: their times in seconds, increasing, (samples,).
        values: their values, (samples,).
        between: values between them.
        limit: longest gap in seconds within which values are known.
        end: time in seconds before which no further sample comes.
    """

    times: Floats
    values: Floats
    between: Between
    limit: float
    end: float

    def around(self, moments: Floats, slack: float) -> tuple[Floats, Floats]:
        """Return the two values that the signal may have at each moment, (moments,) each; NaN: unknown.

        They are the same array where values are known exactly.
        """
        if not len(self.times):
            unknown = np.full(len(moments), math.nan)
            return unknown, unknown
        there = np.searchsorted(self.times, moments + slack, side="right") - 1
        index = np.clip(there, 0, None)
        since = moments - self.times[index]
        exact = since <= slack
        found = self.values[index]
        how, last = self.between.how, len(self.times) - 1
        rest = self.end - self.times[-1] if how == "hold" else math.inf
        unknown = (np.append(np.diff(self.times), rest) > self.limit)[index] & ~exact
        if how == "hold" and self.between.age is not None:
            unknown = since > self.between.age * _SAME + slack
        unknown |= there < 0
        following = found
        if how == "either":
            following = np.where(exact, found, self.values[np.minimum(index + 1, last)])
            following[unknown] = math.nan
        elif how != "hold":
            width = np.append(np.diff(self.times), 1.0)[index]
            share = since / np.where(width > 0, width, 1.0)
            with np.errstate(all="ignore"):  # behind an infinite sample the line is unknown
                change = self.values[np.minimum(index + 1, last)] - found
                moved = found + share * change
                if how == "angle":
                    turn = self.between.period
                    low = -turn / 2 if (self.values < 0).any() else 0.0
                    moved = (moved - share * turn * np.round(change / turn) - low) % turn + low
            following = found = np.where(exact, found, moved)
        found = np.where(unknown, math.nan, found)
        return found, following if how == "either" else found


def track_of(times: Floats, values: Array, between: Between, limit: float, end: float) -> Track:
    """Return the samples of a signal, without NaN; those of one time are put a rounding error apart."""
    numbers = values.astype(np.float64, copy=False)
    there = ~np.isnan(numbers)
    if not there.all():
        times, numbers = times[there], numbers[there]
    same = np.diff(times) <= 0
    if same.any():
        index = np.arange(len(times))
        rank = index - np.maximum.accumulate(np.where(np.append(False, same), 0, index))
        times = np.maximum.accumulate(times + rank * 2 * np.spacing(np.abs(times) + 1.0))
    return Track(times, numbers, between, limit, end)


# ----------------------------------------------------------------------------- moments


@dataclass(frozen=True, slots=True)
class TimeRange:
    """Times in seconds between which a signal, or a whole recording, was seen."""

    first: float
    last: float

    def within(self, other: TimeRange) -> TimeRange:
        """Return the time that both spans share."""
        return TimeRange(max(self.first, other.first), min(self.last, other.last))

    def samples(self, t0: float, dt: float) -> range:
        """Samples of the grid from `t0` on, with step `dt`, in this time; they may be off by rounding."""
        first = math.ceil((self.first - t0) / dt - ROUNDING)
        return range(first, math.floor((self.last - t0) / dt + ROUNDING) + 1)


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Instants at which signals were recorded, and those of the grid, in order.

    Attributes:
        times: times in seconds, (moments,).
        starts: index of the first moment of each cell, which is the instant of the grid itself, (samples,).
        before: signal -> value, or that of the sample before, (traces, moments).
        after: signal -> value, or that of the sample after; the same array where it is the same.
        clocks: signal -> number of its clock.
    """

    times: Floats
    starts: Ints
    before: Mapping[str, Floats]
    after: Mapping[str, Floats]
    clocks: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class _Timed:
    """Signals (traces, samples) that share their sampling times; the times never decrease."""

    times: Floats
    signals: Mapping[str, Array]
    between: Mapping[str, Between]

    @property
    def events(self) -> bool:
        """True if all signals keep their value until the next sample."""
        return all(each.how == "hold" for each in self.between.values())


@dataclass(frozen=True, slots=True)
class Resampled:
    """Signals on a uniform grid.

    Attributes:
        t0: time of the first sample in seconds.
        dt: time step in seconds.
        data: signal -> (traces, samples); NaN where a signal is unknown.
        moments: all instants at which signals were recorded.
        spans: signal -> the time in which it was seen.
    """

    t0: float
    dt: float
    data: dict[str, Floats]
    moments: Moments
    spans: dict[str, TimeRange]


def resampled(
    recording: Recording,
    dt: float | None,
    max_gap: float | None,
    between: Mapping[str, Between],
    kinds: Mapping[str, Kind],
) -> Resampled:
    """Return the signals of a recording on one grid, which begins at their first sample.

    Args:
        recording: content of a trace file, with one or more groups of common times.
        dt: time step of the grid in seconds; None: the usual time between samples.
        max_gap: the longest gap, in seconds, within which values are known; None: see `longest_gap`.
        between: signal -> its values between samples; others follow from their kinds.
        kinds: signal -> kind of its numbers, which takes precedence over the kind in the file.

    Raises:
        TraceError: E601, a group has no times; E602, times decrease, or `dt` is not a valid time step; E604,
            a time is not finite; E605, arrays do not fit together, or the grid has too many samples.
    """
    groups = [_timed(recording, group, between, kinds) for group in recording.groups if group.arrays]
    if not groups:
        raise TraceError.of("E601", f"trace `{recording.name}` has no signals")
    if dt is None:
        dt = snapped(min((step for s in groups if (step := usual_step(s.times))), default=0.0))
    require_step(recording.name, dt)
    start = min(float(group.times[0]) for group in groups)
    stop = max(float(group.times[-1]) for group in groups)
    count = _count(recording, start, stop, dt, sum(len(group.times) for group in groups))
    points = start + dt * np.arange(count, dtype=np.float64)
    tracks = _tracks(groups, max_gap, between, start, dt, stop)
    stamps = {id(track.times): track.times for rows in tracks.values() for track in rows}
    times = np.unique(np.concatenate([points, *stamps.values()]))
    starts = np.searchsorted(times, points)
    data: dict[str, Floats] = {}
    before: dict[str, Floats] = {}
    after: dict[str, Floats] = {}
    for name, rows in tracks.items():
        pairs = [track.around(times, 0.0) for track in rows]
        before[name] = np.stack([pair[0] for pair in pairs])
        if any(pair[0] is not pair[1] for pair in pairs):
            after[name] = np.stack([pair[1] for pair in pairs])
            lines = [replace(track, between=Between("linear")) for track in rows]
            data[name] = np.stack([track.around(points, ROUNDING * dt)[0] for track in lines])
        else:
            data[name] = before[name][:, starts]
    data, before = _same_traces(recording.name, data), _same_traces(recording.name, before)
    other = _same_traces(recording.name, after) if after else after
    clocks = {name: clock for clock, group in enumerate(groups) for name in group.signals}
    moments = Moments(times, starts, before, {name: other.get(name, before[name]) for name in before}, clocks)
    spans = {name: _seen(rows, stop) for name, rows in tracks.items()}
    return Resampled(start, dt, data, moments, spans)


def _tracks(
    groups: Sequence[_Timed],
    max_gap: float | None,
    asked: Mapping[str, Between],
    start: float,
    dt: float,
    stop: float,
) -> dict[str, list[Track]]:
    found = {}
    for group in groups:
        points = start + dt * np.rint((group.times - start) / dt)
        times = np.where(np.abs(group.times - points) <= ROUNDING * dt, points, group.times)  # up to rounding
        events = group.events and len(groups) > 1
        for name, rows in group.signals.items():
            between = group.between[name]
            holds = events or (between.how == "hold" and name in asked)
            limit = longest_gap(dt, group.times, max_gap, events=holds)
            found[name] = [track_of(times, row, between, limit, stop) for row in rows]
    return found


def _seen(tracks: Sequence[Track], stop: float) -> TimeRange:
    """Time in which a signal was seen in all traces; empty if it never was."""
    seen = [track.times for track in tracks]
    if not all(map(len, seen)):
        return TimeRange(math.inf, -math.inf)
    last = stop if tracks[0].between.how == "hold" else min(float(times[-1]) for times in seen)
    return TimeRange(max(float(times[0]) for times in seen), last)


def _count(recording: Recording, start: float, stop: float, dt: float, recorded: int) -> int:
    steps = (stop - start) / dt + ROUNDING
    most = min(MAX_SAMPLES, max(FREE_SAMPLES, MAX_RATIO * recorded))
    if steps >= most:
        message = (
            f"`{recording.name}` spans {stop - start:.6g} s: a step of {dt:g} s gives {steps + 1:,.0f} "
            f"samples, and {recorded:,} were recorded"
        )
        named = next((g.named for g in recording.groups if g.arrays), "t")
        help_ = (
            f"--resample {nearest_step((stop - start) / most)}  takes a longer step",
            f"--clock {named}:us  says that the clock is in another unit than seconds",
        )
        raise TraceError.of("E605", message, help=help_)
    return math.floor(steps) + 1


def nearest_step(least: float) -> str:
    """Text of a round time step of at least `least` seconds."""
    power = 10.0 ** math.floor(math.log10(least))
    return f"{next(f * power for f in (1, 2, 5, 10, 20) if f * power >= least):.6g}s"


def _timed(
    recording: Recording, group: ClockGroup, asked: Mapping[str, Between], kinds: Mapping[str, Kind]
) -> _Timed:
    name = recording.name
    if group.clock is None:
        help_ = (NO_CLOCK, NO_STEP)
        raise TraceError.of("E601", f"trace `{name}` has no `t`", help=help_)
    times: Floats = group.clock.astype(np.float64).reshape(-1)
    check_finite(name, times)
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        i = int(back[0])
        message = f"time in `{name}` runs backwards: t[{i}] = {times[i]:g} s, t[{i + 1}] = {times[i + 1]:g} s"
        raise TraceError.of("E602", message)
    signals = fit(name, group.arrays, len(times))
    between = {n: _between(n, values, recording, asked, kinds) for n, values in signals.items()}
    return _Timed(times, signals, between)


def _between(
    name: str, values: Array, recording: Recording, given: Mapping[str, Between], kinds: Mapping[str, Kind]
) -> Between:
    """Values of a signal between its samples: as asked for, else held if it is discrete or has one sample."""
    base = name.partition("[")[0]
    asked = given.get(name) or given.get(base)
    if asked is not None:
        return asked
    said = kinds.get(name) or kinds.get(base)
    if said is None:
        said = recording.columns[name].kind if name in recording.columns else "real"
        said = "int" if said == "real" and values.dtype.kind in "biu" else said
    return Between("either" if said == "real" and values.shape[-1] > 1 else "hold")


def _same_traces(name: str, data: dict[str, Floats]) -> dict[str, Floats]:
    counts: Sequence[int] = [len(values) for values in data.values()]
    traces = max(counts)
    if any(count not in (1, traces) for count in counts):
        raise TraceError.of("E605", f"the signals of `{name}` have different numbers of traces")
    return {key: np.ascontiguousarray(np.broadcast_to(x, (traces, x.shape[1]))) for key, x in data.items()}
