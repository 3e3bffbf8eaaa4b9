"""State formulas: those without a temporal operator, as conditions of numbers, guards and rejections."""

from __future__ import annotations

from typing import assert_never

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.samples import leaves


def is_state(formula: typed.Formula) -> bool:
    """Whether its truth depends on one instant alone, with what is frozen around it."""
    match formula:
        case typed.Truth():
            return True
        case typed.Predicate(_, num):
            return not any(isinstance(leaf, ir.ShiftedSignal) for leaf in leaves(num))
        case typed.Not(_, body):
            return is_state(body)
        case typed.Logic(_, _, items):
            return all(is_state(item) for item in items)
        case typed.Temporal() | typed.Until() | typed.Shift() | typed.Edge() | typed.Freeze():
            return False
        case typed.Recalled():
            return False
        case _:
            assert_never(formula)


def condition(formula: typed.Formula, *, negated: bool = False) -> ir.Formula:
    """A state formula in negation normal form, constants folded.

    Args:
        formula: one for which `is_state` holds.
        negated: take its negation.
    """
    match formula:
        case typed.Truth(span, value):
            return ir.Truth(value != negated, span)
        case typed.Predicate(span, num, strict):
            return ir.Predicate(num, -1 if negated else 1, strict != negated, span=span)
        case typed.Not(_, body):
            return condition(body, negated=not negated)
        case typed.Logic(_, "and" | "or" as op, items):
            flipped: dict[str, str] = {"and": "or", "or": "and"}
            return _join(
                flipped[op] if negated else op, [condition(i, negated=negated) for i in items], formula
            )
        case typed.Logic(_, op, (left, right)):
            return _pair(op, left, right, formula, negated=negated)
        case _:
            raise AssertionError("not a state formula")


def _pair(
    op: str, left: typed.Formula, right: typed.Formula, whole: typed.Formula, *, negated: bool
) -> ir.Formula:
    """`->`, `<->` and `xor`; `a <-> b` is both implications, `xor` its negation."""
    if op == "->":
        items = [condition(left, negated=not negated), condition(right, negated=negated)]
        return _join("and" if negated else "or", items, whole)
    if op == "xor":
        negated = not negated
    there = [condition(left, negated=not negated), condition(right, negated=negated)]
    back = [condition(right, negated=not negated), condition(left, negated=negated)]
    inner, outer = ("and", "or") if negated else ("or", "and")
    return _join(outer, [_join(inner, there, whole), _join(inner, back, whole)], whole)


def _join(op: str, items: list[ir.Formula], whole: typed.Formula) -> ir.Formula:
    """Min or max, without the constants that decide nothing."""
    decides = op == "or"
    kept: list[ir.Formula] = []
    for item in items:
        if not isinstance(item, ir.Truth):
            kept.append(item)
        elif item.value == decides:
            return ir.Truth(decides, whole.span)
    if not kept:
        return ir.Truth(not decides, whole.span)
    if len(kept) == 1:
        return kept[0]
    return ir.BoolOp("or" if op == "or" else "and", tuple(kept), whole.span)
