"""Requirements that are due later than a plan from the start of the mission reaches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid, to_window
from stlc.compile.ir.traverse import nodes
from stlc.diagnostics import Diagnostic
from stlc.units import time_text

if TYPE_CHECKING:
    from stlc.compile.pipeline import Compiled
    from stlc.source import Span


@dataclass(frozen=True, slots=True)
class Unreached:
    """Requirement that is due later than a plan reaches.

    Attributes:
        requirement: its name.
        seconds: time from the start of the mission at which it is due. If it recurs, the time within which it
            is due, again and again.
        recurs: whether the time counts from any sample, as in `once[0, c]`, instead of from the start.
        span: source location of the operator that sets the time.
    """

    requirement: str
    seconds: float
    recurs: bool
    span: Span


def unreached(compiled: Compiled) -> tuple[Unreached, ...]:
    """Requirements that are due later than a plan reaches, each with the latest time at which it is due.

    `eventually@[a, b]` and `until@[a, b]` are due at b, `always@[a, b]` at a. `once[0, c]` recurs, and so
    does `eventually[0, c]` in an absolute operator: each is due within c. What is due before a plan from the
    start of the mission ends is not returned.
    """
    found = []
    for rule in compiled.requirements:
        late = max(_late(rule.typed, compiled.grid), key=lambda each: each.seconds, default=None)
        if late is not None:
            found.append(late)
    return tuple(found)


def beyond_plans(compiled: Compiled) -> Iterator[Diagnostic]:
    """Yield W316 for requirements that are due later than a plan reaches, and that nothing bridges.

    A mission with an end is bridged: its plans may reach to the end. A mission without an end, and what is
    due again and again, is planned for window by window.
    """
    ends = compiled.mission is not None and compiled.recurring is None
    reach = time_text((compiled.grid.dt or 0) * (compiled.grid.horizon or 0))
    for late in unreached(compiled):
        if ends and not late.recurs:
            continue
        due = time_text(late.seconds)
        when = f"within {due}, again and again" if late.recurs else f"at {due}"
        yield Diagnostic(
            "W316",
            f"`{late.requirement}` is due {when}, and plans end after {reach}",
            late.span,
            label="no plan from the start sees this",
            help=(f"a horizon of {due} or more, `--set time.horizon=…`, or an earlier deadline",),
        )


def _late(rule: typed.Requirement, grid: Grid) -> Iterator[Unreached]:
    """Yield the operators of a requirement that are due later than a plan reaches."""
    if grid.dt is None or grid.horizon is None:
        return
    for node in nodes(rule.formula):
        match node:
            case typed.Temporal(_, "eventually" | "once", interval) | typed.Until(_, "until", interval):
                step = to_window(interval, grid, [], outward=False).hi
            case typed.Temporal(_, "always", interval) if interval.clock == "start":
                step = to_window(interval, grid, [], outward=True).lo
            case _:
                continue
        if step is not None and step > grid.horizon:
            yield Unreached(rule.name, float(step * grid.dt), interval.clock == "now", node.span)
