"""Execution of an evaluation schedule (`stlc.compile.backends.schedule`: a list of steps) over arrays.

A step is one sub-formula at a range of instants; its values are an array `(count, batch)`. One program
computes all predicates that are evaluated at the same instants. The step of every other sub-formula has its
own function. The functions are built once for each semantics and array library, and cached.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, TypeAlias, assert_never, final

import numpy as np

from stlc.compile.backends.array.arith import inputs
from stlc.compile.backends.array.batches import Batch, StepSource, batches_of
from stlc.compile.backends.array.frozen import Freezer
from stlc.compile.backends.array.fused import MOST, Fused, fused
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.array.windows import Windows
from stlc.compile.backends.schedule import (
    PICKS,
    IndexRange,
    Schedule,
    ScheduleStep,
    TraceDomain,
    neutral,
    schedule,
    spanning,
)
from stlc.compile.ir import nodes as ir
from stlc.compile.namespace import Array, Ops, Pick
from stlc.diagnostics import Diagnostic, TraceError

Kernel: TypeAlias = Callable[[Sequence[Array], Array], Array]
"""Existing operand values, and any column for shape, dtype and device -> `(count, batch)`."""

Runner: TypeAlias = Callable[..., Array]
"""Previous values, program outputs, columns, and any column for shape, dtype and device -> a step's value."""

MAX_BEYOND = 1 << 24
"""Maximum number of instants beyond the last sample, summed over all sub-formulas."""

MAX_VALUES = 1 << 27
"""Maximum number of values beyond the last sample over all traces: a gigabyte."""

_ENDLESS = 1 << 60
"""Width of a window to the end of the trace, in rows."""


@dataclass(frozen=True)
class ArrayPlan:
    """An evaluation schedule with the programs and functions that compute its steps.

    Attributes:
        schedule: the steps; a step is a sub-formula at a range of instants.
        batches: programs of the predicates.
        sources: number of a predicate's step -> source of its values.
        machine: builder of the functions of the steps.
        runners: functions of the steps, in order.
        beyond: number of instants beyond the last sample, summed over all steps.
    """

    schedule: Schedule
    batches: tuple[Batch, ...]
    sources: Mapping[int, StepSource]
    machine: Machine
    runners: tuple[Runner, ...]
    beyond: int

    @property
    def ops(self) -> Ops:
        """The array library."""
        return self.machine.windows.ops

    @cached_property
    def _fused(self) -> Fused | None:
        """The plan in C; None where NumPy has to evaluate it."""
        windows, domain = self.machine.windows, self.schedule.domain
        exact = windows.ops is NUMPY and windows.semantics.exact
        if not exact or domain.end == "both" or self.beyond or domain.samples > MOST:
            return None
        return fused(self.schedule, self.batches, self.sources, self.machine.unknown)

    def values(self, env: Mapping[str, Array]) -> list[Array]:
        """Return the values of all steps, `(count, batch)` each; `env`: signal name -> array `(time, batch)`.

        Raises:
            TraceError: E306, more than `MAX_BEYOND` instants or more than `MAX_VALUES` values lie beyond the
                trace.
        """
        like = next(iter(env.values()))
        if self.beyond and (self.beyond > MAX_BEYOND or self.beyond * math.prod(like.shape[1:]) > MAX_VALUES):
            raise TraceError(_too_far(self.schedule))
        outputs = [
            batch.program(inputs(batch.program, env, batch.run, self.ops), self.ops) for batch in self.batches
        ]
        values: list[Array] = []
        for runner in self.runners:
            values.append(runner(values, outputs, env, like))
        return values

    def roots(self, env: Mapping[str, Array]) -> list[Array]:
        """Return the values of the formulas, as `values` does."""
        plan, like = self._fused, next(iter(env.values()))
        if plan and like.ndim == 2 and like.size <= MOST and NUMPY.kernel_pays(like):  # type: ignore[attr-defined]
            found = plan.run(env)
            if found is not None:
                return found
        values = self.values(env)
        return [values[root] for root in self.schedule.roots]


def array_plan(
    formulas: Sequence[ir.Formula], run: IndexRange, domain: TraceDomain, windows: Windows
) -> ArrayPlan:
    """Return the evaluation plan of `formulas` at the instants `run`: the steps and their programs.

    A step is one sub-formula at a range of instants. `domain` contains the length of the trace, and the
    treatment of instants beyond its last sample.
    """
    found, machine = schedule(formulas, run, domain), Machine(domain, windows)
    batches, sources = batches_of(found.steps, domain)
    stops = ((step.run.last - domain.samples + 1, step.run.count) for step in found.steps)
    runners = tuple(_runner(step, machine, sources.get(step.number), batches) for step in found.steps)
    return ArrayPlan(found, batches, sources, machine, runners, sum(max(min(stop), 0) for stop in stops))


