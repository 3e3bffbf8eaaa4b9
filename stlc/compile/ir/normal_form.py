"""Negation normal form: the expansion of `not`, `->`, `<->`, `xor`, `if` and `unless`.

De Morgan's laws push a negation down to the leaves: it swaps `and` with `or`, `always` with `eventually`,
`once` with `historically`, `until` with `release`, `since` with `trigger`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import chain
from typing import Any, Literal

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.nodes import DUAL


def normal(formula: typed.Formula, sign: typed.Sign = 1) -> typed.Formula:
    """Return `formula` if `sign` is 1, or its negation if -1, with negations pushed down to the leaves.

    The result has a `not` only before predicates, `since`, `rise`, `fall`, `prev`, `next`, and `Recalled`
    nodes (past operators rewritten with timers). `->`, `<->`, `xor`, `if` and `unless` are expanded.
    """
    op = getattr(formula, "op", "")
    match formula:
        case typed.Predicate():
            return formula if sign > 0 else typed.Not(formula.span, formula)
        case typed.Truth(_, value):
            return formula if sign > 0 else replace(formula, value=not value)
        case typed.Not(span, body):
            inner = normal(body, typed.flip(sign))
            return replace(inner, span=span) if sign > 0 else inner  # the text there has the `not`
        case typed.Until(_, "unless"):
            return normal(formula.unless(), sign)
        case typed.Logic(span, "->" | "<->" | "xor" | "if"):
            outer = formula.connective(sign)
            groups = [tuple(normal(*part) for part in group) for group in outer.groups]
            inner = DUAL[outer.op]
            parts = tuple(
                group[0] if len(group) == 1 else typed.Logic(span, inner, group) for group in groups
            )
            return typed.Logic(span, outer.op, parts)
        case typed.Freeze():
            return formula.map_children(formulas=lambda part: normal(part, sign))
        case _ if op in DUAL and op != "since":
            signed: Any = formula.map_children(formulas=lambda part: normal(part, sign))
            found: typed.Formula = signed if sign > 0 else replace(signed, op=DUAL[op])
            return found
        case _:
            inner = formula.map_children(formulas=normal)
            return inner if sign > 0 else typed.Not(formula.span, inner)


# ---------------------------------------------------------------------------- state formulas


def condition(formula: typed.Formula, *, negated: bool = False, flat: bool = False) -> ir.Formula:
    """Return a state formula as a condition of the IR, simplified where an operand is `true` or `false`.

    Args:
        formula: a state formula (`typed.Formula.is_state`): its truth depends on one instant.
        negated: whether to return the negation.
        flat: whether to merge nested `and`s and nested `or`s, and to remove repeated items.
    """
    return _folded(normal(formula, -1 if negated else 1), flat)


def _folded(formula: typed.Formula, flat: bool) -> ir.Formula:
    match formula:
        case typed.Truth(span, value):
            return ir.Truth(value, span)
        case typed.Predicate() | typed.Not(_, typed.Predicate()):
            return literal(formula)
        case typed.Logic(span, "and" | "or" as op, items):
            parts = [_folded(item, flat) for item in items]
            return ir.BoolOp.joined(op, flattened(op, parts) if flat else parts, span)
        case _:
            raise AssertionError("not a state formula")


def flattened(op: Literal["and", "or"], items: Iterable[ir.Formula]) -> list[ir.Formula]:
    """Return the distinct items of an `and` or `or`, with nested formulas of the same operator expanded."""
    nested = ((item.items if isinstance(item, ir.BoolOp) and item.op == op else (item,)) for item in items)
    return list(dict.fromkeys(chain.from_iterable(nested)))


def literal(formula: typed.Predicate | typed.Not) -> ir.Predicate:
    """Return a predicate, or the negation of one, as a predicate of the IR."""
    if isinstance(formula, typed.Predicate):
        return ir.Predicate(formula.num, 1, formula.strict, formula.guard, formula.span)
    assert isinstance(formula.body, typed.Predicate)
    return literal(formula.body).negated
