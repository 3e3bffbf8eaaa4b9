"""Bounds on the robustness of a formula on a trace with unknown values.

An unknown sample is NaN in the arrays. A function outside of its domain, such as `sqrt(-1)` or `0 / 0`, is
NaN too, and so is `inf - inf`. A predicate that reads such a value counts as -inf in the lower bound, and as
+inf in the upper bound. The robustness of a formula never falls if the value of a predicate rises. Therefore
a verdict that follows from the bounds is true for all values that are possible in these places.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.ranges import has_value

Floats: TypeAlias = NDArray[np.float64]
Names: TypeAlias = frozenset[str]

KNOWN = "@known "
"""Prefix of the column that is 1 where the signal of that name is known, else -1."""

_NAN = ir.Const(math.nan)
_INFINITE = "@infinite"
"""Stands among the values that may be NaN for the result of any function: signals are infinite."""


def holes_in(env: Mapping[str, Floats]) -> Names:
    """Return the names of the signals that contain NaN."""
    return frozenset(name for name, values in env.items() if np.count_nonzero(np.isnan(values)))


def without_holes(env: Mapping[str, Floats], holes: Iterable[str]) -> dict[str, Floats]:
    """Return the signals with some number for NaN, and for each of `holes` a signal that marks them.

    It is 1 at known and -1 at unknown samples. All arrays are (samples, batch).
    """
    filled = dict(env)
    for name in holes:
        unknown = np.isnan(env[name])
        known = env[name][~unknown]
        filled[name] = np.where(unknown, known[0] if known.size else 0.0, env[name])
        filled[KNOWN + name] = np.where(unknown, -1.0, 1.0)
    return filled


@lru_cache(maxsize=512)
def partial(formula: ir.Formula) -> bool:
    """True if a formula calls a function outside of whose domain the signals may be."""
    return any(_is_partial(num, frozenset()) for num in formula.numbers())


@lru_cache(maxsize=512)
def unsure(
    formula: ir.Formula, holes: Names, *, least: bool, computed: bool = True, infinite: bool = False
) -> ir.Formula:
    """Return a formula whose value is a bound on `formula` for all values that are unknown.

    Args:
        formula: in negation normal form (negations occur only in predicates).
        holes: names of the signals with unknown values; names under which a `freeze` stores them are added.
        least: True for the lower bound, False for the upper bound.
        computed: whether NaN that a function gives outside of its domain is unknown too.
        infinite: whether signals may be infinite, so that any function may give NaN, as `inf - inf` does.
    """
    nans = frozenset({_INFINITE} if infinite else ()) if computed else None
    return _unsure(formula, holes, nans, least=least)


def _unsure(formula: ir.Formula, holes: Names, nans: Names | None, *, least: bool) -> ir.Formula:
    """`nans` are the frozen values that may be NaN (see `_INFINITE`); None if computed NaN is not unknown."""
    match formula:
        case ir.Predicate(num=num):
            atom, known = formula, _known(num, holes)
            if nans is not None and _is_partial(num, nans):  # the margin is -inf or inf in place of NaN
                margin = _with_nan(num, nans)
                other = ir.Const(-math.inf if least is (atom.sign > 0) else math.inf)
                atom = replace(atom, num=_is_number(margin).select(margin, other))
            if known is None:
                return atom
            # outside of the trace the guard equals the predicate: false before a negation if windows are cut
            guard = known if least is (atom.sign > 0) else -known
            test = ir.Predicate(guard, sign=atom.sign, guard=True)
            return ir.BoolOp("and" if least else "or", (atom, test))
        case ir.Freeze(bindings=bindings, body=body):
            tests = {name: found for name, num in bindings if (found := _known(num, holes)) is not None}
            bound = frozenset(name for name, _ in bindings)
            if nans is not None:
                lost = frozenset(name for name, num in bindings if _is_partial(num, nans))
                bindings = tuple((name, _with_nan(num, nans)) for name, num in bindings)
                nans = (nans - bound) | lost
            inner = _unsure(body, (holes - bound) | frozenset(tests), nans, least=least)
            more = tuple((KNOWN + name, num) for name, num in tests.items())
            return replace(formula, bindings=(*bindings, *more), body=inner)
        case _:
            return formula.map_children(formulas=lambda part: _unsure(part, holes, nans, least=least))


def _known(num: ir.Num, holes: Names) -> ir.Num | None:
    """An expression that is 1 where all signals in `num` are known, else -1; None if they all are."""
    found = dict.fromkeys(
        replace(leaf, name=KNOWN + leaf.name)
        for leaf in num.leaves()
        if isinstance(leaf, (ir.Signal, ir.ShiftedSignal, ir.FrozenVar)) and leaf.name in holes
    )
    if not found:
        return None
    return next(iter(found)) if len(found) == 1 else ir.Op("min", tuple(found))


def _is_partial(num: ir.Num, nans: Names) -> bool:
    """True if a number may depend on NaN although its signals are known; `nans` are such frozen values."""
    return any(
        (isinstance(part, ir.Op) and (_INFINITE in nans or not has_value(part)))
        or (isinstance(part, ir.FrozenVar) and part.name in nans)
        or (isinstance(part, ir.Extern) and _returns_nan(part))
        for part in num.subexpressions()
    )


def _returns_nan(call: ir.Extern) -> bool:
    """True if a function of the system may return NaN, as any Python function may."""
    body = call.function
    if not isinstance(body, ir.Body):
        return True
    return any(_is_partial(num, frozenset()) for num in (*(num for _, num in body.lets), *body.outputs))


def _is_number(num: ir.Num) -> ir.Formula:
    """Return a condition that is false where a number is NaN, since no comparison with NaN is true."""
    return ir.Predicate(num.apply("abs"))


def _with_nan(num: ir.Num, nans: Names) -> ir.Num:
    """Return the number with NaN wherever it depends on NaN.

    Conditions (`if`, `ind`), false on NaN, and functions of the system would give a value there.
    """
    if not _is_partial(num, nans):
        return num
    num = num.map_children(numbers=lambda part: _with_nan(part, nans))
    match num:
        case ir.Where(cond, yes, no):
            return _chosen(cond, yes, no, nans)
        case ir.Indicator(cond):
            lost = any(_is_partial(part, nans) for part in cond.numbers())
            return _chosen(cond, ir.Const(1.0), ir.Const(0.0), nans) if lost else num
        case ir.Extern(args=args):
            for arg in args:
                num = _is_number(arg).select(num, _NAN) if _is_partial(arg, nans) else num
            return num
        case _:
            return num


def _chosen(cond: ir.Formula, yes: ir.Num, no: ir.Num, nans: Names) -> ir.Num:
    """Return `yes` where a condition holds, `no` where it does not, and NaN where that is unknown."""
    holds, may_hold = (_unsure(cond, frozenset(), nans, least=least) for least in (True, False))
    if holds is may_hold:
        return cond.select(yes, no)
    return holds.select(yes, may_hold.select(_NAN, no))
