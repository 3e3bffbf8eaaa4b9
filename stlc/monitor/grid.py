"""Horizon `T` and time step `dt` of a monitor: from arguments, from the trace, or from a system file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING

from stlc.compile.frontend.interface import Interface
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import CompiledRequirement
from stlc.diagnostics import TraceError, UsageError, usage
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.source import Source
from stlc.trace import Trace, as_fraction
from stlc.trace.time_grid import LONGEST

if TYPE_CHECKING:
    from stlc.dynamics.declaration.decl import SystemDecl

_SLACK = 1e-6


@dataclass(frozen=True, slots=True)
class Times:
    """Time step and horizon in seconds, as exact fractions; None if unknown.

    `trace` is the name of the trace file that supplied the time step; "" if another source did.
    """

    dt: Fraction | None = None
    horizon: Fraction | None = None
    trace: str = ""

    def or_else(self, other: Times) -> Times:
        """Return a copy in which an unknown time step or horizon is taken from `other`."""
        step = self if self.dt is not None else other
        return Times(step.dt, self.horizon if self.horizon is not None else other.horizon, step.trace)

    def grid(self) -> Grid:
        """Return the time grid, with the horizon in steps.

        Raises:
            TraceError: E602, the horizon is not a whole number of time steps of the trace.
            UsageError: U101, the horizon is not a whole number of the given time steps.
        """
        if self.dt is None or self.horizon is None:
            return Grid(self.dt, None)
        steps = self.horizon / self.dt
        whole = round(steps)
        if abs(steps - whole) > _SLACK * max(whole, 1):
            horizon, dt = float(self.horizon), float(self.dt)
            if self.trace:
                least = math.ceil(horizon / dt)
                counts = range(least, least + 1000)  # the step in the help has four digits, if one fits
                fits = (n for n in counts if math.isclose(float(f"{horizon / n:.4g}") * n, horizon))
                finer = f"--resample {horizon / next(fits, least):.6g}s"
                help_ = (f"{finer}  puts the signals on a grid of which T is a whole number of steps",)
                message = f"`{self.trace}` has dt {dt:g} s, and T = {horizon:g} s is no whole number of steps"
                raise TraceError.of("E602", message, help=help_)
            message = f"the horizon {horizon:g} s is not a whole number of steps of {dt:g} s"
            raise usage(message)
        return Grid(self.dt, whole)


def given_times(dt: float | Fraction | None, horizon: float | Fraction | None) -> Times:
    """Exact times of `dt` and `horizon` in seconds. Raises UsageError (U101) if one is not positive."""
    for name, value in (("dt", dt), ("horizon", horizon)):
        if value is not None and not 0 < value < float("inf"):
            raise usage(f"{name} is a time in seconds above 0, not {value}")
    return Times(None if dt is None else as_fraction(dt), None if horizon is None else as_fraction(horizon))


def _declared(name: str | Source, spec: Spec, overrides: Mapping[str, str]) -> tuple[Times, SystemDecl]:
    from stlc.dynamics.load import load_system_decl

    found = name if isinstance(name, Source) else File(name).system(spec.source.name)
    decl = load_system_decl(found, overrides)
    return Times(decl.dt, decl.dt * decl.horizon), decl


def system_of(name: str | Source, spec: Spec, overrides: Mapping[str, str]) -> tuple[Times, Interface]:
    """Return what the system file `name` declares: time step and horizon, and signals and functions.

    The file is searched for beside the specification. `overrides`: name of a constant -> its value, as text.

    Raises:
        UsageError: U102, there is no such file.
        SystemFileError: the file is invalid.
    """
    from stlc.dynamics.functions import load_functions

    times, decl = _declared(name, spec, overrides)
    return times, replace(decl.interface(), functions=load_functions(decl))


def named_times(spec: Spec, overrides: Mapping[str, str]) -> Times | None:
    """Time step and horizon of the system that a specification names; None without one or without its file.

    None also for a specification that was stored with a run or a trace, and is not beside its files.

    `overrides`: name of a constant -> its value, as text.
    """
    if spec.system is None or spec.library is not None:
        return None
    try:
        File(spec.system).system(spec.source.name)
    except UsageError:
        return None
    return _declared(spec.system, spec, overrides)[0]


def require_windows(trace: Trace, rules: Sequence[CompiledRequirement]) -> None:
    """Check the windows of requirements against the step of a trace.

    Raises:
        TraceError: E602, a window is shorter than a step, and so checks nothing; E607, a step is so long, and
            windows hold so few, that the clock hardly counts seconds.
    """
    for rule in rules:
        for node in rule.typed.formula.temporals():
            if node.interval.hi is None:
                continue
            last, length = node.interval.hi, float(node.interval.hi.seconds)
            if last.steps or last.horizons or not 0.0 < length < trace.dt * (1.0 - _SLACK):
                continue
            name, unit = _clock_name(trace), _finer(trace.dt, length)
            message = (
                f"`{trace.name}` has a sample every {trace.dt:.6g} s by its clock `{name}`, "
                f"and a window of {length:.6g} s has none but its first"
            )
            help_ = (
                f"--clock {name}:{unit}  if the clock is in {unit}, not in seconds",
                f"--resample {length / 10:.3g}s  judges on a finer grid",
            )
            span = node.interval.span or last.span or rule.span
            raise TraceError.of("E602", message, span, help=help_)
    _require_seconds(trace, rules)


_SCALES = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_LONG, _WIDE = 100.0, 100.0
"""Seconds of a step from which it may count no seconds, and steps of a window from which it does."""


def _clock_name(trace: Trace) -> str:
    return next((clock.name for clock in trace.clocks), "t")


def _finer(step: float, length: float) -> str:
    """Unit of time in which a step is not longer than `length` seconds."""
    return next((unit for unit, scale in _SCALES.items() if step * scale <= length), "ms")


def _require_seconds(trace: Trace, rules: Sequence[CompiledRequirement]) -> None:
    """Raise TraceError (E607) if a clock without a unit has steps that are long beside all windows.

    Steps of whole minutes up to an hour, hours up to a day, and days are usual.
    """
    step, spans = trace.dt, ((60.0, 3600.0), (3600.0, 86400.0), (86400.0, LONGEST))
    usual = step < _LONG or any(step % unit == 0.0 and step <= most for unit, most in spans)
    if usual or not trace.clocks or any(clock.unit for clock in trace.clocks):
        return
    intervals = (node.interval for rule in rules for node in rule.typed.formula.temporals())
    bounds = [each.hi for each in intervals if each.hi is not None and not each.hi.horizons]
    longest = max(bounds, key=lambda each: each.seconds, default=None)
    if longest is None or not 0.0 < float(longest.seconds) < _WIDE * step:
        return
    name, length = _clock_name(trace), float(longest.seconds)
    unit = _finer(step, length / 10.0)
    message = (
        f"is the clock `{name}` of `{trace.name}` in seconds? "
        f"Its step of {step:.6g} is long beside {length:.6g} s"
    )
    help_ = (f"--clock {name}:{unit}  if it is in {unit}", f"--clock {name}:s  if it is in seconds")
    raise TraceError.of("E607", message, longest.span, help=help_)


def agreed_times(name: str, step: float, horizon: int | None, given: Times) -> Times:
    """Times of recorded signals, from their time step in seconds and their horizon in steps.

    Raises TraceError (E602) if the time step differs from that in `given`.
    """
    dt = as_fraction(step)
    if given.dt is not None and abs(given.dt - dt) > Fraction(1, 1000) * dt:
        message = f"`{name}` has dt {float(dt):g} s, the monitor was told {float(given.dt):g} s"
        raise TraceError.of("E602", message)
    return Times(dt, None if horizon is None else horizon * dt, name)
