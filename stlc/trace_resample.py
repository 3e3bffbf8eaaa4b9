"""Signals of any clocks -> one uniform grid: what is discrete is held, real numbers are interpolated."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.signature import Kind
from stlc.trace_recording import Recording, Strand, fit
from stlc.trace_time import require_step

Array = NDArray[Any]
Floats = NDArray[np.float64]

MAX_SAMPLES = 100_000_000

_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class _Timed:
    """Signals (traces, samples) with the times of their samples, which never decrease."""

    times: Floats
    signals: Mapping[str, Array]
    held: frozenset[str]

    @property
    def first(self) -> float:
        return float(self.times[0])

    @property
    def last(self) -> float:
        """The last time at which all signals are known; held ones are known from their first on."""
        return float(self.times[-1]) if len(self.held) < len(self.signals) else math.inf


def resampled(recording: Recording, dt: float, kinds: Mapping[str, Kind]) -> tuple[float, dict[str, Floats]]:
    """Time of the first sample, and the signals (traces, samples) on a grid of `dt` seconds.

    The grid spans the time in which every signal is known. bool, int and enum signals keep their last value
    (zero-order hold), real ones are interpolated.

    Args:
        recording: of one or more strands.
        dt: in seconds.
        kinds: signal -> what its numbers mean, where the caller knows better than the file.

    Raises:
        TraceError: E601, a strand has no clock; E602, times decrease, or have no stretch in common, or `dt`
            is no time step; E604, a time that is not finite; E605, arrays that do not fit, or too many
            samples.
    """
    require_step(recording.name, dt)
    strands = [_timed(recording, strand, kinds) for strand in recording.strands if strand.arrays]
    if not strands:
        raise TraceError(Diagnostic("E601", f"trace `{recording.name}` has no signals"))
    start = max(strand.first for strand in strands)
    stop = min(strand.last for strand in strands)
    if math.isinf(stop):
        stop = max(float(strand.times[-1]) for strand in strands)
    count = _count(recording.name, start, stop, dt)
    grid = start + dt * np.arange(count, dtype=np.float64)
    data: dict[str, Floats] = {}
    for strand in strands:
        for name, values in strand.signals.items():
            take = _held if name in strand.held else _linear
            data[name] = np.stack([take(grid, strand.times, row) for row in values])
    return start, _same_traces(recording.name, data)


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


def _timed(recording: Recording, strand: Strand, kinds: Mapping[str, Kind]) -> _Timed:
    name = recording.name
    if strand.clock is None:
        help_ = ("add an array `t` with the time of every sample in seconds, or name it: --map t=NAME",)
        raise TraceError(Diagnostic("E601", f"trace `{name}` has no `t`", help=help_))
    times: Floats = strand.clock.astype(np.float64).reshape(-1)
    _check_times(name, times)
    signals = fit(name, strand.arrays, len(times))
    held = frozenset(n for n, values in signals.items() if _discrete(n, values, recording, kinds))
    return _Timed(times, signals, held)


def _check_times(name: str, times: Floats) -> None:
    if not len(times):
        raise TraceError(Diagnostic("E605", f"trace `{name}` has no samples"))
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        raise TraceError(Diagnostic("E604", f"time in `{name}` is {times[bad[0]]} at t[{bad[0]}]"))
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        i = int(back[0])
        message = f"time in `{name}` runs backwards: t[{i}] = {times[i]:g} s, t[{i + 1}] = {times[i + 1]:g} s"
        raise TraceError(Diagnostic("E602", message))


def _discrete(name: str, values: Array, recording: Recording, kinds: Mapping[str, Kind]) -> bool:
    if name in kinds:
        return kinds[name] != "real"
    if name in recording.columns and recording.columns[name].kind != "real":
        return True
    return values.dtype.kind in "biu"


def _held(grid: Floats, times: Floats, values: Array) -> Floats:
    """The last sample up to each instant; rounding of a clock must not cost a sample."""
    slack = _ROUNDING * (grid[1] - grid[0] if len(grid) > 1 else 1.0)
    index = np.searchsorted(times, grid + slack, side="right") - 1
    return values[np.clip(index, 0, len(times) - 1)].astype(np.float64)


def _linear(grid: Floats, times: Floats, values: Array) -> Floats:
    """Straight lines between samples; a sample on the grid keeps its bits."""
    return np.asarray(np.interp(grid, times, values.astype(np.float64)), dtype=np.float64)


def _same_traces(name: str, data: dict[str, Floats]) -> dict[str, Floats]:
    counts: Sequence[int] = [len(values) for values in data.values()]
    traces = max(counts)
    if any(count not in (1, traces) for count in counts):
        raise TraceError(Diagnostic("E605", f"the signals of `{name}` have different numbers of traces"))
    return {key: np.ascontiguousarray(np.broadcast_to(x, (traces, x.shape[1]))) for key, x in data.items()}
