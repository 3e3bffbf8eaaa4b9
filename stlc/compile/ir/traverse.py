"""Traversal and rewriting of typed formulas, IR formulas and numbers.

The children of a node are its fields declared as formulas or numbers, so that classes added to
`stlc.compile.ir.nodes` or `stlc.compile.ir.typed` are traversed and rewritten without further code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from functools import cache
from typing import Any, Literal, TypeAlias, TypeGuard, TypeVar, get_args, overload

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed

Node: TypeAlias = ir.Formula | ir.Num | typed.Formula
NumberLeaf: TypeAlias = ir.Const | ir.Signal | ir.ShiftedSignal | ir.FrozenVar
LEAVES = (ir.Const, ir.Signal, ir.ShiftedSignal, ir.FrozenVar)
"""Numbers without parts."""
_NUMBERS = get_args(ir.Num)

N = TypeVar("N", bound=Any)

_Sort: TypeAlias = Literal["formula", "formulas", "number", "numbers", "bindings"]
_SORTS: Mapping[str, _Sort] = {
    "Formula": "formula",
    "tuple[Formula, ...]": "formulas",
    "Num": "number",
    "tuple[Num, ...]": "numbers",
    "tuple[tuple[str, Num], ...]": "bindings",
}
"""Declared type of a field of a node class -> kind of children that it holds."""


@cache
def _shape(kind: Any) -> tuple[tuple[str, _Sort], ...]:
    """Return (name, sort) of each field of a node class (`kind`) that contains child nodes.

    The sort says whether these children are formulas or numbers, and whether there are one or several.
    """
    declared = ((part.name, str(part.type).replace("ir.", "")) for part in fields(kind))
    return tuple((name, _SORTS[text]) for name, text in declared if text in _SORTS)


# ----------------------------------------------------------------------------- one step down


def children(node: Node) -> tuple[Any, ...]:
    """Return the formulas and numbers directly below a node, in field order."""
    found: tuple[Any, ...] = ()
    kind: Any = type(node)
    for name, sort in _shape(kind):
        value = getattr(node, name)
        if sort in ("numbers", "formulas"):
            found = found + value if found else value
        elif sort == "bindings":
            found = (*found, *(num for _, num in value))
        else:
            found = (*found, value)
    return found


def map_children(
    node: N,
    *,
    formulas: Callable[[Any], Any] | None = None,
    numbers: Callable[[ir.Num], ir.Num] | None = None,
) -> N:
    """Return a node with its children replaced, or the node itself if none changes.

    Args:
        node: a formula or a number.
        formulas: function from a child formula to its replacement; None keeps all formulas.
        numbers: function from a child number to its replacement; None keeps all numbers.
    """
    changed: dict[str, Any] = {}
    kind: Any = type(node)
    for name, sort in _shape(kind):
        change: Callable[[Any], Any] | None = formulas if sort.startswith("formula") else numbers
        if change is None:
            continue
        value = getattr(node, name)
        if sort in ("formula", "number"):
            new = change(value)
            same = new is value
        elif sort == "bindings":
            new = tuple((bound, change(num)) for bound, num in value)
            same = all(a is b for (_, a), (_, b) in zip(new, value, strict=True))
        else:
            new = tuple(map(change, value))
            same = all(a is b for a, b in zip(new, value, strict=True))
        if not same:
            changed[name] = new
    return replace(node, **changed) if changed else node


@cache
def _formulas_of(kind: Any) -> tuple[tuple[str, bool], ...]:
    """Return (name, several) of each field of a node class (`kind`) that contains formulas.

    `several` is True for a tuple of formulas, False for a single formula. For `Recalled`, a past operator
    rewritten with timers, the only field is `now`.
    """
    found = ((name, sort == "formulas") for name, sort in _shape(kind) if sort.startswith("formula"))
    return (("now", False),) if kind is typed.Recalled else tuple(found)


@overload
def operands(formula: ir.Formula) -> tuple[ir.Formula, ...]: ...
@overload
def operands(formula: typed.Formula) -> tuple[typed.Formula, ...]: ...
def operands(formula: Any) -> tuple[Any, ...]:
    """Return the formulas directly below a formula.

    For `Recalled`, a past operator rewritten with timers, this is only its field `now`.
    """
    found: tuple[Any, ...] = ()
    kind: Any = type(formula)
    for name, several in _formulas_of(kind):
        value = getattr(formula, name)
        found += value if several else (value,)
    return found


# ---------------------------------------------------------------------------- all the way down


@overload
def nodes(formula: ir.Formula) -> Iterator[ir.Formula]: ...
@overload
def nodes(formula: typed.Formula) -> Iterator[typed.Formula]: ...
def nodes(formula: Any) -> Iterator[Any]:
    """Yield a formula and all its sub-formulas; the conditions in numbers (`if`, `ind`) are left out."""
    yield formula
    for part in operands(formula):
        yield from nodes(part)


def numbers(formula: ir.Formula | typed.Formula) -> Iterator[ir.Num]:
    """Yield the numbers in a formula: those of its predicates, and those bound by `freeze`."""
    for node in nodes(formula):
        yield from (child for child in children(node) if isinstance(child, _NUMBERS))


def subexpressions(num: Node) -> Iterator[ir.Num]:
    """Yield a number and all numbers in it, including those in its conditions (`if`, `ind`)."""
    stack: list[Any] = [num]
    while stack:
        part = stack.pop()
        if isinstance(part, _NUMBERS):
            yield part
        if not isinstance(part, LEAVES):
            stack.extend(reversed(children(part)))


def leaves(num: Node) -> Iterator[NumberLeaf]:
    """Yield the constants, signals and frozen values of a number, including those in its conditions."""
    stack: list[Any] = [num]
    while stack:
        part = stack.pop()
        if isinstance(part, LEAVES):
            yield part
        else:
            stack.extend(reversed(children(part)))


def map_leaves(node: N, change: Callable[[ir.Num], ir.Num]) -> N:
    """Return a number or a formula with each constant, signal and frozen value replaced by `change(leaf)`."""
    if isinstance(node, LEAVES):
        return change(node)  # type: ignore[return-value]

    def below(child: Any) -> Any:
        return map_leaves(child, change)

    return map_children(node, formulas=below, numbers=below)


# ---------------------------------------------------------------------------------- numbers


def key_of(leaf: ir.Signal | ir.ShiftedSignal | ir.FrozenVar) -> str:
    """Return the name of the input of a compiled program that provides a signal or a frozen value.

    A shifted signal is an input of its own; the name of this input contains the number of steps.
    """
    if isinstance(leaf, ir.ShiftedSignal):
        return f"{leaf.name}\0{leaf.steps}{'!' * leaf.clamped}"
    return leaf.name


def frozen_in(num: ir.Num) -> frozenset[str]:
    """Return the names of the frozen values (bound by `freeze`) that a number reads."""
    return frozenset(leaf.name for leaf in leaves(num) if isinstance(leaf, ir.FrozenVar))


def shifted(num: ir.Num, steps: int, *, clamped: bool = False, delay: typed.Time | None = None) -> ir.Num:
    """Return a number shifted in time by `steps` samples (positive: later).

    If `delay` is given, the number is shifted by this time in addition. Outside the trace a `clamped` number
    repeats the first or last sample.
    """

    def moved(leaf: ir.Num) -> ir.Num:
        if not isinstance(leaf, (ir.Signal, ir.ShiftedSignal)):
            return leaf
        there, ends, later = steps, clamped, delay
        if isinstance(leaf, ir.ShiftedSignal):
            there, ends = there + leaf.steps, ends or leaf.clamped
        if isinstance(leaf, typed.DelayedSignal):
            later = leaf.delay.plus(delay)
        if later is not None:
            return typed.DelayedSignal(leaf.name, there, ends, later)
        return ir.ShiftedSignal(leaf.name, there, ends) if there else ir.Signal(leaf.name)

    return map_leaves(num, moved)


def substitute_frozen(node: N, values: Mapping[str, ir.Num]) -> N:
    """Replace free frozen values in a number or a formula; `values` gives the replacement for each name.

    Names that an inner `freeze` binds again are not replaced.
    """
    if isinstance(node, ir.FrozenVar):
        return values.get(node.name, node)  # type: ignore[return-value]

    def below(child: Any) -> Any:
        return substitute_frozen(child, values)

    if not isinstance(node, (ir.Freeze, typed.Freeze)):
        return map_children(node, formulas=below, numbers=below)
    own = {name for name, _ in node.bindings}
    outer = {name: value for name, value in values.items() if name not in own}
    return map_children(node, formulas=lambda body: substitute_frozen(body, outer), numbers=below)


# --------------------------------------------------------------------------- typed formulas


def margin_unit(formula: typed.Formula) -> str:
    """Return the unit of a formula's robustness; "" if its predicates have different units."""
    predicates = (node for node in nodes(formula) if isinstance(node, typed.Predicate) and not node.guard)
    found = {node.unit.text for node in predicates}
    return found.pop() if len(found) == 1 else ""


