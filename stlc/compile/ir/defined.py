"""Where a formula has a value on a finite trace without cutting any window of the future.

Windows of the past are cut at the start of the trace and so are always defined; `prev`, `next` and `shift`
are not defined outside the trace, and neither is a window that reaches beyond its last sample. A window
"to the end" is defined where it has a sample.
"""

from __future__ import annotations

from functools import reduce
from typing import TypeAlias, assert_never

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.samples import Reach, reach_of

Defined: TypeAlias = NDArray[np.bool_]


def defined(formula: ir.Formula, samples: int) -> Defined:
    """For every sample of a trace with `samples` of them: has `formula` a value there? Shape `(samples,)`."""
    match formula:
        case ir.Truth():
            return np.ones(samples, dtype=bool)
        case ir.Predicate(num):
            return _within(reach_of(num), samples)
        case ir.Freeze(bindings, body):
            bound = [_within(reach_of(num), samples) for _, num in bindings]
            return reduce(np.logical_and, bound, defined(body, samples))
        case ir.BoolOp(_, items):
            return reduce(np.logical_and, [defined(item, samples) for item in items])
        case ir.Temporal(_, window, body) | ir.PastTemporal(_, window, body):
            seen = _future if isinstance(formula, ir.Temporal) else _past
            return _throughout(defined(body, samples), *seen(window, samples))
        case ir.Until(_, window, left, right):
            first, last = _future(window, samples)
            now = np.arange(samples)
            held = _throughout(defined(left, samples), now, np.maximum(last, now))
            return held & _throughout(defined(right, samples), first, last)
        case ir.Since(_, window, left, right):
            first, last = _past(window, samples)
            now = np.arange(samples)
            held = _throughout(defined(left, samples), np.where(last < 0, now + 1, first), now)
            return held & _throughout(defined(right, samples), first, last)
        case ir.Shift(steps, body, outside):
            return _shifted(defined(body, samples), steps, outside is not None)
        case ir.AtStart(body):
            return np.full(samples, defined(body, samples)[0])
        case _:
            assert_never(formula)


def _within(reach: Reach, samples: int) -> Defined:
    """Where all samples that a number reads exist."""
    now = np.arange(samples)
    return np.asarray((now >= reach.past) & (now < samples - reach.future))


def _future(window: ir.Window, samples: int) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """First and last instant of the window of every sample."""
    now = np.arange(samples)
    if window.hi is not None:
        return now + window.lo, now + window.hi
    beyond = now + window.lo >= samples
    return now + window.lo, np.where(beyond, samples, samples - 1)


def _past(window: ir.Window, samples: int) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    now = np.arange(samples)
    first = np.zeros_like(now) if window.hi is None else np.maximum(now - window.hi, 0)
    return first, now - window.lo


def _throughout(inside: Defined, first: NDArray[np.int_], last: NDArray[np.int_]) -> Defined:
    """Whether all instants first..last lie within the trace and are defined; true for none at all."""
    samples = len(inside)
    known = int(np.argmin(inside)) if not inside.all() else samples
    if not inside[known:].any():  # what looks ahead only is defined up to some sample
        return np.asarray(((last < known) | (last < first)) & (last < samples))
    missing = np.concatenate([[0], np.cumsum(~inside)])
    low, high = np.clip(first, 0, samples), np.clip(last + 1, 0, samples)
    whole = missing[np.maximum(high, low)] == missing[low]
    return np.asarray(whole & (last < samples))


def _shifted(inside: Defined, steps: int, filled: bool) -> Defined:
    now = np.arange(len(inside)) + steps
    within = (now >= 0) & (now < len(inside))
    return np.where(within, inside[np.clip(now, 0, len(inside) - 1)], filled)
