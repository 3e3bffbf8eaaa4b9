"""Requirements on a whole mission, from requirements on the window of a plan.

A requirement that mentions the horizon `T` holds on a mission of n samples if it holds at every sample from
which T steps are left, and any other requirement if it holds at the first one. Both are absolute formulas:
`always@[0, n - T] p`, and `p` with its intervals counted from the start of the mission. So a plan that
reaches to the end of the mission is asked for what the mission is judged by, and for nothing beyond its end.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid


def over_mission(formula: typed.Formula, grid: Grid) -> typed.Formula:
    """Return the absolute formula that a mission satisfies if the requirement `formula` holds on it.

    The mission has `grid.end` steps. Requirements with absolute operators are returned unchanged.
    """
    if formula.absolute:
        return formula
    end = typed.Time(steps=Fraction(grid.end or 0))
    if not formula.mentions_horizon:
        return _from_start(formula, end)
    return _at_starts(formula, typed.Time(steps=max(end.steps - (grid.horizon or 0), Fraction(0))), end)


def _from_start(formula: typed.Formula, end: typed.Time) -> typed.Formula:
    """Return a formula whose outermost temporal operators count from the start of the mission."""
    match formula:
        case typed.Logic(_, "and" | "or", items):
            return replace(formula, items=tuple(_from_start(item, end) for item in items))
        case typed.Temporal(_, "always" | "eventually", interval) | typed.Until(_, _, interval):
            return replace(formula, interval=replace(interval, hi=interval.hi or end, clock="start"))
        case _:
            now = typed.Interval(typed.Time(), typed.Time(), clock="start", span=formula.span)
            return typed.Temporal(formula.span, "always", now, formula)


def _at_starts(formula: typed.Formula, starts: typed.Time, end: typed.Time) -> typed.Formula:
    """Return a formula that holds if `formula` holds at all samples up to `starts`.

    An `always` at these samples is one `always` over all its windows.
    """
    match formula:
        case typed.Logic(_, "and", items):
            return replace(formula, items=tuple(_at_starts(item, starts, end) for item in items))
        case typed.Temporal(_, "always", interval):
            last = end if interval.hi is None else interval.hi.plus(starts)
            return replace(formula, interval=replace(interval, hi=last, clock="start"))
        case _:
            window = typed.Interval(typed.Time(), starts, clock="start", span=formula.span)
            return typed.Temporal(formula.span, "always", window, formula)