def on_clock(node: typed.Formula) -> TypeGuard[typed.Temporal | typed.Until]:
    """True for a temporal operator whose interval counts from the start of the mission (`always@[a, b]`)."""
    return isinstance(node, (typed.Temporal, typed.Until)) and node.interval.clock == "start"


def from_now(node: typed.Temporal | typed.Until) -> typed.Temporal | typed.Until:
    """Return an operator such as `always@[a, b]` with its interval relative to now (`always[a, b]`).

    At the first sample of a trace, the two operators mean the same.
    """
    return replace(node, interval=replace(node.interval, clock="now"))


def absolute(formula: typed.Formula) -> bool:
    """True if a formula has an operator whose interval counts from the mission's start (`always@[a, b]`)."""
    return any(map(on_clock, nodes(formula)))


def looks_back(formula: typed.Formula) -> bool:
    """True if a formula has a past operator."""
    past = ("once", "historically", "since", "rise", "fall")
    return any(getattr(node, "op", None) in past for node in nodes(formula))


def is_state(formula: typed.Formula, *, augmented: bool = False) -> bool:
    """True for a state formula, whose truth depends on one instant (and on enclosing frozen values).

    Args:
        formula: typed formula.
        augmented: whether the formula is for training. If so, two rules change. `Recalled` nodes, which are
            past operators rewritten with timers, count as state formulas. Formulas with frozen values do not
            count as state formulas, since frozen values come from other instants.
    """
    state: tuple[type, ...] = (typed.Truth, typed.Predicate, typed.Not, typed.Logic)
    elsewhere: tuple[type, ...] = (ir.ShiftedSignal,)
    if augmented:
        state, elsewhere = (*state, typed.Recalled), (ir.ShiftedSignal, ir.FrozenVar)
    return all(isinstance(node, state) for node in nodes(formula)) and not any(
        isinstance(leaf, elsewhere) for num in numbers(formula) for leaf in leaves(num)
    )


def mentions_horizon(formula: typed.Formula) -> bool:
    """True if a bound of a formula is written with the planning horizon `T`."""
    timed = (node.interval for node in nodes(formula) if isinstance(node, (typed.Temporal, typed.Until)))
    return any(end is not None and end.horizons != 0 for each in timed for end in (each.lo, each.hi))


def timer_form(formula: typed.Formula) -> typed.Formula:
    """Return a state formula with its past operators in the form for a single instant.

    The past operators were rewritten with timers before, to `Recalled` nodes. A `Recalled` node has two
    forms: one for a single instant (`now`), one for the samples of a plan (`along`). This function replaces
    each node by `now`, a test of the timers.
    """
    if isinstance(formula, typed.Recalled):
        return timer_form(formula.now)
    return map_children(formula, formulas=timer_form)
