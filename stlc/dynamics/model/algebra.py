"""Arithmetic on numbers of the IR: names that they read, substitution, sums and products."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import leaves, map_children, map_leaves

N = TypeVar("N", ir.Num, ir.Formula)


def names_in(node: ir.Num | ir.Formula) -> frozenset[str]:
    """Names of all columns that a number or a state formula reads."""
    return frozenset(leaf.name for leaf in leaves(node) if isinstance(leaf, (ir.Signal, ir.ShiftedSignal)))


def map_parts(node: N, rewrite: Callable[[ir.Num], ir.Num]) -> N:
    """A number with its direct parts rewritten, or a state formula with the numbers of its predicates."""
    return map_children(node, numbers=rewrite, formulas=lambda part: map_parts(part, rewrite))


def substitute(node: N, table: Mapping[str, ir.Num]) -> N:
    """A number or a state formula with the columns of `table` replaced."""
    return map_leaves(node, lambda leaf: table.get(leaf.name, leaf) if isinstance(leaf, ir.Signal) else leaf)


def add(left: ir.Num, right: ir.Num) -> ir.Num:
    """Sum of two numbers."""
    return ir.Op("add", (left, right))


def multiply(left: ir.Num, right: ir.Num) -> ir.Num:
    """Product of two numbers."""
    return ir.Op("mul", (left, right))


class Assignments:
    """Assignments that name intermediate results, so that none is duplicated.

    Attributes:
        lets: (name, number), in order.
    """

    def __init__(self) -> None:
        self.lets: list[tuple[str, ir.Num]] = []

    def name(self, num: ir.Num, pattern: str) -> ir.Num:
        """A column that holds `num`; `{}` in the pattern of its name is the number of the assignment."""
        if isinstance(num, ir.Const | ir.Signal):
            return num
        self.lets.append((pattern.format(len(self.lets)), num))
        return ir.Signal(self.lets[-1][0])
