"""From which instant on a formula no longer changes on a trace that goes on.

Beyond the last sample every predicate is unknown, and so is what is made of nothing else: a window that looks
far beyond a short trace needs one such instant, and not all of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import assert_never

from stlc.compile.ir import nodes as ir


def tail(formula: ir.Formula, samples: int, length: int) -> int | None:
    """An instant from which on the formula has one value, +inf or -inf; None: not that anybody can tell.

    Args:
        formula: in negation normal form.
        samples: how many are known.
        length: where windows to the end of the trace end.
    """
    match formula:
        case ir.Truth():
            return 0
        case ir.Predicate():
            return samples
        case ir.Freeze() | ir.AtStart():
            return None
        case ir.BoolOp(_, items):
            return _latest(items, samples, length)
        case ir.Temporal(_, window, body):
            return _ahead(_latest((body,), samples, length), window, window.lo, length)
        case ir.Until(_, window, left, right):
            return _ahead(_latest((left, right), samples, length), window, 0, length)
        case ir.PastTemporal(_, window, body):
            return _behind(_latest((body,), samples, length), window)
        case ir.Since(_, window, left, right):
            return _behind(_latest((left, right), samples, length), window)
        case ir.Shift(steps, body):
            found = _latest((body,), samples, length)
            return None if found is None else max(found - steps, -steps, 0)
        case _:
            assert_never(formula)


def _latest(parts: Iterable[ir.Formula], samples: int, length: int) -> int | None:
    """From where on none of them changes."""
    latest = 0
    for part in parts:
        found = tail(part, samples, length)
        if found is None:
            return None
        latest = max(latest, found)
    return latest


def _ahead(found: int | None, window: ir.Window, first: int, length: int) -> int | None:
    """Of a window of the future; one to the end is unknown where it starts beyond the end."""
    if found is None:
        return None
    return max(found - first, 0 if window.hi is not None else length - window.lo, 0)


def _behind(found: int | None, window: ir.Window) -> int | None:
    """Of a window of the past; one from the start on has seen everything that is known."""
    if found is None:
        return None
    return found + (window.hi if window.hi is not None else window.lo + 1)
