"""Requirements that are due later than a plan from the start of the mission reaches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
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
        late = max(
            _late(rule.typed, compiled.grid), key=lambda each: (each.seconds, each.recurs), default=None
        )
        if late is not None:
            found.append(late)
    return tuple(found)


def beyond_plans(compiled: Compiled) -> Iterator[Diagnostic]:
    """Yield W316 for requirements that are due later than a plan reaches, and that nothing bridges.

    What is due once is bridged: plans may reach to the end of a mission, and a guidance cost drives them
    towards later goals. So is `always@[a, end] once[0, c] p`. Anything else that is due again and again is
    planned for window by window.
    """
    guided = {node.span for rule in compiled.requirements for node in _guided(rule.typed.formula)}
    reach = time_text((compiled.grid.dt or 0) * (compiled.grid.steps or 0))
    for late in unreached(compiled):
        if late.recurs and late.span not in guided:
            due = time_text(late.seconds)
            yield Diagnostic(
                "W316",
                f"`{late.requirement}` is due within {due}, again and again, and plans end after {reach}",
                late.span,
                label="no plan sees this from where it begins",
                help=(f"a horizon of {due} or more, `--set time.horizon=…`, or an earlier deadline",),
            )


def _guided(formula: typed.Formula) -> Iterator[typed.Formula]:
    """Yield the operators `once[0, c]` towards which the compiler guides plans again and again.

    They stand in `always@[a, end] once[0, c] p`, or in a conjunction in the place of `once`.
    """
    for item in formula.joined_by("and"):
        yield from _guided(item)
    if formula.word == "always" and formula.on_clock and formula.ahead and formula.ahead.hi is None:
        (body,) = formula.operands
        yield from (part for part in body.joined_by("and") or (body,) if part.word == "once")


def _late(rule: typed.Requirement, grid: Grid) -> Iterator[Unreached]:
    """Yield the operators of a requirement that are due later than a plan reaches."""
    if grid.dt is None or grid.steps is None:
        return
    for node in rule.formula.temporals():
        if node.op in ("eventually", "once", "until"):
            step = grid.window(node.interval, [], outward=False).hi
        elif node.op == "always" and node.on_clock:
            step = grid.window(node.interval, [], outward=True).lo
        else:
            continue
        if step is not None and step > grid.steps:
            yield Unreached(rule.name, float(step * grid.dt), not node.on_clock, node.span)
