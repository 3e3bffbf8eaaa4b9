"""Horizon `T` and time step `dt` of a monitor: from arguments, from the trace, or from a system file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from stlc.compile.frontend.interface import Interface
from stlc.compile.ir.discretize import Grid
from stlc.diagnostics import Diagnostic, TraceError, UsageError
from stlc.files import find_system
from stlc.grammar import ast
from stlc.trace import Trace, as_fraction

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

    @property
    def complete(self) -> bool:
        """True if time step and horizon are known."""
        return self.dt is not None and self.horizon is not None

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
                message = f"`{self.trace}` has dt {dt:g} s, and T = {horizon:g} s is no whole number of steps"
                raise TraceError(Diagnostic("E602", message, help=(_dividing(horizon, dt),)))
            message = f"the horizon {horizon:g} s is not a whole number of steps of {dt:g} s"
            raise UsageError(Diagnostic("U101", message))
        return Grid(self.dt, whole)


def _dividing(horizon: float, dt: float) -> str:
    """Help text that proposes a time step that fits into the horizon a whole number of times.

    `horizon` and `dt` are in seconds. The proposed step has four digits and is at most `dt`.
    """
    least = math.ceil(horizon / dt)
    short = (n for n in range(least, least + 1000) if math.isclose(float(f"{horizon / n:.4g}") * n, horizon))
    step = horizon / next(short, least)
    return f"--resample {step:.6g}s  puts the signals on a grid of which T is a whole number of steps"


def given_times(dt: float | Fraction | None, horizon: float | Fraction | None) -> Times:
    """Convert `dt` and `horizon`, in seconds, to exact times.

    Raises UsageError (U101) if either of them is not positive.
    """
    for name, value in (("dt", dt), ("horizon", horizon)):
        if value is not None and not 0 < value < float("inf"):
            raise UsageError(Diagnostic("U101", f"{name} is a time in seconds above 0, not {value}"))
    return Times(None if dt is None else as_fraction(dt), None if horizon is None else as_fraction(horizon))


def _declared(name: str, spec: ast.Spec, overrides: Mapping[str, str]) -> tuple[Times, SystemDecl]:
    from stlc.dynamics.declaration.load import load_system_decl

    decl = load_system_decl(find_system(name, Path(spec.source.name)), overrides)
    return Times(decl.dt, decl.dt * decl.horizon), decl


def system_of(name: str, spec: ast.Spec, overrides: Mapping[str, str]) -> tuple[Times, Interface]:
    """Return what the system file `name` declares: time step and horizon, and signals and functions.

    `spec` is the specification; its location is used to find the file. `overrides` maps the names of
    constants to their new values, as text.

    Raises:
        UsageError: U102, there is no such file.
        SystemFileError: the file is invalid.
    """
    from stlc.dynamics.robots.functions import load_functions

    times, decl = _declared(name, spec, overrides)
    return times, replace(decl.interface(), functions=load_functions(decl))


def named_times(spec: ast.Spec, overrides: Mapping[str, str]) -> Times | None:
    """Return time step and horizon of the system that the specification `spec` names.

    None if it names no system, or if the system file is not found. `overrides` maps the names of constants to
    their new values, as text.
    """
    if spec.system is None:
        return None
    try:
        find_system(spec.system, Path(spec.source.name))
    except UsageError:
        return None
    return _declared(spec.system, spec, overrides)[0]


def recorded_times(trace: Trace, given: Times) -> Times:
    """Return the time step and the horizon of a trace.

    Raises TraceError (E602) if the time step of the trace differs from the time step in `given`.
    """
    dt = as_fraction(trace.dt)
    if given.dt is not None and abs(given.dt - dt) > Fraction(1, 1000) * dt:
        message = f"`{trace.name}` has dt {float(dt):g} s, the monitor was told {float(given.dt):g} s"
        raise TraceError(Diagnostic("E602", message))
    horizon = trace.meta.horizon
    return Times(dt, None if horizon is None else horizon * dt, trace.name)
