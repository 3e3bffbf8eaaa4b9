"""Negation normal form: the expansion of `not`, `->`, `<->`, `xor`, `if` and `unless`.

De Morgan's laws push a negation down to the leaves: it swaps `and` with `or`, `always` with `eventually`,
`once` with `historically`, `until` with `release`, `since` with `trigger`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Literal, TypeAlias, assert_never

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.nodes import DUAL
from stlc.compile.ir.traverse import map_children
from stlc.source import Span

Sign: TypeAlias = Literal[1, -1]


def flip(sign: Sign) -> Sign:
    """Return the opposite sign."""
    return -1 if sign > 0 else 1


def normal(formula: typed.Formula, sign: Sign = 1) -> typed.Formula:
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
            inner = normal(body, flip(sign))
            return replace(inner, span=span) if sign > 0 else inner  # the text there has the `not`
        case typed.Until(_, "unless"):
            return normal(unless(formula), sign)
        case typed.Logic(span, "->" | "<->" | "xor" | "if"):
            outer = connective(formula, sign)
            groups = [tuple(normal(*part) for part in group) for group in outer.groups]
            inner = DUAL[outer.op]
            parts = tuple(
                group[0] if len(group) == 1 else typed.Logic(span, inner, group) for group in groups
            )
            return typed.Logic(span, outer.op, parts)
        case typed.Freeze():
            return map_children(formula, formulas=lambda part: normal(part, sign))
        case _ if op in DUAL and op != "since":
            signed = formula if sign > 0 else replace(formula, op=DUAL[op])
            return map_children(signed, formulas=lambda part: normal(part, sign))
        case _:
            inner = map_children(formula, formulas=normal)
            return inner if sign > 0 else typed.Not(formula.span, inner)


@dataclass(frozen=True, slots=True)
class Connective:
    """A propositional operator, or its negation, as an `and` or `or` of groups of operands.

    Attributes:
        op: operator between the groups; within a group it is the dual one.
        groups: pairs (operand, sign); the sign -1 stands for the negation of the operand.
    """

    op: Literal["and", "or"]
    groups: tuple[tuple[tuple[typed.Formula, Sign], ...], ...]


def connective(formula: typed.Logic, sign: Sign = 1) -> Connective:
    """Return the definition of a propositional operator, or of its negation if `sign` is -1.

    `a -> b` is `not a or b`, `a <-> b` is `(a -> b) and (b -> a)`, and `a xor b` is the negation of that.
    `if c then p else q` is `(c and p) or (not c and q)`.
    """
    op, items, inverse = formula.op, formula.items, flip(sign)
    plain: Literal["and", "or"] = "and" if sign > 0 else "or"
    dual: Literal["and", "or"] = DUAL[plain]
    match op:
        case "and" | "or":
            return Connective(plain if op == "and" else dual, tuple(((item, sign),) for item in items))
        case "->":
            return Connective(dual, (((items[0], inverse),), ((items[1], sign),)))
        case "if":
            cond, yes, no = items
            return Connective(dual, (((cond, sign), (yes, sign)), ((cond, inverse), (no, sign))))
        case "xor":
            return connective(replace(formula, op="<->"), inverse)
        case "<->":
            left, right = items
            return Connective(plain, (((left, inverse), (right, sign)), ((left, sign), (right, inverse))))
    assert_never(op)


def unless(node: typed.Until) -> typed.Logic:
    """Return `left unless[a, b] right` as `always[0, b] left or left until[a, b] right`."""
    whole = replace(node.interval, lo=typed.Time(), lo_open=False)
    held = typed.Temporal(node.span, "always", whole, node.left)
    return typed.Logic(node.span, "or", (held, replace(node, op="until")))


# ---------------------------------------------------------------------------- state formulas


def condition(formula: typed.Formula, *, negated: bool = False, flat: bool = False) -> ir.Formula:
    """Return a state formula as a condition of the IR, simplified where an operand is `true` or `false`.

    Args:
        formula: a state formula (`stlc.compile.ir.traverse.is_state`): its truth depends on one instant.
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
            return joined(op, flattened(op, parts) if flat else parts, span)
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
    negated: ir.Predicate = negate(literal(formula.body))
    return negated


def joined(op: Literal["and", "or"], items: Iterable[ir.Formula], span: Span | None = None) -> ir.Formula:
    """Return the `and` or `or` of formulas, simplified where a formula is a constant.

    A constant that does not change the result is removed; a constant that decides the result is returned.
    """
    kept: list[ir.Formula] = []
    for item in items:
        if not isinstance(item, ir.Truth):
            kept.append(item)
        elif item.value is not (op == "and"):
            return ir.Truth(item.value, span)
    if len(kept) < 2:
        return kept[0] if kept else ir.Truth(op == "and", span)
    return ir.BoolOp(op, tuple(kept), span)


def rejoined(formula: ir.Formula, change: Callable[[ir.Formula], ir.Formula]) -> ir.Formula:
    """Return a formula in which `change` replaces each formula that `and` and `or` join, simplified."""
    if isinstance(formula, ir.BoolOp):
        return joined(formula.op, (rejoined(item, change) for item in formula.items), formula.span)
    return change(formula)


def terms(formula: ir.Formula, op: Literal["and", "or"]) -> Iterator[ir.Formula]:
    """Yield the formulas that nested operators `op` join; the formula itself if it is no such operator."""
    if isinstance(formula, ir.BoolOp) and formula.op == op:
        for item in formula.items:
            yield from terms(item, op)
    else:
        yield formula


def negate(formula: Any) -> Any:
    """Return the negation of a state formula of the IR."""
    match formula:
        case ir.Truth(value):
            return replace(formula, value=not value)
        case ir.Predicate(_, sign, strict):
            return replace(formula, sign=flip(sign), strict=not strict)
        case ir.BoolOp(op):
            return map_children(replace(formula, op=DUAL[op]), formulas=negate)
        case _:
            raise TypeError(f"not a state formula: {formula!r}")


def pieces(formula: ir.Formula) -> list[ir.Formula]:
    """Split a formula into conjuncts: `always (a and b) and c` gives `always a`, `always b` and `c`."""
    match formula:
        case ir.BoolOp("and", items):
            return [piece for item in items for piece in pieces(item)]
        case ir.Temporal("always", _, body):
            return [replace(formula, body=piece) for piece in pieces(body)]
        case _:
            return [formula]
