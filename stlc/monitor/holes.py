"""Bounds on the robustness of a formula on a trace with unknown samples.

An unknown sample is NaN in the arrays. A predicate that reads it counts as -inf in the lower bound, and as
+inf in the upper bound. The robustness of a formula never falls if the value of a predicate rises. Therefore
a verdict that follows from the bounds is true for all values that the unknown samples may have.
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
    """Return the signals without NaN, and one additional signal per name in `holes`.

    Every NaN is replaced by some number. The additional signal marks where this was done: it is 1 at known
    samples and -1 at unknown samples. All arrays are (samples, batch).
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
    """Return a formula whose value is a bound on `formula` for all values of the unknown samples.

    Args:
        formula: in negation normal form (negations occur only in predicates).
        holes: names of the signals with unknown values. A `freeze` may store such a signal under a name; this
            name then also counts as a signal with unknown values.
        least: True for the lower bound, False for the upper bound.
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
    """Return an expression that is 1 where all signals in `num` are known, else -1.

    None is returned if `num` reads no signal in `holes`, because `num` is then known everywhere.
    """
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
