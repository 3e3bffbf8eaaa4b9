"""Algebra on numeric expressions: substitution, sums and products.

The expressions are in the compiler's intermediate representation (IR).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import map_children, map_leaves

N = TypeVar("N", ir.Num, ir.Formula)


def map_parts(node: N, rewrite: Callable[[ir.Num], ir.Num]) -> N:
    """Return `node` with `rewrite` applied to its direct operands.

    For a state formula, `rewrite` is applied to the numeric expressions in its predicates.
    """
    return map_children(node, numbers=rewrite, formulas=lambda part: map_parts(part, rewrite))


def substitute(node: N, table: Mapping[str, ir.Num]) -> N:
    """Replace the columns in `node` by expressions; `table` maps column -> expression.

    `node` is a numeric expression or a state formula.
    """
    return map_leaves(node, lambda leaf: table.get(leaf.name, leaf) if isinstance(leaf, ir.Signal) else leaf)


def add(left: ir.Num, right: ir.Num) -> ir.Num:
    """Sum of two numeric expressions."""
    return ir.Op("add", (left, right))


def total(parts: Sequence[ir.Num]) -> ir.Num:
    """Sum of one or more numeric expressions, as a tree of little depth."""
    if len(parts) == 1:
        return parts[0]
    half = len(parts) // 2
    return add(total(parts[:half]), total(parts[half:]))


def multiply(left: ir.Num, right: ir.Num) -> ir.Num:
    """Product of two numeric expressions."""
    return ir.Op("mul", (left, right))


class Assignments:
    """Growing list of assignments that name intermediate results, so that each is computed once.

    Attributes:
        lets: (name, numeric expression), in order.
    """

    def __init__(self) -> None:
        self.lets: list[tuple[str, ir.Num]] = []

    def name(self, num: ir.Num, pattern: str) -> ir.Num:
        """Append an assignment of `num` to a new name, and return a reference to it.

        `pattern` is the form of the name: `{}` in it is replaced by the index of the assignment. A constant
        or a column is returned unchanged, without an assignment.
        """
        if isinstance(num, ir.Const | ir.Signal):
            return num
        self.lets.append((pattern.format(len(self.lets)), num))
        return ir.Signal(self.lets[-1][0])
