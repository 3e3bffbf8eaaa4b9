"""Uniform time grid of a trace, and error messages if its times are not uniform."""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.trace.recording import is_count_name

Floats = NDArray[np.float64]

TOLERANCE = 0.05
"""Tolerance of sample times, as a share of a step (rounded decimals, jitter)."""

NO_CLOCK = "add an array `t` with the time of every sample in seconds, or name it: --map t=NAME"
NO_STEP = "--dt 0.01s  says how far apart samples are that have no clock"

SHORTEST, LONGEST = 1e-15, 1e12
"""Valid time steps in seconds: from a femtosecond to 30,000 years."""

_SNAP = 1e-6


def usual_step(times: Floats) -> float:
    """Usual time between samples in seconds: the median of the positive differences; 0 if there are none."""
    gaps = np.diff(times)
    gaps = gaps[gaps > 0]
    if not len(gaps):
        return 0.0
    middle = [(len(gaps) - 1) // 2, len(gaps) // 2]
    return float(np.partition(gaps, middle)[middle].mean())  # `np.median` loads `np.ma`: 5 % of a small check


def resample_advice(step: float) -> str:
    """Help text for samples that are not on one grid: `--resample` with a proposed time step.

    `step` is the usual time between samples in seconds. A grid with this step would skip samples. The
    proposed step is therefore at most half of `step`.
    """
    if not (np.isfinite(step) and 2 * SHORTEST <= step <= LONGEST):
        return "--resample TIME  puts them on one grid, on which every sample counts"
    power = 10.0 ** np.floor(np.log10(step / 2))
    finer = max(factor * power for factor in (1, 2, 5) if factor * power <= step / 2 * (1 + 1e-9))
    return f"--resample {finer:.6g}s  puts them on one grid, on which every sample counts"


def gap_advice(step: float) -> str:
    """Help text for a grid with missing samples: `--max-gap` with a proposed longest gap.

    The proposed gap is three times `step`, the usual time between samples in seconds.
    """
    return (
        f"--max-gap {3 * step:.6g}s  keeps the grid and bridges gaps up to that; "
        "in longer ones signals are unknown, and what needs them is inconclusive"
    )


def read_clock(
    name: str, clock: NDArray[Any] | None, dt: float | None, samples: int, *, others: Iterable[str] = ()
) -> tuple[float, float, int]:
    """Return the time of the first sample and the time step in seconds, and the number of samples.

    Args:
        name: name of the trace, for messages.
        clock: recorded times in seconds, (samples,), or None.
        dt: recorded time step in seconds, or None; needed if there are fewer than two times.
        samples: number of samples, used if there are no times.
        others: names of the other arrays in the trace, for messages.

    Raises:
        TraceError: E601, neither times nor a time step; E602, times are not uniform; E605, no samples.
    """
    if dt is not None:
        require_step(name, dt)
    if clock is None:
        if dt is None:
            names = list(others)
            frames = [f"--fps 25  if `{name}` counts frames" for name in names if is_count_name(name)]
            help_ = (*frames[:1], NO_CLOCK, NO_STEP)
            known = ", ".join(names)
            note = (f"arrays in {name}: {known}",) if known else ()
            raise TraceError.of("E601", f"trace `{name}` has no `t`", help=help_, note=note)
        return 0.0, dt, samples
    if clock.ndim != 1:
        shape = " x ".join(map(str, clock.shape)) or "a single number"
        raise TraceError.of("E605", f"`t` in `{name}` is {shape}; it has one value per sample")
    times = clock.astype(np.float64, copy=False)
    check_finite(name, times)
    if len(times) == 1:
        if dt is None:
            raise TraceError.of("E602", f"trace `{name}` has one sample, so its time step is unknown")
        return float(times[0]), dt, 1
    step = _step(name, times, dt)
    require_step(name, step)
    return float(times[0]), step, len(times)


def require_step(name: str, dt: float) -> None:
    """Raise TraceError (E602) if a time step is invalid or out of range."""
    if not SHORTEST <= dt <= LONGEST:
        help_ = (f"time is in seconds, and a step at least {SHORTEST:g} s and at most {LONGEST:g} s",)
        raise TraceError.of("E602", f"the time step of `{name}` is {dt:g} s", help=help_)


def require_span(name: str, first: float, last: float) -> None:
    """Raise TraceError (E602) if the time between two samples is too long for a number."""
    if not math.isfinite(last - first):
        message = f"time in `{name}` runs from {first:g} s to {last:g} s, which is too long to be measured"
        raise TraceError.of("E602", message)


def check_finite(name: str, times: Floats) -> None:
    """Check the times of a trace, and the time between the earliest and the latest.

    Raises TraceError if there are no times (E605), if any of them is not finite (E604), or if they are too
    far apart (E602).
    """
    if not len(times):
        raise TraceError.of("E605", f"trace `{name}` has no samples")
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        raise TraceError.of("E604", f"time in `{name}` is {times[bad[0]]} at t[{bad[0]}]")
    require_span(name, float(times.min()), float(times.max()))


def _step(name: str, times: Floats, dt: float | None) -> float:
    _require_even(name, times)
    mean = float(times[-1] - times[0]) / (len(times) - 1)
    steps = np.arange(len(times), dtype=np.float64)
    steps *= mean
    drift = times - times[0]
    drift -= steps
    np.abs(drift, out=drift)
    if drift.max() > TOLERANCE * mean:
        i = int(np.argmax(drift))
        message = (
            f"time in `{name}` is not uniform: t[{i}] = {times[i]:.6g} s is {drift[i]:.3g} s beside the grid"
        )
        raise TraceError.of("E602", message, help=(resample_advice(mean),))
    return snapped(mean, dt)


def _require_even(name: str, times: Floats) -> None:
    gaps = np.diff(times)
    usual = usual_step(times)
    backwards = np.flatnonzero(gaps <= 0)
    if len(backwards):
        i = int(backwards[0])
        message = (
            f"time in `{name}` does not increase: t[{i}] = {times[i]:g} s, t[{i + 1}] = {times[i + 1]:g} s"
        )
        help_ = () if (gaps < 0).any() else (resample_advice(usual),)
        raise TraceError.of("E602", message, help=help_)
    odd = gaps - usual
    np.abs(odd, out=odd)
    if odd.max() > TOLERANCE * usual:
        raise TraceError(_uneven(name, times, gaps, usual))


def _uneven(name: str, times: Floats, gaps: Floats, usual: float) -> Diagnostic:
    i = int(np.argmax(np.abs(gaps - usual) > TOLERANCE * usual))
    steps = np.rint(gaps / usual)
    if (np.abs(gaps - steps * usual) <= TOLERANCE * usual).all() and (steps >= 1).all():
        holes = int((steps > 1).sum())
        more = f", the first of {holes} such gaps" if holes > 1 else ""
        message = (
            f"samples are missing in `{name}`: dt is {usual:.6g} s, and after t[{i}] = {times[i]:.6g} s "
            f"comes t[{i + 1}] = {times[i + 1]:.6g} s{more}"
        )
        return Diagnostic("E602", message, help=(gap_advice(usual),))
    message = (
        f"time in `{name}` is not uniform: dt is {usual:.6g} s except at t[{i}] = {times[i]:.6g} s, "
        f"where it is {gaps[i]:.6g} s"
    )
    return Diagnostic("E602", message, help=(resample_advice(usual),))


def snapped(step: float, dt: float | None = None) -> float:
    """Return a measured step as `dt` if that agrees with it, or as a nearby simple fraction."""
    if not (np.isfinite(step) and step > 0):
        return step
    if dt is not None and abs(dt - step) <= 1e-3 * step:
        return dt
    near = float(Fraction(step).limit_denominator(100_000))
    return near if abs(near - step) <= _SNAP * step else step
