"""Requirements for training: the formula that every plan must satisfy, and the states added for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

from stlc.compile.augment.lift import hoist_absolute
from stlc.compile.augment.mission import (
    Absolute,
    AbsoluteOp,
    Goal,
    GoalBranch,
    GoalLeaf,
    possible,
    progress,
    update,
)
from stlc.compile.augment.nested import TooFarError, in_past_form
from stlc.compile.augment.past import Past
from stlc.compile.augment.timers import Timer, TimerTable, cited, tolerant
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.normal_form import condition, normal
from stlc.diagnostics import Diagnostic, tell
from stlc.source import Span


@dataclass(frozen=True, slots=True)
class Augmented:
    """Requirement rewritten for training.

    Attributes:
        formula: formula that every plan must satisfy.
        alive: formula over the current state that becomes false once the mission up to now has falsified the
            requirement.
        goal: absolute formulas of the requirement, joined by `and` and `or`; None if there are none. An
            absolute formula is, for example, `always@[a, b] p`, whose interval counts from the start of the
            mission.
    """

    formula: typed.Formula
    alive: typed.Formula
    goal: Goal | None


def augment(
    requirement: typed.Requirement,
    grid: Grid,
    table: TimerTable,
    sink: list[Diagnostic],
    *,
    recurs: bool = False,
) -> Augmented:
    """Rewrite the formula of a requirement for training; add the states that it needs to `table`.

    Absolute operators (`always@[a, b]` and its like) have an interval that counts from the start of the
    mission. `grid` is the time step and the horizon. `recurs`: whether the requirement is one on every window
    of a mission, so that an `always@` is required at later samples even if it was violated.

    Findings are appended to `sink`: E307 for an absolute
    operator that cannot be moved out of the operators around it, E309 for a past operator that no timer
    represents, E310 for an absolute operator whose operands look too far into the future, E311 for an unknown
    horizon, E312 for `eventually@` or `until@` without a deadline.
    """
    formula = requirement.formula
    always = typed.Truth(formula.span, True)
    if not formula.absolute and not formula.looks_back:
        return Augmented(formula, always, None)
    past = Past(grid, table, sink, requirement.name)
    if not formula.absolute:
        return Augmented(past.rewrite(normal(formula)), always, None)
    if grid.steps is None:
        reason = "an absolute interval is planned for window by window, and no planning horizon is known here"
        help_ = 'name the system (`system "…"` in the file, or --system), or give dt and the horizon'
        tell(sink, Diagnostic("E311", reason, formula.span, help=(help_,)))
        return Augmented(always, always, None)
    try:
        flat = in_past_form(hoist_absolute(normal(formula), sink), grid, table, sink)
    except TooFarError as problem:
        tell(sink, _looks_ahead(problem.span, str(problem)))
        return Augmented(always, always, None)
    plain = past.rewrite(flat)
    goal = _Goals(grid, table, sink, requirement.name, recurs).of(plain)
    asked = progress(goal, grid.steps, again=recurs or "safety" in requirement.tags)
    return Augmented(asked, possible(goal), goal)


@final
@dataclass(frozen=True, slots=True)
class _Goals:
    """Builder of a requirement's goal: its absolute formulas (`always@[a, b] p`), joined by `and` and `or`.

    For each absolute formula, its status (an added state: open, true or false) and the mission clock are
    added to `table`.
    """

    grid: Grid
    table: TimerTable
    sink: list[Diagnostic]
    name: str
    recurs: bool

    def of(self, node: typed.Formula) -> Goal:
        """Return the goal of a formula that is evaluated at the start of the mission.

        The goal consists of absolute formulas (`always@[a, b] p`), joined by `and` and `or`. The formula
        `node` has no past operators. Its relative operators become absolute ones: at the first sample,
        relative time and mission time are equal. E310 or E312 is appended to `sink` for a formula that is not
        supported.
        """
        if node.is_state(augmented=True):
            return self._leaf(node, "always", ir.Window(0, 0), (typed.Truth(node.span, True), node))
        match node:
            case typed.Logic(span, "and" | "or" as op, items):
                return GoalBranch(op, tuple(map(self.of, items)), span)
            case typed.Temporal(_, "always" | "eventually" as op, interval, body):
                window = self.grid.window(interval, self.sink, outward=op == "always")
                return self._leaf(node, op, window, (typed.Truth(node.span, True), body))
            case typed.Until(_, "until" | "release" as op, interval, left, right):
                window = self.grid.window(interval, self.sink, outward=op == "release")
                return self._leaf(node, op, window, (left, right))
            case _:
                tell(self.sink, _looks_ahead(node.span))
                return self.of(typed.Truth(node.span, True))

    def _leaf(
        self,
        node: typed.Formula,
        op: AbsoluteOp,
        window: ir.Window,
        operands: tuple[typed.Formula, typed.Formula],
    ) -> Goal:
        last = (window.lo if window.hi is None else window.hi) + (self.grid.steps or 0) + 1
        if self.recurs and op == "always":
            truth = ir.Truth(True)
            asked = Absolute(op, window, node.span, *operands, truth, truth, truth)
            return GoalLeaf(asked, None, self.table.clock(last))
        for body in operands:
            if not body.is_state(augmented=True):
                tell(self.sink, _looks_ahead(body.span))
                return self.of(typed.Truth(node.span, True))
        if window.hi is None and op in ("eventually", "until"):
            tell(self.sink, _without_deadline(node.span))
        left, right = (condition(body.timer_form(), flat=True) for body in operands)
        formula = Absolute(op, window, node.span, *operands, tolerant(left), tolerant(right), right)
        clock = self.table.clock(last)
        draft = Timer(self.name, "status", 0.0, ir.Const(0.0), -1.0, 1.0, _about(formula))
        return GoalLeaf(formula, self.table.add(draft, update(formula, clock)), clock)


_LATCHED: Mapping[AbsoluteOp, str] = {
    "always": "false where {right} fails",
    "eventually": "true where {right} holds",
    "until": "true where {right} holds, false where {left} fails before",
    "release": "true where {left} holds, false where {right} fails before",
}
"""Absolute operator -> text of the condition that decides its status."""


def _about(formula: Absolute) -> str:
    """Return the text that describes the status of an absolute formula: open (undecided), true or false.

    The text says which condition decides the status for the rest of the mission.
    """
    left, right = cited(formula.left), cited(formula.right)
    window = formula.window
    if formula.right.span == formula.left.span:  # rewritten, with no text of its own
        return f"open | true | false  what is known of {right}"
    if window == ir.Window(0, 0):
        return f"open | true | false  {right} at the start of the mission"
    end = "end" if window.hi is None else window.hi
    latched = _LATCHED[formula.op].format(left=left, right=right)
    return f"open | true | false  {latched}, samples {window.lo}..{end} of the mission"


def _looks_ahead(span: Span, why: str = "not about one instant of the mission") -> Diagnostic:
    return Diagnostic(
        "E310",
        "an absolute operator over more of the future than states can hold",
        span,
        why,
        help=(
            "end the windows inside, and make those shorter that do not begin now",
            "`stlc check` judges this one as it is",
        ),
    )


def _without_deadline(span: Span) -> Diagnostic:
    return Diagnostic(
        "E312",
        "an absolute goal without a deadline cannot be trained for",
        span,
        "no finite mission can break it",
        help=("give its interval an end, such as `eventually@[0 s, 60 s]`",),
    )
