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