# -------------------------------------------------------------------------------- steps


@final
@dataclass(frozen=True, slots=True)
class Machine:
    """Builder of the functions that evaluate formulas, for traces of one length.

    Each function computes one step of an evaluation schedule: one sub-formula at a range of instants.

    Attributes:
        domain: length of the traces, and treatment of instants beyond their last sample.
        windows: algorithms for windows, with semantics and array library.
    """

    domain: TraceDomain
    windows: Windows

    @property
    def unknown(self) -> float:
        """Robustness of an unknown predicate: -inf in a lower bound, +inf in an upper bound.

        If `domain.end` is "both", a batch consists of two copies of the trace, one for each bound. The result
        is then the array [-inf, inf].
        """
        if self.domain.end == "both":
            both: Any = np.array([-math.inf, math.inf])
            return both  # type: ignore[no-any-return]
        return math.inf if self.domain.end == "upper" else -math.inf

    def predicate(self, node: ir.Predicate, run: IndexRange, inside: IndexRange) -> Kernel:
        """Return the function that extends a predicate's values from the instants `inside` to all of `run`.

        At instants of `run` that are not `inside`, the predicate `node` is undefined. It is unknown there if
        the trace is open (continues beyond its last sample). Otherwise a predicate is false there, and a
        negated predicate is true.
        """
        outside = self.unknown if self.domain.open else -node.sign * math.inf
        if inside.count <= 0:
            return self._constant(run.count, outside)
        ops, padded = self.windows.ops, self.windows.padded
        missing = inside.start - run.start
        whole = inside.count == run.count

        def kernel(parts: Sequence[Array], like: Array) -> Array:
            known = parts[0]
            if node.guard:
                known = ops.infinite(ops.gt(known, 0.0) if node.strict else ops.ge(known, 0.0), known)
            else:
                known = ops.margin(known)
            if whole:
                return known
            known = padded(known, run.count - missing, outside)
            if not missing:
                return known
            return ops.cat([ops.full((missing, *like.shape[1:]), outside, like), known])

        return kernel

    def bind(self, step: ScheduleStep) -> Kernel:
        """Return the function that computes the values of `step` from the values of its operands.

        A step is one sub-formula at a range of instants. The formula must not be a predicate or a `freeze`.
        """
        node, run = step.node, step.run
        operands = len(step.operands)
        match node:
            case ir.Truth(value):
                return self._constant(run.count, math.inf if value else -math.inf)
            case ir.BoolOp(op):
                pick, ops, join = PICKS[op], self.windows.ops, self.windows.semantics.join
                return lambda parts, _: join(parts, pick, ops)
            case ir.Temporal(op, window) | ir.Until(op, window):
                return self._future(window, run, operands, PICKS[op])
            case ir.PastTemporal(op, window) | ir.Since(op, window):
                return self._past(window, run, operands, PICKS[op])
            case ir.Shift():
                return self._shift(node, run, operands)
            case ir.AtStart():
                full, rows = self.windows.ops.full, run.count
                return lambda parts, like: parts[0] + full((rows, *like.shape[1:]), 0.0, like)
            case ir.Predicate() | ir.Freeze():
                raise TypeError("predicates and frozen values come from programs")
            case _:
                assert_never(node)

    def _constant(self, rows: int, value: float) -> Kernel:
        full = self.windows.ops.full
        return lambda _, like: full((rows, *like.shape[1:]), value, like)

    def _future(self, window: ir.Window, run: IndexRange, operands: int, pick: Pick) -> Kernel:
        """Function that computes a temporal operator over future windows at the instants `run`.

        The function computes an extremum of one operand, or `until` of two. An open trace continues beyond
        its last known sample. On such a trace, an unbounded window may start beyond the final length of the
        trace. At the instant of this window the operator is unknown.

        Args:
            window: window of the operator, relative to each instant.
            run: instants at which the operator is evaluated.
            operands: number of operands; 0 if the windows contain no samples.
            pick: "max" or "min".
        """
        rows = run.count
        beyond = neutral(pick)
        if self.domain.open and window.hi is None:
            rows = min(rows, self.domain.length - window.lo - run.start)
            beyond = self.unknown
        if rows <= 0 or not operands:
            return self._constant(run.count, beyond)
        inner, padded = self._windows(window, operands, pick, rows), self.windows.padded
        if rows == run.count:
            return inner
        return lambda parts, like: padded(inner(parts, like), run.count, beyond)

    def _past(self, window: ir.Window, run: IndexRange, operands: int, pick: Pick) -> Kernel:
        """Function that computes a temporal operator over past windows at the instants `run`.

        Operands are reversed in time, and then treated as for future windows (`_future`).
        """
        ops, reduce = self.windows.ops, self.windows.semantics.reduce
        if not operands:
            return self._constant(run.count, neutral(pick))
        if run.count == 1 and operands == 1:
            return lambda parts, _: reduce(parts[0], pick, ops)
        inner, flip = self._windows(window, operands, pick, run.count), ops.flip
        return lambda parts, like: flip(inner([flip(part) for part in parts], like))

    def _windows(self, window: ir.Window, operands: int, pick: Pick, rows: int) -> Kernel:
        """Function that computes extrema of one operand, or `until` of two, over `rows` sliding windows.

        `window` holds the bounds of a window in steps, counted from the instant of the window. `pick` is
        "max" or "min".
        """
        over, lo = self.windows.over, window.lo
        most = _ENDLESS if window.hi is None else window.hi - lo + 1
        return lambda parts, _: over(parts, pick, count=rows, width=most, lo=lo if operands == 2 else 0)

    def _shift(self, node: ir.Shift, run: IndexRange, operands: int) -> Kernel:
        if node.outside is not None:
            outside = math.inf if node.outside else -math.inf
        elif self.domain.open:
            outside = self.unknown
        else:
            outside = math.inf if node.weak else -math.inf
        if not operands:
            return self._constant(run.count, outside)
        before = min(max(-(run.start + node.steps), 0), run.count)
        ops = self.windows.ops

        def kernel(parts: Sequence[Array], like: Array) -> Array:
            body = parts[0]
            after = run.count - before - body.shape[0]
            rest = [ops.full((rows, *like.shape[1:]), outside, like) for rows in (before, after) if rows]
            if not rest:
                return body
            return ops.cat([*rest[: bool(before)], body, *rest[bool(before) :]])

        return kernel


