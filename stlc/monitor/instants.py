"""Instants at which a requirement is evaluated, and its values there.

An instant is a sample of the trace. A requirement that mentions the horizon `T` applies to every planning
window: it is evaluated at each sample that a full window of length `T` follows. In its formula, `end` is the
end of this window. Other requirements are evaluated once, at the start of the trace. So are requirements with
absolute operators (`always@[a, b]`), whose interval counts from the start of the mission.
"""

from __future__ import annotations

import math
from dataclasses import replace
from operator import index
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.schedule import Boundary
from stlc.compile.ir.defined import defined_at
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.support import Reach
from stlc.compile.namespace import Array
from stlc.compile.pipeline import CompiledRequirement
from stlc.compile.semantics.tolerance import End
from stlc.diagnostics import Diagnostic, usage
from stlc.monitor.prefix_bounds import FAR, lengthened, prefix_bound, with_seen
from stlc.monitor.uncertain import outer
from stlc.monitor.values import Ends, Record, bounds, window_bounds

At: TypeAlias = int | Literal["all"] | None
"""A sample; every sample with a complete window; or the instants that the requirement prescribes."""


def asked_at(at: Any, end: str, tolerance: float) -> At:
    """Return the instants of a question whose parts mean something. Raises UsageError (U101) for others."""
    if end not in get_args(End):
        raise usage(f"`end` is one of {', '.join(get_args(End))}, not {end!r}")
    if not math.isfinite(tolerance):
        raise usage(f"the tolerance is a finite number, not {tolerance}")
    if at is None:
        return None
    if isinstance(at, str) and at == "all":
        return "all"
    try:
        return index(at)
    except TypeError:
        raise usage(f'`at` is the number of a sample, "all" or None, not {at!r}') from None


def starts_of(rule: CompiledRequirement, samples: int, horizon: int | None, at: At) -> range:
    """Return the instants at which a requirement is evaluated on a trace of `samples` samples.

    `horizon` is the planning window in steps. Raises UsageError (U101) if `at` is no sample of the trace.
    """
    if isinstance(at, int):
        if not 0 <= at < samples:
            message = f"there is no sample {at}: the trace has {samples}, counted from 0"
            raise usage(message)
        return range(at, at + 1)
    if rule.windowed and horizon is not None and not rule.absolute:
        return range(max(samples - horizon, 1))
    return range(max(samples - rule.reach, 1) if at == "all" and not rule.absolute else 1)


def window_of(rule: CompiledRequirement, horizon: int | None) -> int | None:
    """Number of samples from an instant to `end`, the end of the planning window that begins there.

    None if the formula does not mention `end`, or if not every planning window is evaluated.
    """
    return horizon if rule.windowed and rule.uses_end and not rule.absolute else None


def span_of(rule: CompiledRequirement, horizon: int | None) -> Reach:
    """Samples before and after an instant that the value of a requirement there may depend on.

    `FAR` stands for all of them. `horizon` is the length of a planning window in steps.
    """
    formula, window = rule.formula, window_of(rule, horizon)
    ahead = rule.reach if window is None else window
    later = max((num.farthest.future for num in formula.numbers()), default=0)
    lasting = window is None and formula.endless
    past = FAR if rule.absolute or formula.counts else formula.history
    return Reach(past, FAR if lasting else ahead + later)


def rule_bounds(
    rule: CompiledRequirement, record: Record, starts: range, horizon: int | None, ends: Ends
) -> tuple[Array, Array]:
    """Lower and upper bounds on the robustness at the instants `starts`, each `(count, batch)`.

    The bounds hold for all values of unknown samples; if nothing is unknown, they are the same array.
    `horizon` is the length of a planning window in steps. In windows that extend beyond the trace, samples
    are unknown (`ends` is "open"), or the windows are clipped ("truncate"). Where a window begins beyond the
    end of the trace, the bounds hold wherever the trace may end.
    """
    found = _cut_bounds(rule, record, starts, horizon, ends)
    if ends == "open" or not (outside := beyond(rule, starts, record.samples, horizon)).any():
        return found
    return widened(outside, found, live_bounds(rule, record, starts, horizon, ends))


