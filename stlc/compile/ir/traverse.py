"""Typed formulas: their parts, what they are made of, and negation normal form before time is rewritten."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal, TypeAlias, TypeGuard, assert_never

from stlc.compile.ir import typed
from stlc.compile.ir.samples import of_now

Sign: TypeAlias = Literal[1, -1]


def operands(formula: typed.Formula) -> tuple[typed.Formula, ...]:
    """The formulas directly below."""
    match formula:
        case typed.Truth() | typed.Predicate():
            return ()
        case typed.Logic(_, _, items):
            return items
        case typed.Until(_, _, _, left, right):
            return (left, right)
        case typed.Not() | typed.Shift() | typed.Edge() | typed.Temporal() | typed.Freeze():
            return (formula.body,)
        case typed.Recalled(_, now):
            return (now,)
        case _:
            assert_never(formula)


def at_hand(formula: typed.Formula) -> typed.Formula:
    """A state formula with what it recalls told by timers alone."""
    match formula:
        case typed.Recalled(_, now):
            return at_hand(now)
        case typed.Logic(_, _, items):
            return replace(formula, items=tuple(map(at_hand, items)))
        case typed.Not(_, body):
            return replace(formula, body=at_hand(body))
        case _:
            return formula


def nodes(formula: typed.Formula) -> Iterator[typed.Formula]:
    """All formulas in `formula`, itself first."""
    yield formula
    for part in operands(formula):
        yield from nodes(part)


def margin_unit(formula: typed.Formula) -> str:
    """The unit of a formula's robustness; "" where its predicates are not all of one."""
    found = {
        node.unit.text for node in nodes(formula) if isinstance(node, typed.Predicate) and not node.guard
    }
    return found.pop() if len(found) == 1 else ""


def on_clock(node: typed.Formula) -> TypeGuard[typed.Temporal | typed.Until]:
    """Whether the interval of this operator is on the mission clock."""
    return isinstance(node, (typed.Temporal, typed.Until)) and node.interval.clock == "start"


def from_now(node: typed.Temporal | typed.Until) -> typed.Temporal | typed.Until:
    """The operator with its interval measured from now: what it means at the first sample."""
    return replace(node, interval=replace(node.interval, clock="now"))


def absolute(formula: typed.Formula) -> bool:
    """Whether an interval of `formula` is on the mission clock."""
    return any(map(on_clock, nodes(formula)))


def looks_back(formula: typed.Formula) -> bool:
    """Whether `formula` has an operator of the past."""
    return any(map(_backwards, nodes(formula)))


def _backwards(node: typed.Formula) -> bool:
    match node:
        case typed.Temporal(_, "once" | "historically") | typed.Until(_, "since") | typed.Edge():
            return True
        case _:
            return False


def is_state_formula(formula: typed.Formula) -> bool:
    """Whether `formula` is about one instant alone, frozen values and other samples apart."""
    state = (typed.Truth, typed.Not, typed.Logic, typed.Recalled)
    return all(
        isinstance(node, state) or (isinstance(node, typed.Predicate) and of_now(node.num))
        for node in nodes(formula)
    )


def mentions_horizon(formula: typed.Formula) -> bool:
    """Whether a bound of `formula` is written with `T`."""
    temporal = (node for node in nodes(formula) if isinstance(node, (typed.Temporal, typed.Until)))
    return any(_with_horizon(node.interval.lo) or _with_horizon(node.interval.hi) for node in temporal)


def _with_horizon(time: typed.Time | None) -> bool:
    return time is not None and time.horizons != 0


# ------------------------------------------------------------------ negation normal form

_DUAL: dict[str, Literal["always", "eventually", "once", "historically"]] = {
    "always": "eventually",
    "eventually": "always",
    "once": "historically",
    "historically": "once",
}


def normal(formula: typed.Formula, sign: Sign = 1) -> typed.Formula:
    """`formula` for `sign` 1, its negation for -1, made of `and`, `or` and temporal operators.

    `not` is left before predicates, `since`, `rise`, `fall`, `prev` and `next`.
    """
    match formula:
        case typed.Truth(span, value):
            return typed.Truth(span, value is (sign > 0))
        case typed.Predicate() | typed.Shift() | typed.Edge() | typed.Until(_, "since") | typed.Recalled():
            return formula if sign > 0 else typed.Not(formula.span, formula)
        case typed.Not(_, body):
            return normal(body, flip(sign))
        case typed.Logic():
            return _logic(formula, sign)
        case typed.Freeze():
            return replace(formula, body=normal(formula.body, sign))
        case typed.Temporal(_, op):
            return replace(formula, op=op if sign > 0 else _DUAL[op], body=normal(formula.body, sign))
        case typed.Until():
            return _until(formula, sign)
        case _:
            assert_never(formula)


def flip(sign: Sign) -> Sign:
    """The other sign."""
    return -1 if sign > 0 else 1


def _logic(node: typed.Logic, sign: Sign) -> typed.Formula:
    match node.op:
        case "and" | "or":
            op: Literal["and", "or"] = "and" if (node.op == "and") is (sign > 0) else "or"
            return typed.Logic(node.span, op, tuple(normal(item, sign) for item in node.items))
        case "->":
            left, right = node.items
            parts = (normal(left, flip(sign)), normal(right, sign))
            return typed.Logic(node.span, "or" if sign > 0 else "and", parts)
        case "<->" | "xor":
            return _equal(node, sign if node.op == "<->" else flip(sign))
        case _:
            assert_never(node.op)


def _equal(node: typed.Logic, sign: Sign) -> typed.Formula:
    """Both implications; negated: exactly one holds."""
    left, right = node.items
    inner: Literal["and", "or"] = "or" if sign > 0 else "and"
    one = typed.Logic(node.span, inner, (normal(left, flip(sign)), normal(right, sign)))
    other = typed.Logic(node.span, inner, (normal(left, sign), normal(right, flip(sign))))
    return typed.Logic(node.span, "and" if sign > 0 else "or", (one, other))


def _until(node: typed.Until, sign: Sign) -> typed.Formula:
    if node.op == "unless":
        return normal(unless(node), sign)
    op: Literal["until", "release"] = "until" if (node.op == "until") is (sign > 0) else "release"
    return replace(node, op=op, left=normal(node.left, sign), right=normal(node.right, sign))


def unless(node: typed.Until) -> typed.Formula:
    """`left unless[a, b] right` is `always[0, b] left or left until[a, b] right`."""
    whole = replace(node.interval, lo=typed.Time(), lo_open=False)
    held = typed.Temporal(node.span, "always", whole, node.left)
    return typed.Logic(node.span, "or", (held, replace(node, op="until")))