# ------------------------------------------------------------------------------ running


def _too_far(schedule: Schedule) -> Diagnostic:
    """Return finding E306: a formula needs values at too many instants beyond the trace."""
    step = max(schedule.steps, key=lambda step: step.run.last)
    return Diagnostic(
        "E306",
        f"this looks {step.run.last - schedule.domain.samples + 1:,} samples beyond the last one",
        step.node.span,
        help=(
            "record more, or shorten the intervals: a trace that ends so early says nothing certain here",
            "`--end truncate` evaluates on what there is",
        ),
    )


def _runner(
    step: ScheduleStep, machine: Machine, source: StepSource | None, batches: Sequence[Batch]
) -> Runner:
    """Return the function that computes the values of a step; `source`: that of the margin of a predicate."""
    if isinstance(step.node, ir.Freeze):
        node, run, domain, windows = step.node, step.run, machine.domain, machine.windows
        judge = partial(_judge, windows=windows)
        return lambda _, __, env, ___: Freezer(domain, env, windows.ops, judge).values(node, run)
    if isinstance(step.node, ir.Predicate):
        return _predicate(step, machine, source, batches)
    kernel, parts = machine.bind(step), step.operands
    if len(parts) == 1:
        (only,) = parts
        return lambda values, _, __, like: kernel((values[only],), like)
    return lambda values, _, __, like: kernel([values[part] for part in parts], like)


def _predicate(
    step: ScheduleStep, machine: Machine, source: StepSource | None, batches: Sequence[Batch]
) -> Runner:
    """Return the function that computes the values of `step`, whose formula is a predicate.

    The function reads the margin of the predicate from an output of a program, or directly from a signal. If
    the predicate is undefined at all instants of the step, there is no `source`.
    """
    if source is None:
        kernel = machine.predicate(step.node, step.run, spanning(step.run.start, 0))
        return lambda _, __, ___, like: kernel((), like)
    number, name, inside = source.batch, source.name, source.inside
    kernel = machine.predicate(step.node, step.run, inside)
    if number is None:
        if inside.count == machine.domain.samples:
            return lambda _, __, env, like: kernel((env[name],), like)
        first, stop = inside.start, inside.last + 1
        return lambda _, __, env, like: kernel((env[name][first:stop],), like)
    offset = inside.start - batches[number].run.start
    if offset == 0 and batches[number].run.count == inside.count:
        return lambda _, outputs, __, like: kernel((outputs[number][name],), like)
    rows = slice(offset, offset + inside.count)
    return lambda _, outputs, __, like: kernel((outputs[number][name][rows],), like)


def _judge(
    formula: ir.Formula, env: Mapping[str, Array], run: IndexRange, domain: TraceDomain, *, windows: Windows
) -> Array:
    """Robustness `(count, batch)` of one formula at the instants `run`, which may lie beyond the trace."""
    return _scheduled(formula, run, domain, windows).roots(env)[0]


@lru_cache(maxsize=512)
def _scheduled(formula: ir.Formula, run: IndexRange, domain: TraceDomain, windows: Windows) -> ArrayPlan:
    return array_plan((formula,), run, domain, windows)
