"""Resampling of signals to one time grid: discrete signals are held, real ones interpolated linearly.

If the gap between two samples of a signal is too long, the signal is unknown (NaN) within it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.signature import Kind
from stlc.trace.recording import ClockGroup, Recording, fit
from stlc.trace.time_grid import NO_CLOCK, NO_STEP, check_finite, require_step, snapped

Array = NDArray[Any]
Floats = NDArray[np.float64]

MAX_SAMPLES = 100_000_000

_ROUNDING = 1e-6

_GAPS = 9
"""Number of gaps between the first samples from which the usual step is computed."""

BRIDGED = 3
"""Default longest gap that is bridged, in usual steps."""

_SAME = 1 + 1e-9


def usual_step(times: Floats) -> float:
    """Usual time between samples in seconds; 0 if it is unknown.

    It is the median of the first nine time differences, without those that are 0.
    """
    gaps = np.diff(times[: _GAPS + 1])
    gaps = gaps[gaps > 0]
    return float(np.median(gaps)) if len(gaps) else 0.0


FIRST = _GAPS + 1
"""Number of samples that `usual_step` uses."""


@dataclass(frozen=True, slots=True)
class Spacing:
    """Time step of a grid, and the longest gap between samples that is bridged.

    Attributes:
        dt: time step of the grid in seconds.
        limit: the longest gap between two samples, in seconds, within which values are held or interpolated.
    """

    dt: float
    limit: float = math.inf

    @staticmethod
    def of(dt: float, times: Floats, max_gap: float | None, *, events: bool = False) -> Spacing:
        """Return the spacing with step `dt` that bridges gaps of at most `max_gap` seconds.

        Within a bridged gap, values are held or interpolated. If `max_gap` is None, there are two cases. If
        `events` is True, all gaps are bridged: each value of a discrete signal holds until the next sample.
        Otherwise gaps of up to three steps are bridged. The length of a step is then `dt` or the usual time
        between the samples at `times`, whichever is longer.
        """
        if max_gap is not None:
            return Spacing(dt, max_gap * _SAME)
        return Spacing(dt, math.inf if events else BRIDGED * max(dt, usual_step(times)) * _SAME)

    @property
    def slack(self) -> float:
        """Tolerance in seconds for rounding errors of times."""
        return _ROUNDING * self.dt


def values_on(
    grid: Floats, times: Floats, values: Array, spacing: Spacing, *, held: bool, end: float
) -> Floats:
    """Return a signal on a grid, (points,), NaN where it is unknown.

    A signal is unknown before its first sample and within gaps that are too long. If it is interpolated, it
    is also unknown after its last sample. Samples that are NaN are ignored.

    Args:
        grid: increasing times of the grid in seconds, (points,).
        times: times of the samples, non-decreasing, (samples,).
        values: values of the samples, (samples,).
        spacing: time step of the grid and longest allowed gap.
        held: True for zero-order hold, False for linear interpolation.
        end: no further sample comes before this time, in seconds. A held last value is known until `end`,
            unless the gap from the last sample to `end` is too long.
    """
    there = ~np.isnan(values) if values.dtype.kind == "f" else np.ones(len(values), dtype=np.bool_)
    if not there.all():
        times, values = times[there], values[there]
    if not len(times):
        return np.full(len(grid), math.nan)
    slack = spacing.slack
    index = np.searchsorted(times, grid + slack, side="right") - 1
    before = np.clip(index, 0, None)
    if held:
        found = values[before].astype(np.float64)
    else:
        found = np.asarray(np.interp(grid, times, values.astype(np.float64)), dtype=np.float64)
    gaps = np.append(np.diff(times), end - times[-1] if held else math.inf)
    unknown = (gaps[before] > spacing.limit) | (not held) & (before == len(times) - 1)
    unknown &= grid - times[before] > slack
    found[unknown | (index < 0)] = math.nan
    return found


@dataclass(frozen=True, slots=True)
class _Timed:
    """Signals (traces, samples) that share their sampling times; the times never decrease."""

    times: Floats
    signals: Mapping[str, Array]
    held: frozenset[str]

    @property
    def first(self) -> float:
        return float(self.times[0])

    @property
    def events(self) -> bool:
        """True if all signals keep their value until the next sample."""
        return len(self.held) == len(self.signals)

    @property
    def last(self) -> float:
        """The last time at which all signals are known; +inf if all keep their last value."""
        return math.inf if self.events else float(self.times[-1])


@dataclass(frozen=True, slots=True)
class ResampleGrid:
    """Grid requested for resampling.

    Attributes:
        dt: time step in seconds; None: the usual time between samples.
        max_gap: the longest gap, in seconds, within which values are known. If None, the limit is three
            steps, but discrete signals with a time column of their own have no limit.
    """

    dt: float | None = None
    max_gap: float | None = None


@dataclass(frozen=True, slots=True)
class Resampled:
    """Signals on a uniform grid.

    Attributes:
        t0: time of the first sample in seconds.
        dt: time step in seconds.
        data: signal -> (traces, samples); NaN where a signal is unknown.
    """

    t0: float
    dt: float
    data: dict[str, Floats]


def resampled(recording: Recording, grid: ResampleGrid, kinds: Mapping[str, Kind]) -> Resampled:
    """Return the signals of a recording on one grid.

    The grid spans the time in which every signal is known. bool, int and enum signals keep their last value
    (zero-order hold), and real signals are interpolated. Within a gap that is too long, a signal is NaN.

    Args:
        recording: content of a trace file, with one or more groups of common times.
        grid: the requested grid.
        kinds: signal -> kind of its numbers, which takes precedence over the kind in the file.

    Raises:
        TraceError: E601, a group has no times; E602, times decrease, have no common interval, or `dt` is not
            a valid time step; E604, a time is not finite; E605, arrays do not fit together, or there are too
            many samples.
    """
    groups = [_timed(recording, group, kinds) for group in recording.groups if group.arrays]
    if not groups:
        raise TraceError(Diagnostic("E601", f"trace `{recording.name}` has no signals"))
    dt = grid.dt
    if dt is None:
        dt = snapped(min((step for s in groups if (step := usual_step(s.times))), default=0.0))
    require_step(recording.name, dt)
    start = max(group.first for group in groups)
    stop = min(group.last for group in groups)
    if math.isinf(stop):
        stop = max(float(group.times[-1]) for group in groups)
    count = _count(recording.name, start, stop, dt)
    instants = start + dt * np.arange(count, dtype=np.float64)
    data: dict[str, Floats] = {}
    for group in groups:
        spacing = Spacing.of(dt, group.times, grid.max_gap, events=group.events and len(groups) > 1)
        end = max(float(group.times[-1]), float(instants[-1]))
        for name, rows in group.signals.items():
            held = name in group.held
            data[name] = np.stack(
                [values_on(instants, group.times, row, spacing, held=held, end=end) for row in rows]
            )
    return Resampled(start, dt, _same_traces(recording.name, data))


def _count(name: str, start: float, stop: float, dt: float) -> int:
    if stop < start - _ROUNDING * dt:
        ends = f"one starts at {start:g} s, one ends at {stop:g} s"
        message = f"the signals of `{name}` have no time in common: {ends}"
        raise TraceError(Diagnostic("E602", message))
    steps = (stop - start) / dt + _ROUNDING
    if steps >= MAX_SAMPLES:
        message = (
            f"`{name}` spans {stop - start:g} s: a step of {dt:g} s gives more than {MAX_SAMPLES:,} samples"
        )
        raise TraceError(Diagnostic("E605", message, help=("a larger step",)))
    return math.floor(steps) + 1


def _timed(recording: Recording, group: ClockGroup, kinds: Mapping[str, Kind]) -> _Timed:
    name = recording.name
    if group.clock is None:
        help_ = (NO_CLOCK, NO_STEP)
        raise TraceError(Diagnostic("E601", f"trace `{name}` has no `t`", help=help_))
    times: Floats = group.clock.astype(np.float64).reshape(-1)
    _check_times(name, times)
    signals = fit(name, group.arrays, len(times))
    held = frozenset(n for n, values in signals.items() if _discrete(n, values, recording, kinds))
    return _Timed(times, signals, held)


def _check_times(name: str, times: Floats) -> None:
    check_finite(name, times)
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        i = int(back[0])
        message = f"time in `{name}` runs backwards: t[{i}] = {times[i]:g} s, t[{i + 1}] = {times[i + 1]:g} s"
        raise TraceError(Diagnostic("E602", message))


def _discrete(name: str, values: Array, recording: Recording, kinds: Mapping[str, Kind]) -> bool:
    said = kinds.get(name) or kinds.get(name.partition("[")[0])
    if said is not None:
        return said != "real"
    if name in recording.columns and recording.columns[name].kind != "real":
        return True
    return values.dtype.kind in "biu"


def _same_traces(name: str, data: dict[str, Floats]) -> dict[str, Floats]:
    counts: Sequence[int] = [len(values) for values in data.values()]
    traces = max(counts)
    if any(count not in (1, traces) for count in counts):
        raise TraceError(Diagnostic("E605", f"the signals of `{name}` have different numbers of traces"))
    return {key: np.ascontiguousarray(np.broadcast_to(x, (traces, x.shape[1]))) for key, x in data.items()}
