"""Unknown samples: bounds of a formula's robustness over all values that the unknown samples may have.

In arrays an unknown value is NaN. The bounds are computed as for a trace that is still growing
(`stlc.monitor.prefix_bounds`): a predicate that reads an unknown value is -inf in the lower bound and +inf in
the upper one. All operators are monotone in their predicates, so a verdict that follows from the bounds holds
for every value that the samples may have.
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
"""Prefix of the column that is 1 where the signal of that name is known, else -1."""


def holes_in(env: Mapping[str, Floats]) -> frozenset[str]:
    """Return the names of the signals that contain NaN."""
    return frozenset(name for name, values in env.items() if np.isnan(values).any())


def without_holes(env: Mapping[str, Floats], holes: Iterable[str]) -> dict[str, Floats]:
    """Return the signals (samples, batch) with NaN replaced by numbers, and indicators of known samples.

    One indicator (samples, batch) is added for each signal in `holes`: 1 at known, -1 at unknown samples.
    """
    filled = dict(env)
    for name in holes:
        unknown = np.isnan(env[name])
        known = env[name][~unknown]
        filled[name] = np.where(unknown, known[0] if known.size else 0.0, env[name])
        filled[KNOWN + name] = np.where(unknown, -1.0, 1.0)
    return filled


@lru_cache(maxsize=512)
def unsure(formula: ir.Formula, holes: frozenset[str], *, least: bool) -> ir.Formula:
    """Return a formula whose value bounds that of `formula`, whatever values the unknown samples have.

    Args:
        formula: in negation normal form (negations occur only in predicates).
        holes: names of the signals with unknown values. A name that a `freeze` binds to such a signal is
            treated in the same way.
        least: True for the lower bound (least value), False for the upper bound (greatest value).
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
    """An expression that is 1 where all signals in `num` are known, else -1; None if always known."""
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
    # outside of the trace the guard equals the predicate: false before a negation where windows are cut
    test = ir.Predicate(
        known if least is (atom.sign > 0) else ir.Op("neg", (known,)), sign=atom.sign, guard=True
    )
    return ir.BoolOp("and" if least else "or", (atom, test))
