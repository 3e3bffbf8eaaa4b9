"""Requirements that say nothing: decided by enforced ranges beforehand, or beyond any finite prefix."""

from __future__ import annotations

from collections.abc import Iterator
from typing import assert_never

from stlc.compile.analysis.ranges import Facts, bounds
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.diagnostics import Diagnostic, Label
from stlc.grammar import ast
from stlc.signature import Signature
from stlc.source import Span

_TOLERANCE = 1e-6


def vacuous(formula: typed.Formula, signature: Signature, facts: Facts) -> Iterator[Diagnostic]:
    """W503 for implications whose left side is never true, and for a formula that is never false.

    Only enforced ranges count: a nominal range says where a signal should be, not where it is.
    """
    found = False
    for left in _antecedents(formula):
        if truth(left, facts) is False:
            found = True
            why = _because(left, signature, facts)
            note = ("the requirement is satisfied by every trajectory",)
            yield Diagnostic(
                "W503", f"the left side can never be true{why}", left.span, "always false", note=note
            )
    if not found and truth(formula, facts) is True:
        why = _because(formula, signature, facts)
        yield Diagnostic("W503", f"this can never be false{why}", formula.span, "always true")


def truth(formula: typed.Formula, facts: Facts) -> bool | None:
    """What enforced ranges say: True or False at every instant of every trace, or None."""
    match formula:
        case typed.Truth(_, value):
            return value
        case typed.Predicate(_, num, _):
            reach = bounds(num, facts)
            if reach is None or isinstance(num, ir.Const):
                return None
            return True if reach[0] > _TOLERANCE else (False if reach[1] < -_TOLERANCE else None)
        case typed.Not(_, body):
            inner = truth(body, facts)
            return None if inner is None else not inner
        case typed.Logic():
            return _logic(formula, facts)
        case typed.Temporal(_, "always" | "eventually", _, body) | typed.Freeze(_, _, body):
            return truth(body, facts)
        case typed.Temporal() | typed.Until() | typed.Shift() | typed.Edge() | typed.Recalled():
            return None
        case _:
            assert_never(formula)


def _logic(formula: typed.Logic, facts: Facts) -> bool | None:
    values = [truth(item, facts) for item in formula.items]
    op = formula.op
    if op == "->":
        values[0] = None if values[0] is None else not values[0]
        op = "or"
    if op in ("and", "or"):
        decisive = op == "or"
        if decisive in values:
            return decisive
        return None if None in values else not decisive
    if None in values:
        return None
    return (values[0] == values[1]) == (op == "<->")


def _antecedents(formula: typed.Formula) -> Iterator[typed.Formula]:
    """Left sides of implications that are required (not under a negation)."""
    match formula:
        case typed.Logic(_, "->", (left, right)):
            yield left
            yield from _antecedents(right)
        case typed.Logic(_, "and", items):
            for item in items:
                yield from _antecedents(item)
        case typed.Temporal(_, "always", _, body) | typed.Freeze(_, _, body):
            yield from _antecedents(body)
        case _:
            return


def _because(formula: typed.Formula, signature: Signature, facts: Facts) -> str:
    """`: x is in [0, 5]`, for the columns with an enforced range that decide it."""
    parts = []
    for name in dict.fromkeys(_columns(formula)):
        if name in facts and name in signature:
            low, high = facts[name]
            unit = signature[name].unit
            parts.append(f"`{name}` is in [{low:g}, {high:g}]" + (f" {unit}" if unit.text else ""))
    return f": {', '.join(parts)}" if parts else ""


def _columns(formula: typed.Formula) -> Iterator[str]:
    match formula:
        case typed.Predicate(_, num, _):
            yield from _in_number(num)
        case typed.Logic(_, _, items):
            for item in items:
                yield from _columns(item)
        case typed.Not(_, body) | typed.Temporal(_, _, _, body) | typed.Freeze(_, _, body):
            yield from _columns(body)
        case _:
            return


def _in_number(num: ir.Num) -> Iterator[str]:
    match num:
        case ir.Signal(name) | ir.ShiftedSignal(name):
            yield name
        case ir.Op(_, args):
            for arg in args:
                yield from _in_number(arg)
        case _:
            return


# ----------------------------------------------------------------------- safety


def toothless(requirement: typed.Requirement, tag: ast.Tag | None) -> Diagnostic | None:
    """W502 for a `@safety` requirement that no finite prefix can violate."""
    if "safety" not in requirement.tags or _constrains(requirement.formula, positive=True):
        return None
    culprit = _promise(requirement.formula, positive=True)
    labels = () if tag is None else (Label(tag.span, "puts it into phi_safe"),)
    return Diagnostic(
        "W502",
        "this `@safety` requirement can never constrain the backup policy",
        culprit,
        "only says that something good happens at the end",
        labels,
        help=(
            "a safety requirement is violated by a finite prefix; use @liveness, or bound it with `always`",
        ),
    )


def _constrains(formula: typed.Formula, *, positive: bool) -> bool:
    """Whether some finite prefix, shorter than the horizon, can violate it (`positive`) or its negation."""
    match formula:
        case typed.Truth():
            return False
        case typed.Predicate() | typed.Edge() | typed.Shift() | typed.Recalled():
            return True
        case typed.Not(_, body):
            return _constrains(body, positive=not positive)
        case typed.Freeze(_, _, body):
            return _constrains(body, positive=positive)
        case typed.Logic(_, op, items):
            if op == "->":
                sides = [
                    _constrains(items[0], positive=not positive),
                    _constrains(items[1], positive=positive),
                ]
                return all(sides) if positive else any(sides)
            every = (op == "or") == positive if op in ("and", "or") else False
            inner = [_constrains(item, positive=positive) for item in items]
            return all(inner) if every else any(inner)
        case typed.Temporal(_, op, window, body):
            promise = op == ("eventually" if positive else "always")
            return _constrains(body, positive=positive) and not (promise and _open(window))
        case typed.Until(_, op, window, left, right):
            side = left if (op in ("until", "since")) == positive else right
            return _constrains(side, positive=positive) or not _open(window)
        case _:
            assert_never(formula)


def _open(window: typed.Interval) -> bool:
    """Whether a window reaches the horizon or the end."""
    return window.hi is None or window.hi.horizons > 0


def _promise(formula: typed.Formula, *, positive: bool) -> Span:
    """Where the part stands that only promises."""
    match formula:
        case typed.Not(_, body):
            return _promise(body, positive=not positive)
        case typed.Freeze(_, _, body):
            return _promise(body, positive=positive)
        case typed.Logic(_, "->", (left, right)):
            if not _constrains(right, positive=positive):
                return _promise(right, positive=positive)
            return _promise(left, positive=not positive)
        case typed.Logic(_, _, items):
            for item in items:
                if not _constrains(item, positive=positive):
                    return _promise(item, positive=positive)
            return formula.span
        case _:
            return formula.span