def live_bounds(
    rule: CompiledRequirement, record: Record, starts: range, horizon: int | None, ends: Ends
) -> tuple[Array, Array]:
    """`rule_bounds` of a trace that may go on; the bounds hold wherever it ends."""
    window, cut, parts = window_of(rule, horizon), ends == "truncate", []
    settled = max(record.samples - span_of(rule, horizon).future, starts.start) if cut else starts.start
    if known := range(starts.start, min(settled, starts.stop)):
        parts.append(_cut_bounds(rule, record, known, horizon, ends))
    if rest := range(known.stop, starts.stop):
        formula, grown = rule.under(record.semantics), record.sure
        grown = replace(grown, env=with_seen(grown.env, grown.ops))
        least, most = record.sides(formula)
        least, most = prefix_bound(least, "lower", cut=cut), prefix_bound(most, "upper", cut=cut)
        if window is None:
            (low,) = grown.values([lengthened(least, record.samples)], rest, "lower", FAR)
            (high,) = grown.values([lengthened(most, record.samples)], rest, "upper", FAR)
        elif cut:
            low = window_bounds(least, grown, rest, window, "open")[0]
            high = window_bounds(most, grown, rest, window, "open")[1]
        else:
            low, high = window_bounds(formula, record, rest, window, "open")
        parts.append((low, high))
    low, high = (record.ops.cat(each) for each in zip(*parts, strict=True))
    return low, high


def _cut_bounds(
    rule: CompiledRequirement, record: Record, starts: range, horizon: int | None, ends: Ends
) -> tuple[Array, Array]:
    """`rule_bounds` in which a window that begins beyond the end of the trace is empty if `ends` cuts it."""
    formula, window = rule.under(record.semantics), window_of(rule, horizon)
    if window is None:
        return bounds(formula, record, starts, ends)
    return window_bounds(formula, record, starts, window, ends)


def beyond(rule: CompiledRequirement, starts: range, samples: int, horizon: int | None) -> NDArray[np.bool_]:
    """Instants from which a window of a requirement begins beyond the last sample, (count,).

    `horizon` is the length of a planning window in steps; a trace that holds the whole planning window of an
    instant is not too short there.
    """
    later, clocked = rule.formula.earliest
    window = window_of(rule, horizon)
    least = later if window is None else min(later, window)
    first = samples - least if later else samples
    return np.array([start >= first or clocked >= samples for start in starts], dtype=bool)


