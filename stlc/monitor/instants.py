"""Instants at which a requirement is evaluated, and its values there.

An instant is a sample of the trace. A requirement that mentions the horizon `T` applies to every planning
window: it is evaluated at each sample that a full window of length `T` follows. In its formula, `end` is the
end of this window. Other requirements are evaluated once, at the start of the trace. So are requirements with
absolute operators (`always@[a, b]`), whose interval counts from the start of the mission.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.array.namespace import Array
from stlc.compile.ir.defined import defined
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import CompiledRequirement
from stlc.compile.schedule.schedule import Boundary
from stlc.diagnostics import Diagnostic, UsageError
from stlc.monitor.values import Ends, Record, bounds, window_bounds

At: TypeAlias = int | Literal["all"] | None
"""A sample; every start at which the requirement has a value; or the instants of the requirement itself."""


def starts_of(rule: CompiledRequirement, samples: int, horizon: int | None, at: At) -> range:
    """Return the instants at which a requirement is evaluated on a trace of `samples` samples.

    `at` is the number of one sample, or "all" for every sample with a complete window, or None for the
    instants that the requirement prescribes. `horizon` is the length of a planning window in steps.

    Raises:
        UsageError: U101, `at` is not a sample of the trace.
    """
    if isinstance(at, int):
        if not 0 <= at < samples:
            message = f"there is no sample {at}: the trace has {samples}, counted from 0"
            raise UsageError(Diagnostic("U101", message))
        return range(at, at + 1)
    if rule.absolute:
        return range(1)
    if rule.windowed and horizon is not None:
        return range(max(samples - horizon, 1))
    if at == "all":
        return range(max(samples - rule.reach, 1))
    return range(1)


def window_of(rule: CompiledRequirement, horizon: int | None) -> int | None:
    """Number of samples from an instant to `end`, the end of the planning window that begins there.

    None if the formula does not mention `end`, or if the requirement is not evaluated for every planning
    window.
    """
    return horizon if rule.windowed and rule.uses_end and not rule.absolute else None


def rule_bounds(
    rule: CompiledRequirement, record: Record, starts: range, horizon: int | None, ends: Ends
) -> tuple[Array, Array]:
    """Lower and upper bounds on the robustness at the instants `starts`, each `(count, batch)`.

    The bounds hold for all values that unknown samples may have. If nothing is unknown, the same array is
    returned twice. `horizon` is the length of a planning window in steps. `ends` is the treatment of windows
    that extend beyond the trace: "open" leaves the missing samples unknown, "truncate" clips the windows.
    """
    window = window_of(rule, horizon)
    if window is None:
        return bounds(rule.under(record.semantics), record, starts, ends)
    return window_bounds(rule.under(record.semantics), record, starts, window, ends)


def rule_known(
    rule: CompiledRequirement, samples: int, starts: range, horizon: int | None
) -> NDArray[np.bool_]:
    """Return for each instant in `starts` whether its value is exact: booleans, (count,).

    The trace has `samples` samples. A value is exact if it depends on no samples after the end of the trace.
    `horizon` is the length of a planning window in steps.
    """
    window = window_of(rule, horizon)
    if window is None:
        return np.array(defined(rule.formula, samples)[starts.start : starts.stop], dtype=bool)
    whole = bool(defined(rule.formula, window + 1)[0])
    return np.array([whole and start + window < samples for start in starts], dtype=bool)


def rule_signal(rule: CompiledRequirement, record: Record, horizon: int | None, end: Boundary) -> Array:
    """Return the robustness at every sample, `(samples, batch)`.

    `end` is the treatment of windows that extend beyond the trace: "strict" gives NaN, "truncate" clips them,
    "lower" and "upper" give a bound. Unknown samples inside the trace have the same effect: NaN, or the bound
    if `end` is "lower" or "upper". A requirement with absolute operators (`always@[a, b]`) has the same value
    at all samples.
    """
    sides = _sides(rule, record)
    if sides is not None:
        least, most = (rule_signal(each, record.sure, horizon, end) for each in sides)
        return _agreed(least, most, record, end)
    if rule.absolute:
        (value,) = rules_at([rule], record, 0, horizon, end)
        return record.ops.cat([value] * record.samples)
    if window_of(rule, horizon) is None:
        formula = rule.under(record.semantics)
        return robustness_signal(formula, record.env, ops=record.ops, semantics=record.semantics, end=end)
    return _window_signal(rule, record, horizon or 0, end)


def _window_signal(rule: CompiledRequirement, record: Record, window: int, end: Boundary) -> Array:
    """Compute `rule_signal` for a requirement that mentions `end`, the last sample of a planning window.

    The planning window of an instant ends `window` samples after it. If the argument `end` is "strict",
    values are NaN where the planning window extends beyond the trace.
    """
    whole = max(record.samples - window, 0)
    starts = range(whole if end == "strict" else record.samples)
    ends: Ends = "truncate" if end == "truncate" else "open"
    parts = []
    if starts:
        low, high = window_bounds(rule.under(record.semantics), record, starts, window, ends)
        parts.append(high if end == "upper" else low)
    if len(starts) < record.samples:
        like = next(iter(record.env.values()))
        parts.append(record.ops.full((record.samples - len(starts), like.shape[1]), math.nan, like))
    return record.ops.cat(parts)


def rules_at(
    rules: Sequence[CompiledRequirement], record: Record, at: int, horizon: int | None, end: Boundary
) -> list[Array]:
    """Robustness of several requirements at sample `at`, `(1, batch)` each.

    `end` is the treatment of windows that extend beyond the trace, as in `rule_signal`. `horizon` is the
    length of a planning window in steps.
    """
    sides = [_sides(rule, record) for rule in rules]
    if any(sides):
        pairs = [side for side in sides if side is not None]
        others = [rule for rule, side in zip(rules, sides, strict=True) if side is None]
        least, most, known = (
            iter(rules_at(each, record.sure, at, horizon, end))
            for each in (*zip(*pairs, strict=True), others)
        )
        return [
            next(known) if side is None else _agreed(next(least), next(most), record, end) for side in sides
        ]
    starts_of_all = [starts_of(rule, record.samples, horizon, 0 if rule.absolute else at) for rule in rules]
    formulas = [rule.under(record.semantics) for rule in rules]
    together = [
        formula
        for rule, formula, starts in zip(rules, formulas, starts_of_all, strict=True)
        if starts.start == at and window_of(rule, horizon) is None and _has_value(rule, record, at, end)
    ]
    here = range(at, at + 1)
    values = dict(zip(together, record.values(together, here, end), strict=True)) if together else {}
    return [
        values[formula] if formula in values else _alone(rule, record, starts.start, horizon, end)
        for rule, formula, starts in zip(rules, formulas, starts_of_all, strict=True)
    ]


def _sides(
    rule: CompiledRequirement, record: Record
) -> tuple[CompiledRequirement, CompiledRequirement] | None:
    """Return two copies of a requirement, for a lower and an upper bound on its robustness.

    The bounds hold for all unknown values. None is returned if no value that the requirement reads can be
    unknown.
    """
    least, most = record.sides(rule.under(record.semantics))
    if least is most:
        return None
    return replace(rule, formula=least, lowered=least), replace(rule, formula=most, lowered=most)


def _agreed(least: Array, most: Array, record: Record, end: Boundary) -> Array:
    if end in ("lower", "upper"):
        return least if end == "lower" else most
    return record.ops.where(least == most, least, math.nan)


def _has_value(rule: CompiledRequirement, record: Record, at: int, end: Boundary) -> bool:
    return end != "strict" or bool(defined(rule.formula, record.samples)[at])


def _alone(rule: CompiledRequirement, record: Record, at: int, horizon: int | None, end: Boundary) -> Array:
    window = window_of(rule, horizon)
    stop = None if window is None else at + window + 1
    inner = record if stop is None else record.cut(stop)
    whole = stop is None or stop <= record.samples
    if end == "strict" and not (whole and _has_value(rule, inner, at, end)):
        like = next(iter(record.env.values()))
        return record.ops.full((1, like.shape[1]), math.nan, like)
    going_on = not whole and end in ("lower", "upper")
    formula = rule.under(record.semantics)
    return inner.values([formula], range(at, at + 1), end, stop if going_on else None)[0]


def check_length(rule: CompiledRequirement, samples: int, starts: range, grid: Grid) -> Diagnostic | None:
    """Return finding E306 if the robustness at `starts` needs more samples than the trace has, else None."""
    window = window_of(rule, grid.horizon) or 0
    fits = starts.stop - 1 + window < samples
    if fits and defined(rule.formula, samples)[starts.start : starts.stop].all():
        return None
    unit, step = ("samples", 1.0) if grid.dt is None else ("s", float(grid.dt))
    needed, length = (starts.stop - 1 + max(rule.reach, window)) * step, (samples - 1) * step
    return Diagnostic(
        "E306",
        f"this needs {needed:.6g} {unit} of signal; the trace has {length:.6g} {unit}",
        rule.typed.written.span,
        help=(
            f"record {needed - length:.6g} {unit} more, or shorten the intervals",
            "`--end truncate` evaluates on what there is",
        ),
    )
