"""Requirements that say nothing: decided by enforced ranges beforehand, or beyond any finite prefix."""

from __future__ import annotations

from collections.abc import Iterator

from stlc.compile.analysis.ranges import Facts, bounds
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.normal_form import normal
from stlc.compile.ir.traverse import leaves, numbers
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
    return _truth(normal(formula), facts)


def _truth(formula: typed.Formula, facts: Facts) -> bool | None:
    match formula:
        case typed.Truth(_, value):
            return value
        case typed.Predicate(_, num):
            reach = bounds(num, facts)
            if reach is None or isinstance(num, ir.Const):
                return None
            return True if reach[0] > _TOLERANCE else (False if reach[1] < -_TOLERANCE else None)
        case typed.Not(_, body):
            inner = _truth(body, facts)
            return None if inner is None else not inner
        case typed.Logic(_, op, items):
            values, decisive = [_truth(item, facts) for item in items], op == "or"
            return decisive if decisive in values else None if None in values else not decisive
        case typed.Temporal(_, "always" | "eventually", _, body) | typed.Freeze(_, _, body):
            return _truth(body, facts)
        case _:
            return None


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
    read = (leaf for num in numbers(formula) for leaf in leaves(num))
    for name in dict.fromkeys(leaf.name for leaf in read if isinstance(leaf, (ir.Signal, ir.ShiftedSignal))):
        if name in facts and name in signature:
            low, high = facts[name]
            unit = signature[name].unit
            parts.append(f"`{name}` is in [{low:g}, {high:g}]" + (f" {unit}" if unit.text else ""))
    return f": {', '.join(parts)}" if parts else ""


# ----------------------------------------------------------------------- safety


def toothless(requirement: typed.Requirement, tag: ast.Tag | None) -> Diagnostic | None:
    """W502 for a `@safety` requirement that no finite prefix can violate."""
    formula = normal(requirement.formula)
    if "safety" not in requirement.tags or _constrains(formula):
        return None
    culprit = _promise(formula)
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


def _constrains(formula: typed.Formula) -> bool:
    """Whether some finite prefix, shorter than the horizon, can violate a formula in negation normal form."""
    match formula:
        case typed.Truth():
            return False
        case typed.Logic(_, op, items):
            return (all if op == "or" else any)(map(_constrains, items))
        case typed.Temporal(_, op, window, body):
            return _constrains(body) and not (op == "eventually" and _open(window))
        case typed.Freeze(_, _, body):
            return _constrains(body)
        case typed.Until(_, op, window, left, right):
            return _constrains(left if op in ("until", "since") else right) or not _open(window)
        case typed.Not(_, typed.Until(_, _, window, _, right)):
            return _constrains(normal(right, -1)) or not _open(window)
        case _:
            return True


def _open(window: typed.Interval) -> bool:
    """Whether a window reaches the horizon or the end."""
    return window.hi is None or window.hi.horizons > 0


def _promise(formula: typed.Formula) -> Span:
    """The place of the part that only promises."""
    if isinstance(formula, typed.Freeze):
        return _promise(formula.body)
    if isinstance(formula, typed.Logic):
        return next((_promise(item) for item in formula.items if not _constrains(item)), formula.span)
    return formula.span
