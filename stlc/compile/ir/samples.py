"""Which samples and which frozen values a number reads, and the same number at another sample."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple, assert_never

from stlc.compile.ir import nodes as ir


class Reach(NamedTuple):
    """Samples that a formula or number may look back and ahead from where it is judged."""

    past: int
    future: int


def everything(num: ir.Num) -> Iterator[ir.Num]:
    """A number and its parts, those of its conditions too."""
    yield num
    match num:
        case ir.Const() | ir.Signal() | ir.ShiftedSignal() | ir.FrozenVar():
            return
        case ir.Op(_, args) | ir.Extern(_, args):
            for arg in args:
                yield from everything(arg)
        case ir.Indicator(cond):
            yield from _in_condition(cond)
        case ir.Where(cond, yes, no):
            yield from _in_condition(cond)
            yield from everything(yes)
            yield from everything(no)
        case _:
            assert_never(num)


def _in_condition(cond: ir.Formula) -> Iterator[ir.Num]:
    match cond:
        case ir.Predicate(num):
            yield from everything(num)
        case ir.BoolOp(_, items):
            for item in items:
                yield from _in_condition(item)
        case _:
            return


def leaves(num: ir.Num) -> Iterator[ir.Const | ir.Signal | ir.ShiftedSignal | ir.FrozenVar]:
    """The parts of a number without parts of their own, those of its conditions too."""
    for part in everything(num):
        if isinstance(part, (ir.Const, ir.Signal, ir.ShiftedSignal, ir.FrozenVar)):
            yield part


def key_of(leaf: ir.Signal | ir.ShiftedSignal | ir.FrozenVar) -> str:
    """What a leaf is called among the inputs of a program."""
    if isinstance(leaf, ir.ShiftedSignal):
        return f"{leaf.name}\0{leaf.steps}{'!' * leaf.clamped}"
    return leaf.name


def columns_of(num: ir.Num) -> frozenset[str]:
    """Names of the columns that a number reads, at whatever sample."""
    read = {leaf.name for leaf in leaves(num) if isinstance(leaf, (ir.Signal, ir.ShiftedSignal))}
    return frozenset(read - {ir.ELAPSED})


def held_by(num: ir.Num) -> frozenset[str]:
    """Names of the frozen values that a number reads."""
    return frozenset(leaf.name for leaf in leaves(num) if isinstance(leaf, ir.FrozenVar))


def of_now(num: ir.Num) -> bool:
    """Whether a number follows from the sample at hand alone."""
    return not any(isinstance(leaf, (ir.ShiftedSignal, ir.FrozenVar)) for leaf in leaves(num))


def looks_on(num: ir.Num) -> bool:
    """Whether the value of a number depends on where the trace ends."""
    return any(isinstance(leaf, ir.ShiftedSignal) and leaf.clamped and leaf.steps > 0 for leaf in leaves(num))


def looks_at_ends(num: ir.Num) -> bool:
    """Whether the value of a number depends on where the trace begins, or on where it ends."""
    return any(isinstance(leaf, ir.ShiftedSignal) and leaf.clamped for leaf in leaves(num))


def reach_of(num: ir.Num) -> Reach:
    """How many samples before and after the one at hand have to exist for a number to have a value."""
    steps = [leaf.steps for leaf in leaves(num) if isinstance(leaf, ir.ShiftedSignal) and not leaf.clamped]
    return Reach(max(0, *(-step for step in steps)), max(0, *steps)) if steps else Reach(0, 0)


def farthest(num: ir.Num) -> Reach:
    """How many samples before and after the one at hand a number reads where they exist."""
    steps = [leaf.steps for leaf in leaves(num) if isinstance(leaf, ir.ShiftedSignal)]
    return Reach(max(0, *(-step for step in steps)), max(0, *steps)) if steps else Reach(0, 0)


def mapped(num: ir.Num, change: Callable[[ir.Num], ir.Num]) -> ir.Num:
    """The number with every leaf changed."""
    match num:
        case ir.Const() | ir.Signal() | ir.ShiftedSignal() | ir.FrozenVar():
            return change(num)
        case ir.Op(_, args) | ir.Extern(_, args):
            return replace(num, args=tuple(mapped(arg, change) for arg in args))
        case ir.Indicator(cond):
            return replace(num, cond=_mapped_condition(cond, change))
        case ir.Where(cond, yes, no):
            return ir.Where(_mapped_condition(cond, change), mapped(yes, change), mapped(no, change))
        case _:
            assert_never(num)


def _mapped_condition(cond: ir.Formula, change: Callable[[ir.Num], ir.Num]) -> ir.Formula:
    match cond:
        case ir.Predicate(num):
            return replace(cond, num=mapped(num, change))
        case ir.BoolOp(_, items):
            return replace(cond, items=tuple(_mapped_condition(item, change) for item in items))
        case _:
            return cond


def later(num: ir.Num, steps: int, *, clamped: bool = False) -> ir.Num:
    """The value of a number `steps` samples later; `clamped`: the first or last sample beyond the ends."""

    def moved(leaf: ir.Num) -> ir.Num:
        match leaf:
            case ir.Signal(name):
                return ir.ShiftedSignal(name, steps, clamped) if steps else leaf
            case ir.ShiftedSignal(name, before, end):
                there = before + steps
                return ir.ShiftedSignal(name, there, clamped or end) if there else ir.Signal(name)
            case _:
                return leaf

    return mapped(num, moved)


def thawed(num: ir.Num, values: Mapping[str, ir.Num]) -> ir.Num:
    """The number with frozen values replaced."""
    return mapped(num, lambda leaf: values.get(leaf.name, leaf) if isinstance(leaf, ir.FrozenVar) else leaf)
