"""How far a formula looks: into the past, into the future, to the end of the trace; and at which columns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import assert_never

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.samples import Reach, columns_of, looks_on, reach_of

__all__ = ["Reach", "columns", "nodes", "numbers", "parts", "reach", "uses_end"]


def reach(formula: ir.Formula) -> Reach:
    """How many steps `formula` needs before and after the instant where it is judged.

    A window to the end of the trace counts with its start alone: it takes what there is from there on.
    Windows of the past are cut at the start of the trace: the past is what they use, never what they need.
    What is on the mission clock counts from the first sample on, whatever stands around it.
    """
    clocked = [reach(node.body) for node in nodes(formula) if isinstance(node, ir.AtStart)]
    return _furthest(_from_now(formula), *(Reach(0, part.future) for part in clocked))


def _from_now(formula: ir.Formula) -> Reach:
    match formula:
        case ir.Truth() | ir.AtStart():
            return Reach(0, 0)
        case ir.Predicate(num):
            return reach_of(num)
        case ir.Freeze(bindings, body):
            return _furthest(_from_now(body), *(reach_of(num) for _, num in bindings))
        case ir.BoolOp(_, items):
            return _furthest(*map(_from_now, items))
        case ir.Temporal(_, window, body):
            return _ahead(_from_now(body), window)
        case ir.PastTemporal(_, window, body):
            return _back(_from_now(body), window)
        case ir.Until(_, window, left, right):
            return _furthest(
                _ahead(_from_now(right), window), _ahead(_from_now(left), ir.Window(0, window.hi))
            )
        case ir.Since(_, window, left, right):
            held = ir.Window(0, window.hi)
            return _furthest(_back(_from_now(right), window), _back(_from_now(left), held))
        case ir.Shift(steps, body):
            inner = _from_now(body)
            return Reach(max(inner.past - steps, 0), max(inner.future + steps, 0))
        case _:
            assert_never(formula)


def _furthest(*parts: Reach) -> Reach:
    return Reach(max(part.past for part in parts), max(part.future for part in parts))


def _ahead(body: Reach, window: ir.Window) -> Reach:
    last = window.lo if window.hi is None else window.hi
    return Reach(max(body.past - window.lo, 0), body.future + last)


def _back(body: Reach, window: ir.Window) -> Reach:
    last = window.lo if window.hi is None else window.hi
    return Reach(body.past + last, max(body.future - window.lo, 0))


def uses_end(formula: ir.Formula) -> bool:
    """Whether a window of the future runs to the end of the trace, or a segment would leave it (`sweep`)."""
    return any(_uses_end(node) for node in nodes(formula))


def _uses_end(node: ir.Formula) -> bool:
    match node:
        case ir.Temporal(_, window) | ir.Until(_, window):
            return window.hi is None
        case ir.Predicate(num):
            return looks_on(num)
        case ir.Freeze(bindings):
            return any(looks_on(num) for _, num in bindings)
        case _:
            return False


def nodes(formula: ir.Formula) -> Iterator[ir.Formula]:
    """All formulas in `formula`, itself first; conditions inside of numbers are not among them."""
    yield formula
    for part in parts(formula):
        yield from nodes(part)


def parts(formula: ir.Formula) -> tuple[ir.Formula, ...]:
    """The operands of a formula."""
    match formula:
        case ir.Truth() | ir.Predicate():
            return ()
        case ir.BoolOp(_, items):
            return items
        case ir.Temporal(_, _, body) | ir.PastTemporal(_, _, body) | ir.Shift(_, body) | ir.Freeze(_, body):
            return (body,)
        case ir.AtStart(body):
            return (body,)
        case ir.Until(_, _, left, right) | ir.Since(_, _, left, right):
            return (left, right)
        case _:
            assert_never(formula)


def columns(formula: ir.Formula) -> frozenset[str]:
    """Names of the columns that a formula reads."""
    return frozenset(name for num in numbers(formula) for name in columns_of(num))


def numbers(formula: ir.Formula) -> Iterator[ir.Num]:
    """The numbers of predicates, and those that `freeze` binds."""
    for node in nodes(formula):
        match node:
            case ir.Predicate(num):
                yield num
            case ir.Freeze(bindings):
                yield from (num for _, num in bindings)
            case _:
                pass