def widened(
    where: NDArray[np.bool_], one: tuple[Array, Array], other: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Return bounds `(count, …)` that hold for both of two pairs at the instants `where`, else the first."""
    (low, high), (least, most) = outer(*one), outer(*other)
    rows = where.reshape(-1, *[1] * (low.ndim - 1))
    return np.where(rows, np.minimum(low, least), low), np.where(rows, np.maximum(high, most), high)


def rule_known(
    rule: CompiledRequirement, samples: int, starts: range, horizon: int | None
) -> NDArray[np.bool_]:
    """Instants whose value depends on no sample after the `samples` ones of the trace, (count,).

    `horizon` is the length of a planning window in steps.
    """
    window = window_of(rule, horizon)
    if window is None:
        return np.array([defined_at(rule.formula, samples, range(k, k + 1)) for k in starts], dtype=bool)
    whole = defined_at(rule.formula, window + 1, range(1))
    return np.array([whole and start + window < samples for start in starts], dtype=bool)


def rule_signal(rule: CompiledRequirement, record: Record, horizon: int | None, end: Boundary) -> Array:
    """Return the robustness at every sample, `(samples, batch)`.

    `end` is the treatment of windows that extend beyond the trace: "strict" gives NaN, "truncate" clips them,
    "lower" and "upper" give a bound. Unknown samples inside the trace have the same effect: NaN or the bound.
    A requirement with absolute operators (`always@[a, b]`) has the same value at all samples.
    """
    sides = _sides(rule, record)
    if sides:
        least, most = (rule_signal(each, record.sure, horizon, end) for each in sides)
        return _agreed(least, most, record, end)
    if rule.absolute:
        return record.ops.cat([rule_at(rule, record, 0, horizon, end)] * record.samples)
    if window_of(rule, horizon) is None:
        formula = rule.under(record.semantics)
        return robustness_signal(formula, record.env, ops=record.ops, semantics=record.semantics, end=end)
    return _window_signal(rule, record, horizon or 0, end)


def _window_signal(rule: CompiledRequirement, record: Record, window: int, end: Boundary) -> Array:
    """`rule_signal` of a requirement that mentions `end`, which is `window` samples after each instant."""
    whole = max(record.samples - window, 0)
    starts = range(whole if end == "strict" else record.samples)
    ends: Ends = "truncate" if end == "truncate" else "open"
    parts = []
    if starts:
        low, high = window_bounds(rule.under(record.semantics), record, starts, window, ends)
        parts.append(high if end == "upper" else low)
    if len(starts) < record.samples:
        parts.append(_nan(record, record.samples - len(starts)))
    return record.ops.cat(parts)


def _nan(record: Record, count: int) -> Array:
    like = next(iter(record.env.values()))
    return record.ops.full((count, like.shape[1]), math.nan, like)


def rule_at(rule: CompiledRequirement, record: Record, at: int, horizon: int | None, end: Boundary) -> Array:
    """Robustness of a requirement at sample `at`, `(1, batch)`; the arguments are those of `rule_signal`."""
    sides = _sides(rule, record)
    if sides:
        least, most = (rule_at(each, record.sure, at, horizon, end) for each in sides)
        return _agreed(least, most, record, end)
    start = 0 if rule.absolute else starts_of(rule, record.samples, horizon, at).start
    there, window = range(start, start + 1), window_of(rule, horizon)
    stop = None if window is None else start + window + 1
    inner = record if stop is None else record.cut(stop)
    whole = stop is None or stop <= record.samples
    if end == "strict" and not (whole and defined_at(rule.formula, inner.samples, there)):
        return _nan(record, 1)
    going_on = not whole and end in ("lower", "upper")
    return inner.values([rule.under(record.semantics)], there, end, stop if going_on else None)[0]


def _sides(rule: CompiledRequirement, record: Record) -> tuple[CompiledRequirement, ...]:
    """Requirements for a lower and an upper bound; none if nothing that `rule` reads can be unknown."""
    least, most = record.sides(rule.under(record.semantics))
    if least is most:
        return ()
    return replace(rule, formula=least, lowered=least), replace(rule, formula=most, lowered=most)


def _agreed(least: Array, most: Array, record: Record, end: Boundary) -> Array:
    if end in ("lower", "upper"):
        return least if end == "lower" else most
    return record.ops.where(least == most, least, math.nan)


def check_length(rule: CompiledRequirement, samples: int, starts: range, grid: Grid) -> Diagnostic | None:
    """Return finding E306 if the robustness at `starts` needs more samples than the trace has, else None."""
    window = window_of(rule, grid.horizon) or 0
    fits = starts.stop - 1 + window < samples
    if fits and defined_at(rule.formula, samples, starts):
        return None
    unit, step = ("samples", 1.0) if grid.dt is None else ("s", float(grid.dt))
    last = starts.stop - 1 + max(rule.reach, window)
    needed, length = last * step, (samples - 1) * step
    help_ = ["`--end truncate` evaluates on what there is"]
    message = "this reads samples outside the trace, however long it is"
    if starts == starts_of(rule, samples, grid.horizon, None):  # a longer trace has more of them
        starts = starts_of(rule, last + 1, grid.horizon, None)
    if last >= samples and defined_at(rule.formula, last + 1, starts):
        message = f"this needs {needed:.6g} {unit} of signal; the trace has {length:.6g} {unit}"
        help_.insert(0, f"record {needed - length:.6g} {unit} more, or shorten the intervals")
    return Diagnostic("E306", message, rule.typed.written.span, help=tuple(help_))
