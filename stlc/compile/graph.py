"""Formulas -> arrays: robustness at the instants that are asked for, on any array library.

Columns are `(time, batch)`. A schedule (`stlc.compile.schedule`) says what to compute,
`stlc.compile.machine` how.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from typing import Protocol

import numpy as np

from stlc.compile import ir
from stlc.compile.defined import defined
from stlc.compile.frozen import Freezer
from stlc.compile.inputs import inputs
from stlc.compile.machine import Machine
from stlc.compile.ops import Array, Ops
from stlc.compile.ops_numpy import NUMPY
from stlc.compile.schedule import Batch, End, Extent, Run, Schedule, schedule
from stlc.compile.semantics import Exact, LogSumExp, Semantics
from stlc.compile.windows import Windows
from stlc.signature import Signature


def evaluate(  # noqa: PLR0913 - the instants and the end of the trace belong to the question
    formulas: Sequence[ir.Formula],
    env: Mapping[str, Array],
    *,
    ops: Ops,
    semantics: Semantics | None = None,
    start: int = 0,
    count: int = 1,
    end: End = "strict",
) -> list[Array]:
    """Robustness of several formulas; common parts are computed once.

    Args:
        formulas: in negation normal form.
        env: columns, `(time, batch)`.
        ops: the array library of `env`.
        semantics: of min and max; None is `Exact()`.
        start: the first instant that is asked for.
        count: how many instants from there on.
        end: what stands beyond the last sample.

    Returns:
        For each formula an array `(count, batch)`.

    Raises:
        ValueError: a window leaves the trace, and `end` is "strict".
    """
    samples = len(next(iter(env.values())))
    plan = planned(tuple(formulas), samples, Run(start, count), end)
    return execute(plan, env, Windows(semantics or Exact(), ops))


@lru_cache(maxsize=512)
def planned(formulas: tuple[ir.Formula, ...], samples: int, run: Run, end: End) -> Schedule:
    """The schedule for a trace of `samples`, remembered. Raises ValueError as `evaluate` does."""
    if run.start < 0 or run.last >= samples:
        raise ValueError(f"instants {run.start}..{run.last} of a trace with {samples} samples")
    if end == "strict":
        for formula in formulas:
            if not defined(formula, samples)[run.start : run.last + 1].all():
                raise ValueError(f"the formula looks beyond the end of a trace of {samples} samples")
    return schedule(formulas, run, Extent(samples, end))


def robustness_signal(
    formula: ir.Formula,
    env: Mapping[str, Array],
    *,
    ops: Ops,
    semantics: Semantics | None = None,
    end: End = "strict",
) -> Array:
    """Robustness at every sample, `(time, batch)`; NaN where `end` "strict" leaves it undefined."""
    samples = len(next(iter(env.values())))
    cut: End = "truncate" if end == "strict" else end
    plan = planned((formula,), samples, Run(0, samples), cut)
    (signal,) = execute(plan, env, Windows(semantics or Exact(), ops))
    if end != "strict":
        return signal
    return ops.rows(defined(formula, samples), signal, math.nan)


def execute(plan: Schedule, env: Mapping[str, Array], windows: Windows) -> list[Array]:
    """The values of the roots of a schedule, each `(count, batch)`."""
    outputs = [_batch(batch, env, windows.ops) for batch in plan.batches]
    machine = Machine(plan.extent, windows, like=next(iter(env.values())))
    freezer = Freezer(plan.extent, env, windows.ops, partial(_judge, windows=windows))
    values: list[Array] = []
    for index, step in enumerate(plan.steps):
        if isinstance(step.node, ir.Atom):
            known, missing = _rows(plan, index, outputs)
            values.append(machine.atom(step.node, step.run, known, missing))
        elif isinstance(step.node, ir.Freeze):
            values.append(freezer.values(step.node, step.run))
        else:
            values.append(
                machine.value(step, [None if part is None else values[part] for part in step.parts])
            )
    return [values[root] for root in plan.roots]


def _judge(
    formula: ir.Formula, env: Mapping[str, Array], run: Run, extent: Extent, *, windows: Windows
) -> Array:
    """One formula at consecutive instants, on the trace or beyond it: `(count, batch)`."""
    return execute(_scheduled(formula, run, extent), env, windows)[0]


@lru_cache(maxsize=512)
def _scheduled(formula: ir.Formula, run: Run, extent: Extent) -> Schedule:
    return schedule((formula,), run, extent)


def _rows(plan: Schedule, index: int, outputs: Sequence[Mapping[str, Array]]) -> tuple[Array | None, int]:
    """What the batches know of the predicate of step `index`: its rows, and how many are missing before."""
    place = plan.atoms.get(index)
    if place is None:
        return None, 0
    number, name, inside = place
    values = outputs[number][name]
    offset = inside.start - plan.batches[number].run.start
    whole = offset == 0 and len(values) == inside.count
    known = values if whole else values[offset : offset + inside.count]
    return known, inside.start - plan.steps[index].run.start


def _batch(batch: Batch, env: Mapping[str, Array], ops: Ops) -> dict[str, Array]:
    return batch.program(inputs(batch.program, env, batch.run, ops), ops)


class Weighed(Protocol):
    """What the graph asks of a requirement; `stlc.compile.pipeline.Rule` has it."""

    @property
    def formula(self) -> ir.Formula:
        """In steps."""

    @property
    def weight(self) -> float:
        """Factor of its robustness in the whole."""

    @property
    def scale(self) -> float:
        """Divisor of its robustness in the whole."""


class RobustnessGraph:
    """Robustness of requirements over trajectories, differentiable, at the first sample.

    Args:
        rules: the requirements.
        signature: the columns of a state, in order.

    Trajectories are `(batch, time, dim)`, torch or NumPy, float32 or float64; results keep dtype and device.
    `smoothing` is the scale k of log-sum-exp; None is exact.
    """

    def __init__(self, rules: Sequence[Weighed], signature: Signature) -> None:
        self.rules = tuple(rules)
        self.signature = signature
        self._formulas = tuple(rule.formula for rule in self.rules)

    def robustness(self, x: Array, smoothing: float | None = None) -> Array:
        """Of the whole: min over requirements of `weight * rho / scale`, `(batch,)`."""
        env, ops = self._columns(x)
        return self.columns(env, ops=ops, smoothing=smoothing)

    def per_requirement(self, x: Array, smoothing: float | None = None) -> Array:
        """Of each requirement before weight and scale, `(batch, rules)`."""
        env, ops = self._columns(x)
        return self.per_requirement_columns(env, ops=ops, smoothing=smoothing)

    def columns(self, env: Mapping[str, Array], *, ops: Ops, smoothing: float | None = None) -> Array:
        """`robustness` on columns `(time, batch)`; only those that the requirements read are needed."""
        return self.overall(self.per_requirement_columns(env, ops=ops, smoothing=smoothing), smoothing)

    def overall(self, each: Array, smoothing: float | None = None) -> Array:
        """`robustness` from what `per_requirement` gave: (batch, rules) -> (batch,); +inf without rules."""
        ops, rows = ops_of(each), each.T
        if not self.rules:
            return ops.full((each.shape[0],), math.inf, each)
        weighed = [
            rows[i : i + 1] if rule.weight == rule.scale else rows[i : i + 1] * (rule.weight / rule.scale)
            for i, rule in enumerate(self.rules)
        ]
        return _semantics(smoothing).join(weighed, "min", ops)[0]

    def per_requirement_columns(
        self, env: Mapping[str, Array], *, ops: Ops, smoothing: float | None = None
    ) -> Array:
        """`per_requirement` on columns `(time, batch)`."""
        rows = self._rows(env, ops, _semantics(smoothing))
        if not rows:
            like = next(iter(env.values()))
            return ops.full((*like.shape[1:], 0), math.inf, like)
        return ops.cat(rows).T

    def _rows(self, env: Mapping[str, Array], ops: Ops, semantics: Semantics) -> list[Array]:
        return evaluate(self._formulas, env, ops=ops, semantics=semantics)

    def _columns(self, x: Array) -> tuple[dict[str, Array], Ops]:
        if x.shape[-1] != len(self.signature):
            raise ValueError(f"{x.shape[-1]} columns where {len(self.signature)} are expected")
        ops = ops_of(x)
        return dict(zip(self.signature.names, ops.columns(x), strict=True)), ops


def _semantics(smoothing: float | None) -> Semantics:
    return Exact() if smoothing is None else LogSumExp(smoothing)


def ops_of(x: Array) -> Ops:
    """The array library of `x`. Torch is imported only when `x` comes from it."""
    if isinstance(x, np.ndarray):
        return NUMPY
    return importlib.import_module("stlc.compile.ops_torch").TORCH  # type: ignore[no-any-return]
