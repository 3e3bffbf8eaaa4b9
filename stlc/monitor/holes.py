"""Samples that nobody knows: what a formula is worth at least and at most, whatever they were.

In arrays a value that is not known is NaN. Bounds are those of open traces (`stlc.monitor.prefix_bounds`): a
predicate that reads an unknown value is unknown, -inf at least and +inf at most, and all operators are
monotone in their predicates. So a verdict that follows from the bounds holds for every value that the samples
may have had.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import leaves, map_children

Floats: TypeAlias = NDArray[np.float64]

KNOWN = "@known "
"""A column of this name and that of a signal is 1 where the signal is known, else -1."""


def holes_in(env: Mapping[str, Floats]) -> frozenset[str]:
    """Names of the columns that hold NaN."""
    return frozenset(name for name, values in env.items() if np.isnan(values).any())


def without_holes(env: Mapping[str, Floats], holes: Iterable[str]) -> dict[str, Floats]:
    """The columns (samples, batch) with any value for an unknown one, and those that tell which are known."""
    filled = dict(env)
    for name in holes:
        unknown = np.isnan(env[name])
        known = env[name][~unknown]
        filled[name] = np.where(unknown, known[0] if known.size else 0.0, env[name])
        filled[KNOWN + name] = np.where(unknown, -1.0, 1.0)
    return filled


@lru_cache(maxsize=512)
def unsure(formula: ir.Formula, holes: frozenset[str], *, least: bool) -> ir.Formula:
    """The formula that is worth the least, or the most, that `formula` may be.

    Args:
        formula: in negation normal form.
        holes: signals that are not known everywhere; names that a `freeze` binds to them are found here.
        least: which end of what is possible.
    """
    match formula:
        case ir.Predicate(num=num):
            return _guarded(formula, _known(num, holes), least=least)
        case ir.Freeze(bindings=bindings, body=body):
            known = {name: found for name, num in bindings if (found := _known(num, holes)) is not None}
            bound = frozenset(name for name, _ in bindings)
            inner = unsure(body, (holes - bound) | frozenset(known), least=least)
            more = tuple((KNOWN + name, num) for name, num in known.items())
            return replace(formula, bindings=(*bindings, *more), body=inner)
        case _:
            return map_children(formula, formulas=lambda part: unsure(part, holes, least=least))


def _known(num: ir.Num, holes: frozenset[str]) -> ir.Num | None:
    """A number that is 1 where all that `num` reads is known, else -1; None where it always is."""
    found = dict.fromkeys(
        replace(leaf, name=KNOWN + leaf.name)
        for leaf in leaves(num)
        if isinstance(leaf, (ir.Signal, ir.ShiftedSignal, ir.FrozenVar)) and leaf.name in holes
    )
    if not found:
        return None
    return next(iter(found)) if len(found) == 1 else ir.Op("min", tuple(found))


def _guarded(atom: ir.Predicate, known: ir.Num | None, *, least: bool) -> ir.Formula:
    if known is None:
        return atom
    # outside of the trace the guard is what the predicate is: false before a negation where windows are cut
    test = ir.Predicate(
        known if least is (atom.sign > 0) else ir.Op("neg", (known,)), sign=atom.sign, guard=True
    )
    return ir.BoolOp("and" if least else "or", (atom, test))
