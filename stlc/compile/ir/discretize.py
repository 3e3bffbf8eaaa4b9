"""Discretization of time: from seconds to whole samples for windows and delays, on a time grid.

An interval covers the samples inside it. A bound between two samples is rounded conservatively, so that
satisfaction on the samples implies the formula as written: outwards for `always` and `release`, inwards for
`eventually` and `until`, in negation normal form. W304 reports each rounded bound.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.lower import lower
from stlc.diagnostics import Diagnostic, tell
from stlc.jsontext import Num
from stlc.source import Span
from stlc.units import nearest, time_text

MAX_STEPS = 10**12
"""Limit of bounds in steps: longer than any trace, and sums still fit into 64 bits."""

MAX_DELAY = 1_000_000
"""Limit of `shift` in samples."""

_EMPTY = ir.Window(0, 0)
"""Placeholder window after a reported error."""


@dataclass(frozen=True, slots=True)
class Horizon:
    """Length of a time window."""

    seconds: Num
    steps: int


@dataclass(frozen=True, slots=True)
class Grid:
    """Time grid: step `dt` in seconds and horizon (`T`) in steps; None where unknown.

    Attributes:
        dt: time step in seconds.
        horizon: value of `T` in steps.
        plan: steps of a plan, if it is longer than the horizon.
        end: last step of the mission, after which nothing is required; None if it does not end, or if plans
            do not regard its end.
    """

    dt: Fraction | None = None
    horizon: int | None = None
    plan: int | None = None
    end: int | None = None

    @property
    def steps(self) -> int | None:
        """Steps of a plan; None where unknown."""
        return self.horizon if self.plan is None else self.plan

    def lacks(self, formula: typed.Formula) -> bool:
        """True if a formula needs a time step or a horizon that the grid does not have."""
        return any(
            (time.seconds and self.dt is None) or (time.horizons and self.horizon is None)
            for time in formula.times()
        )

    def window(self, interval: typed.Interval, sink: list[Diagnostic], *, outward: bool) -> ir.Window:
        """Return the window of an interval, in steps.

        Args:
            interval: interval whose bounds are sums of seconds, steps and horizons.
            sink: list to which findings are appended: W304 for a rounded bound, E305 for an interval without
                a sample, E311 for an unknown time step or horizon, E301, E302 and E005 for an invalid
                interval. After an error the returned window is only a placeholder.
            outward: whether bounds between two samples are rounded outwards; else inwards.
        """
        lo = self.in_steps(interval.lo, sink, interval.span)
        if lo is None:
            return _EMPTY
        hi = None if interval.hi is None else self.in_steps(interval.hi, sink, interval.span)
        if hi is None and interval.hi is not None:
            return _EMPTY
        invalid = _invalid(interval, lo, hi)
        if invalid is not None:
            tell(sink, invalid)
            return _EMPTY
        first = _first(lo, outward=outward, excluded=interval.lo_open)
        _note_rounding(interval.lo, lo, first, self, sink)
        if hi is None or interval.hi is None:
            return ir.Window(first, None)
        last = -_first(-hi, outward=outward, excluded=interval.hi_open)
        _note_rounding(interval.hi, hi, last, self, sink)
        if last < first:
            tell(sink, _without_sample(interval, self))
            return _EMPTY
        return ir.Window(first, last)

    def in_steps(self, time: typed.Time, sink: list[Diagnostic], span: Span | None) -> Fraction | None:
        """Return a time in steps.

        The result is None, with E311 in `sink`, if the grid lacks a step or horizon that the time needs.
        """
        span = time.span or span
        if time.horizons and self.horizon is None:
            tell(sink, _needs_grid("`T` is the planning horizon of a system", span))
            return None
        if time.seconds and self.dt is None:
            tell(sink, _needs_grid("seconds become samples with the step `dt` of a system", span))
            return None
        seconds = time.seconds / self.dt if self.dt is not None else Fraction(0)
        return seconds + time.steps + time.horizons * (self.horizon or 0)

    def duration(self, steps: int) -> str:
        """Text of a number of steps, such as `2.5 s = 25 steps`; `25 steps` if no time step is known."""
        count = f"{steps} step{'' if steps == 1 else 's'}"
        return count if self.dt is None else f"{self.in_words(Fraction(steps))} = {count}"

    def in_words(self, steps: Fraction) -> str:
        """Return the text of a time for messages: in steps if no time step is known."""
        if self.dt is None:
            return f"{nearest(steps):g} steps"
        return time_text(steps * self.dt)

    def in_samples(self, formula: typed.Formula, sink: list[Diagnostic]) -> typed.Formula:
        """Return a formula with the delays of `shift` converted from seconds to samples.

        Findings are appended to `sink`: E205 for a delay that is too long or not a whole number of samples,
        E311 for an unknown time step or horizon. A delay with an error is replaced by one sample.
        """

        def leaf(num: ir.Num) -> ir.Num:
            if not isinstance(num, typed.DelayedSignal):
                return num
            steps = num.steps + _samples(num.delay, self, sink)
            return ir.ShiftedSignal(num.name, steps, num.clamped) if steps else ir.Signal(num.name)

        def below(node: typed.Formula) -> typed.Formula:
            node = node.map_children(formulas=below, numbers=lambda num: num.map_leaves(leaf))
            if isinstance(node, typed.Shift) and node.delay is not None:
                return replace(node, steps=_samples(node.delay, self, sink), delay=None)
            return node

        return below(formula)

    def delay_fault(self, steps: Fraction, span: Span | None) -> Diagnostic | None:
        """Return the error E205 if a delay is no whole number of steps or exceeds `MAX_DELAY`, else None."""
        if steps.denominator != 1 and self.dt is not None:
            low, high = (self.in_words(Fraction(n)) for n in (math.floor(steps), math.ceil(steps)))
            message = f"{self.in_words(steps)} is not a whole number of {float(self.dt):g} s steps"
            help_ = (f"use {low} or {high}, or a dt that fits",)
            return Diagnostic("E205", message, span, "there is no sample at this time", help=help_)
        if steps.denominator != 1:
            return no_delay("`shift` goes a whole number of samples, known at compile time", span)
        if abs(steps) > MAX_DELAY:
            return no_delay(f"`shift` goes {MAX_DELAY:,} samples at most", span)
        return None

    def lower(self, formula: typed.Formula, sink: list[Diagnostic]) -> ir.Formula:
        """Lower a typed formula to an IR formula (`stlc.compile.ir.lower`)."""
        return lower(formula, self, sink)


# ------------------------------------------------------------------------------------ windows


def _first(lo: Fraction, *, outward: bool, excluded: bool) -> int:
    """Return the first sample inside an interval that starts at `lo` (in steps).

    If `lo` lies between two samples, this is the earlier one if `outward`, else the later one. A sample at
    `lo` is skipped if `excluded`.
    """
    if lo.denominator != 1:
        return math.floor(lo) if outward else math.ceil(lo)
    return int(lo) + 1 if excluded else int(lo)


def _invalid(interval: typed.Interval, lo: Fraction, hi: Fraction | None) -> Diagnostic | None:
    """Return the error of an invalid interval, or None.

    E301 is an interval that ends before it starts, E302 one that starts before the present sample, E005 one
    of more than `MAX_STEPS` steps.
    """
    if lo < 0:
        text, span = "an interval starts before now", interval.lo.span or interval.span
        return Diagnostic("E302", text, span, label=f"{nearest(lo):g} steps")
    if hi is not None and hi < lo:
        label = f"from {nearest(lo):g} to {nearest(hi):g} steps"
        return Diagnostic("E301", "the interval ends before it starts", interval.span, label=label)
    if max(lo, hi or 0) > MAX_STEPS:
        text, help_ = (
            f"an interval of more than {MAX_STEPS:,} steps",
            ("`inf` means to the end of the trace",),
        )
        return Diagnostic("E005", text, interval.span, help=help_)
    return None


def _note_rounding(time: typed.Time, exact: Fraction, taken: int, grid: Grid, sink: list[Diagnostic]) -> None:
    if exact.denominator == 1:
        return
    below, above = math.floor(exact), math.ceil(exact)
    finding = Diagnostic(
        "W304",
        f"{grid.in_words(exact)} is not a whole number of {_step(grid)}",
        time.span,
        label=f"taken as {grid.in_words(Fraction(taken))} here",
        help=(
            f"use {grid.in_words(Fraction(below))} or {grid.in_words(Fraction(above))}, or a dt that fits",
        ),
        note=("`always` and `release` also take the sample outside, `eventually` and `until` do not",),
    )
    tell(sink, finding)


def _step(grid: Grid) -> str:
    return "steps" if grid.dt is None else f"{float(grid.dt):g} s steps"


def _without_sample(interval: typed.Interval, grid: Grid) -> Diagnostic:
    return Diagnostic(
        "E305",
        "no sample lies in this interval",
        interval.span,
        label=f"samples are {_step(grid)} apart".replace(" steps apart", " apart"),
        help=("make it longer, or close its ends",),
    )


def _needs_grid(text: str, span: Span | None) -> Diagnostic:
    return Diagnostic(
        "E311",
        f"{text}, and none is known here",
        span,
        help=('name the system (`system "…"` in the file, or --system), or give dt and the horizon',),
    )


# ------------------------------------------------------------------------------------- delays


def _samples(delay: typed.Time, grid: Grid, sink: list[Diagnostic]) -> int:
    steps = grid.in_steps(delay, sink, delay.span)
    if steps is None:
        return 1
    finding = grid.delay_fault(steps, delay.span)
    if finding is not None:
        tell(sink, finding)
        return 1
    return int(steps)


def no_delay(message: str, span: Span | None) -> Diagnostic:
    """Return the error E205, with `message`, for a `shift` by an invalid number of samples."""
    help_ = ("shift(x, 2) is x two samples later, shift(x, -0.1 s) what it was a tenth of a second before",)
    return Diagnostic("E205", message, span, help=help_)
