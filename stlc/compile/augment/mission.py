"""Absolute formulas such as `always@[a, b] p`, and the formulas that plans must satisfy because of them.

The interval of an absolute formula counts from the start of the mission. The compiler adds a state that holds
the formula's status: open (undecided), true or false. Once true or false, it stays so.

Progression turns the absolute formula into one that a plan must satisfy: the samples up to the plan's end
must not falsify the absolute formula. An open formula is evaluated over the horizon and assumed satisfiable
beyond it. If every plan made during a mission satisfies the progressed formula, the executed trace satisfies
the absolute formula. This also holds for any combination of absolute formulas by `and`, `or`, `not` and `->`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal, TypeAlias, assert_never

from stlc.compile.augment.timers import FALSE, OPEN, TRUE, at_least, both, choose, time_test
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.source import Span

AbsoluteOp: TypeAlias = Literal["always", "eventually", "until", "release"]

_OPEN, _TRUE, _FALSE = ir.Const(OPEN), ir.Const(TRUE), ir.Const(FALSE)
_KNOWN = ir.Const(0.5)
_OTHER: Mapping[str, Literal["and", "or"]] = {"and": "or", "or": "and"}


@dataclass(frozen=True, slots=True)
class Absolute:
    """Operator with an interval that counts from the start of the mission (`always@[a, b]`).

    Its operands are state formulas in negation normal form.

    Attributes:
        op: the operator.
        window: the interval in samples, counted from the start of the mission.
        span: source location of the operator.
        left: left operand of `until` and `release`, a typed formula; a constant for `always` and
            `eventually`.
        right: right operand of `until` and `release`, or the operand of `always` and `eventually`, a typed
            formula.
        left_now: `left` as a condition on the current state; a predicate at its threshold counts as true.
        right_now: `right` as a condition on the current state; a predicate at its threshold counts as true.
        margin: `right` as a formula of the IR, for its robustness.
    """

    op: AbsoluteOp
    window: ir.Window
    span: Span
    left: typed.Formula
    right: typed.Formula
    left_now: ir.Formula
    right_now: ir.Formula
    margin: ir.Formula


@dataclass(frozen=True, slots=True)
class GoalLeaf:
    """Goal of one absolute formula (`always@[a, b] p`), with the states that the compiler adds for it.

    Attributes:
        formula: the absolute formula.
        status: state that is 0 while the formula is open (undecided), then 1 (true) or -1 (false); None for
            an `always@` that is required at every sample, whatever happened before.
        clock: state that counts the steps of the mission.
    """

    formula: Absolute
    status: ir.Signal | None
    clock: ir.Signal


@dataclass(frozen=True, slots=True)
class GoalBranch:
    """Inner node of a goal tree: conjunction or disjunction (`op`) of goals.

    The leaves of the tree are absolute formulas (`GoalLeaf`).
    """

    op: Literal["and", "or"]
    items: tuple[Goal, ...]
    span: Span


Goal: TypeAlias = GoalLeaf | GoalBranch
"""A requirement as `and`s and `or`s of its absolute formulas (`always@[a, b] p`), which are the leaves."""


def last_step(formula: Absolute) -> int:
    """Return the mission step at which the window of a formula ends.

    For a window without end, the result is the step at which the window begins.
    """
    return formula.window.lo if formula.window.hi is None else formula.window.hi


def mission_steps(goal: Goal) -> int:
    """Return the mission step at which the last window in a goal ends.

    A window without end counts as if it ended where it begins.
    """
    if isinstance(goal, GoalLeaf):
        return last_step(goal.formula)
    return max(map(mission_steps, goal.items))


def never_over(goal: Goal) -> bool:
    """True if a formula of the goal has a window without end, so that the mission never ends."""
    if isinstance(goal, GoalLeaf):
        return goal.formula.window.hi is None
    return any(map(never_over, goal.items))


# ----------------------------------------------------------------------------- the latch


def update(formula: Absolute, clock: ir.Signal) -> Callable[[ir.Signal], ir.Num]:
    """Return a function that computes the status of `formula` one step later.

    The argument of the function is the signal of the status. The status is open (undecided), true or false.
    The current sample may decide an open status. A status that is true or false stays so. `clock` is the
    mission clock (steps since the start of the mission).
    """
    later = _decided(formula, clock)
    return lambda own: choose(at_least(_KNOWN, own.apply("abs")), later, own)


def _decided(formula: Absolute, clock: ir.Signal) -> ir.Num:
    """Return the next status of a formula whose status is open.

    The next status is true or false if the current sample decides the formula, else open. `clock` is the
    mission clock (steps since the start of the mission).
    """
    window, left, right = formula.window, formula.left_now, formula.right_now
    inside: ir.Formula = at_least(clock, ir.Const(float(window.lo)))
    over: ir.Formula = ir.Truth(False)
    if window.hi is not None:
        end = ir.Const(float(window.hi))
        until_end, over = at_least(end, clock), at_least(clock, end)  # both hold at the end
        inside = until_end if window.lo == 0 else both(inside, until_end)
    match formula.op:
        case "always":
            return choose(both(inside, right.negated), _FALSE, choose(over, _TRUE, _OPEN))
        case "eventually":
            return choose(both(inside, right), _TRUE, choose(over.negated, _OPEN, _FALSE))
        case "until":
            met = choose(both(inside, right), _TRUE, choose(over.negated, _OPEN, _FALSE))
            return choose(left.negated, _FALSE, met)
        case "release":
            failed = choose(both(inside, right.negated), _FALSE, choose(over, _TRUE, _OPEN))
            return choose(left, _TRUE, failed)
        case _:
            assert_never(formula.op)


# ------------------------------------------------------------------------- progression


def progress(goal: Goal, steps: int, *, again: bool) -> typed.Formula:
    """Return the formula that a plan must satisfy at its first sample in order not to falsify the goal.

    The goal consists of absolute formulas (`always@[a, b] p`), joined by `and` and `or`. The result is
    evaluated over the `steps` steps of the plan. It reads the status of each absolute formula (open, true or
    false), which sums up what happened before the plan.

    A part that the mission has falsified is required no more: no plan can satisfy it, and the others shall be
    satisfied all the same. Only `always@` is required `again` at later samples, as safety requirements are.
    """
    if isinstance(goal, GoalBranch) and goal.op == "and":
        items = tuple(progress(item, steps, again=again) for item in goal.items)
        return typed.Logic(goal.span, "and", items)
    lost = _lost(goal)
    if lost is None or (again and isinstance(goal, GoalLeaf) and goal.formula.op == "always"):
        return _progress(goal, steps, alive=False)
    asked = _progress(goal, steps, alive=isinstance(goal, GoalBranch))
    return typed.Logic(lost.span, "or", (lost, asked))


def _progress(goal: Goal, steps: int, *, alive: bool) -> typed.Formula:
    match goal:
        case GoalBranch(op, items, span):
            return typed.Logic(span, op, tuple(_progress(item, steps, alive=True) for item in items))
        case GoalLeaf(formula):
            return _remainder(goal, formula, steps, alive=alive)
        case _:
            assert_never(goal)


def _remainder(leaf: GoalLeaf, formula: Absolute, steps: int, *, alive: bool) -> typed.Formula:
    """Return the formula that a plan must satisfy in order not to falsify the absolute formula `formula`.

    `leaf` contains the states that are added for this formula. `steps` is the length of the plan. `alive`:
    whether the formula is false once the mission has falsified it.
    """
    span, left, right = formula.span, formula.left, formula.right
    plan = typed.Interval(typed.Time(), typed.Time(steps=Fraction(steps), span=span), span=span)
    inside = typed_inside(formula.window, leaf.clock, span)
    asked = typed.Logic(span, "->", (inside, right))
    met = typed.Logic(span, "and", (inside, right))
    if formula.op == "always":
        held = asked if formula.window.hi == 0 else typed.Temporal(span, "always", plan, asked)
        return typed.Logic(span, "and", (possible(leaf), held)) if alive and leaf.status else held
    assert leaf.status is not None
    known = time_test(leaf.status, _KNOWN, span)
    end = formula.window.hi
    far: typed.Formula = typed.Truth(span, end is None)  # holds while the window ends after the plan
    if end is not None and end > steps:
        far = time_test(ir.Const(float(end - steps - 1)), leaf.clock, span)
    match formula.op:
        case "eventually":
            soon = typed.Temporal(span, "eventually", plan, met)
            return typed.Logic(span, "or", (known, far, soon))
        case "until":
            later = typed.Logic(span, "and", (far, typed.Temporal(left.span, "always", plan, left)))
            reached = typed.Until(span, "until", plan, left, met)
            rest: typed.Formula = typed.Logic(span, "or", (later, reached))
        case "release":
            rest = typed.Until(span, "release", plan, left, asked)
        case _:
            assert_never(formula.op)
    if alive:
        rest = typed.Logic(span, "and", (possible(leaf), rest))
    return typed.Logic(span, "or", (known, rest))


def possible(goal: Goal) -> typed.Formula:
    """Return a formula over the current state that is false once the mission has falsified the goal."""
    match goal:
        case GoalBranch(op, items, span):
            return typed.Logic(span, op, tuple(map(possible, items)))
        case GoalLeaf(formula, status):
            span = formula.span
            return typed.Truth(span, True) if status is None else time_test(status, ir.Const(-0.5), span)
        case _:
            assert_never(goal)


def _lost(goal: Goal) -> typed.Formula | None:
    """Return a formula over the current state that holds once the mission has falsified the goal.

    None if that cannot be known from the state.
    """
    match goal:
        case GoalBranch(op, items, span):
            parts = [part for item in items if (part := _lost(item)) is not None]
            if not parts or (op == "or" and len(parts) < len(items)):
                return None
            return parts[0] if len(parts) == 1 else typed.Logic(span, _OTHER[op], tuple(parts))
        case GoalLeaf(formula, status):
            return None if status is None else time_test(ir.Const(-0.5), status, formula.span)
        case _:
            assert_never(goal)


def typed_inside(window: ir.Window, clock: ir.Signal, span: Span) -> typed.Formula:
    """Return a typed formula that holds while the mission clock is within `window`.

    The mission clock counts the steps since the start of the mission. `span` becomes the source location of
    the formula. `_decided` has the same formula in the IR.
    """
    started = time_test(clock, ir.Const(float(window.lo)), span)
    if window.hi is None:
        return started
    not_over = time_test(ir.Const(float(window.hi)), clock, span)
    return not_over if window.lo == 0 else typed.Logic(span, "and", (started, not_over))
