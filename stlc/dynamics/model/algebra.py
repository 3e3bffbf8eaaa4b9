"""Arithmetic on numbers of the IR: the names that a number reads, substitution, sums and products."""

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
    """Apply `rewrite` to the operands of a number, or to the numbers in a state formula's predicates."""
    return map_children(node, numbers=rewrite, formulas=lambda part: map_parts(part, rewrite))


def substitute(node: N, table: Mapping[str, ir.Num]) -> N:
    """Replace the columns that `table` names by its numbers, in a number or a state formula."""
    return map_leaves(node, lambda leaf: table.get(leaf.name, leaf) if isinstance(leaf, ir.Signal) else leaf)


def add(left: ir.Num, right: ir.Num) -> ir.Num:
    """Sum of two numbers."""
    return ir.Op("add", (left, right))


def multiply(left: ir.Num, right: ir.Num) -> ir.Num:
    """Product of two numbers."""
    return ir.Op("mul", (left, right))


class Assignments:
    """Growing list of assignments that name intermediate results, so that each is computed once.

    Attributes:
        lets: (name, number), in order.
    """

    def __init__(self) -> None:
        self.lets: list[tuple[str, ir.Num]] = []

    def name(self, num: ir.Num, pattern: str) -> ir.Num:
        """Append an assignment of `num` to a new name, and return a reference to it.

        `{}` in `pattern`, the form of the name, is replaced by the number of the assignment.
        """
        if isinstance(num, ir.Const | ir.Signal):
            return num
        self.lets.append((pattern.format(len(self.lets)), num))
        return ir.Signal(self.lets[-1][0])
