"""Values of `T` and `dt` for a monitor: from its arguments, the trace, or the system that the spec names."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

from stlc.compile.frontend.interface import Interface
from stlc.compile.ir.discretize import Grid
from stlc.diagnostics import Diagnostic, TraceError, UsageError
from stlc.files import find_system
from stlc.grammar import ast
from stlc.trace import Trace, as_fraction

_SLACK = 1e-6


@dataclass(frozen=True, slots=True)
class Times:
    """A time step and a horizon, both in seconds and exact; None where unknown.

    `trace` names the file that the step was measured in, "" where it was given.
    """

    dt: Fraction | None = None
    horizon: Fraction | None = None
    trace: str = ""

    def or_else(self, other: Times) -> Times:
        """These times, with unknown ones taken from `other`."""
        step = self if self.dt is not None else other
        return Times(step.dt, self.horizon if self.horizon is not None else other.horizon, step.trace)

    @property
    def complete(self) -> bool:
        """True if both are known."""
        return self.dt is not None and self.horizon is not None

    def grid(self) -> Grid:
        """The time grid, in steps.

        Raises:
            TraceError: E602, the horizon is not a whole number of steps of a trace.
            UsageError: U101, it is not a whole number of the requested steps.
        """
        if self.dt is None or self.horizon is None:
            return Grid(self.dt, None)
        steps = self.horizon / self.dt
        whole = round(steps)
        if abs(steps - whole) > _SLACK * max(whole, 1):
            horizon, dt = float(self.horizon), float(self.dt)
            if self.trace:
                message = f"`{self.trace}` has dt {dt:g} s, and T = {horizon:g} s is no whole number of steps"
                raise TraceError(Diagnostic("E602", message, help=(_dividing(horizon, dt),)))
            message = f"the horizon {horizon:g} s is not a whole number of steps of {dt:g} s"
            raise UsageError(Diagnostic("U101", message))
        return Grid(self.dt, whole)


def _dividing(horizon: float, dt: float) -> str:
    """Advice: the largest short number of seconds up to the step that divides the horizon."""
    least = math.ceil(horizon / dt)
    short = (n for n in range(least, least + 1000) if math.isclose(float(f"{horizon / n:.4g}") * n, horizon))
    step = horizon / next(short, least)
    return f"--resample {step:.6g}s  puts the signals on a grid of which T is a whole number of steps"


def given_times(dt: float | Fraction | None, horizon: float | Fraction | None) -> Times:
    """The arguments of a monitor. Raises UsageError (U101) where they are not positive times."""
    for name, value in (("dt", dt), ("horizon", horizon)):
        if value is not None and not 0 < value < float("inf"):
            raise UsageError(Diagnostic("U101", f"{name} is a time in seconds above 0, not {value}"))
    return Times(None if dt is None else as_fraction(dt), None if horizon is None else as_fraction(horizon))


def system_of(name: str, spec: ast.Spec, overrides: Mapping[str, str]) -> tuple[Times, Interface]:
    """Times and interface of a system file, its functions loaded. Raises UsageError or SystemFileError."""
    from stlc.dynamics.declaration.load import load_system_decl
    from stlc.dynamics.robots.functions import load_functions

    decl = load_system_decl(find_system(name, Path(spec.source.name)), overrides)
    interface = replace(decl.interface(), functions=load_functions(decl))
    return Times(decl.dt, decl.dt * decl.horizon), interface


def named_times(spec: ast.Spec, overrides: Mapping[str, str]) -> Times | None:
    """Times of the system that the specification names; None without one, or without its file."""
    from stlc.dynamics.declaration.load import load_system_decl

    if spec.system is None:
        return None
    try:
        path = find_system(spec.system, Path(spec.source.name))
    except UsageError:
        return None
    decl = load_system_decl(path, overrides)
    return Times(decl.dt, decl.dt * decl.horizon)


def recorded_times(trace: Trace, asked: Times) -> Times:
    """Times of a trace. Raises TraceError (E602) where they contradict the monitor's time step."""
    dt = as_fraction(trace.dt)
    if asked.dt is not None and abs(asked.dt - dt) > Fraction(1, 1000) * dt:
        message = f"`{trace.name}` has dt {float(dt):g} s, the monitor was told {float(asked.dt):g} s"
        raise TraceError(Diagnostic("E602", message))
    horizon = trace.meta.horizon
    return Times(dt, None if horizon is None else horizon * dt, trace.name)
