"""Robustness of formulas at given instants, over any array library.

Signals are arrays `(time, batch)`. `stlc.compile.backends.schedule` lists the values to compute, and
`stlc.compile.backends.array.steps` computes them.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.array.steps import ArrayPlan, array_plan
from stlc.compile.backends.array.windows import Windows
from stlc.compile.backends.schedule import Boundary, End, TraceDomain, spanning
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.defined import Undefined, undefined
from stlc.compile.namespace import Array, Ops
from stlc.compile.semantics.semantics import Exact, Semantics, semantics_of
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.signature import Signature


def evaluate(
    formulas: Sequence[ir.Formula],
    env: Mapping[str, Array],
    *,
    ops: Ops = NUMPY,
    semantics: Semantics | None = None,
    start: int = 0,
    count: int = 1,
    end: Boundary = "strict",
    stop: int | None = None,
) -> list[Array]:
    """Return the robustness of several formulas; common sub-formulas are computed once.

    Args:
        formulas: formulas in negation normal form.
        env: signal name -> array `(time, batch)`.
        ops: the array library of `env`.
        semantics: definition of min and max; None for the exact ones.
        start: first instant.
        count: number of instants.
        end: treatment of instants beyond the last sample (`stlc.compile.backends.schedule.Boundary`).
        stop: final number of samples of a trace that continues (`end` "lower" or "upper"). Unbounded windows
            end there. If None, they end with the last known sample.

    Returns:
        For each formula an array `(count, batch)`.

    Raises:
        ValueError: a window extends beyond the trace, and `end` is "strict".
        TraceError: E306, a lower or upper bound on the robustness needs values at too many instants beyond
            the trace.
    """
    return _plan(formulas, env, range(start, start + count), end, stop, semantics or _EXACT, ops).roots(env)


def evaluate_parts(
    formula: ir.Formula,
    env: Mapping[str, Array],
    instants: range,
    *,
    ops: Ops,
    end: Boundary,
    stop: int | None = None,
) -> Iterator[tuple[ir.Formula, range, Array]]:
    """Yield the exact robustness of a formula and of its sub-formulas.

    The formula is evaluated at `instants`, each sub-formula at the instants at which its value is needed. If
    `end` is "lower" or "upper", instants may lie beyond the last sample. `stop` is explained in `evaluate`.

    Yields:
        Tuples (formula, instants, values), with values of the shape `(instants, batch)`. Operands come before
        the formula that reads them. Sub-formulas inside a `freeze` are left out.
    """
    plan = _plan((formula,), env, instants, end, stop, _EXACT, ops)
    for step, values in zip(plan.schedule.steps, plan.values(env), strict=True):
        yield step.node, range(step.run.start, step.run.last + 1), values


_EXACT = Exact()


def _plan(
    formulas: Sequence[ir.Formula],
    env: Mapping[str, Array],
    instants: range,
    end: Boundary,
    stop: int | None,
    semantics: Semantics,
    ops: Ops,
) -> ArrayPlan:
    samples = len(next(iter(env.values())))
    return planned(tuple(formulas), samples, instants, end, stop, semantics, ops)  # type: ignore[arg-type]


@lru_cache(maxsize=512)
def planned(
    formulas: tuple[ir.Formula, ...],
    samples: int,
    instants: range,
    end: Boundary = "strict",
    stop: int | None = None,
    semantics: Semantics = _EXACT,
    ops: Ops = NUMPY,
) -> ArrayPlan:
    """Return the evaluation plan of `formulas` at `instants`; plans are cached.

    A plan lists the values to compute, and the programs that compute them. It applies to every trace of
    `samples` samples; the other arguments are those of `evaluate`.

    Raises:
        ValueError: an instant lies outside the trace; or `end` is "strict", and a window extends beyond the
            trace.
    """
    domain = TraceDomain(samples, end, stop, counted=not semantics.idempotent)
    if instants.start < 0 or (instants.stop > samples and not domain.open):
        first, last = instants.start, instants.stop - 1
        raise ValueError(f"instants {first}..{last} of a trace with {samples} samples")
    if end == "strict":
        missing = (each for formula in formulas for each in undefined(formula, samples))
        if any(each.start < instants.stop and instants.start < each.stop for each in missing):
            raise ValueError(f"the formula looks beyond the end of a trace of {samples} samples")
    run = spanning(instants.start, len(instants))
    return array_plan(formulas, run, domain, Windows(semantics, ops))


def robustness_signal(
    formula: ir.Formula,
    env: Mapping[str, Array],
    *,
    ops: Ops = NUMPY,
    semantics: Semantics | None = None,
    end: Boundary = "strict",
) -> Array:
    """Return the robustness of a formula at every sample, `(time, batch)`.

    If `end` is "strict", the robustness is NaN at samples where the formula needs samples beyond the trace.
    """
    samples = len(next(iter(env.values())))
    (signal,) = signal_plan((formula,), samples, range(samples), end, semantics or _EXACT, ops).values(env)
    return signal


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """Evaluation plan of the robustness of formulas at consecutive instants.

    Attributes:
        plan: plan of the values.
        missing: for each formula, the instants at which its robustness is NaN, counted from the first one.
    """

    plan: ArrayPlan
    missing: tuple[Undefined, ...]

    def values(self, env: Mapping[str, Array]) -> list[Array]:
        """Return the robustness of each formula, `(instants, batch)`, from the signals `env`."""
        ops, roots = self.plan.ops, self.plan.roots(env)
        return [ops.rows(where, x, math.nan) for where, x in zip(self.missing, roots, strict=True)]


def signal_plan(
    formulas: tuple[ir.Formula, ...],
    samples: int,
    instants: range,
    end: Boundary = "strict",
    semantics: Semantics = _EXACT,
    ops: Ops = NUMPY,
) -> SignalPlan:
    """Return the plan of `robustness_signal` for several formulas at `instants` of `samples` samples."""
    cut, first, strict = "truncate" if end == "strict" else end, instants.start, end == "strict"
    missing = tuple(
        tuple(range(max(each.start - first, 0), max(each.stop - first, 0)) for each in undefined(x, samples))
        for x in formulas
    )
    plan = planned(formulas, samples, instants, cut, None, semantics, ops)  # type: ignore[arg-type]
    return SignalPlan(plan, missing if strict else ((),) * len(formulas))


class Weighed(Protocol):
    """Protocol of a weighted requirement; `stlc.compile.pipeline.CompiledRequirement` implements it."""

    def under(self, semantics: Semantics) -> ir.Formula:
        """Return the formula of the requirement, simplified, with times counted in steps.

        The simplification uses only laws of min and max that hold in `semantics`.
        """

    @property
    def factor(self) -> float:
        """Factor of the robustness in the minimum over all requirements: weight / scale."""


class RobustnessGraph:
    """Differentiable robustness of requirements over trajectories, evaluated at the first sample.

    Args:
        rules: the requirements.
        signature: names of the states, in the order of the last axis of trajectories.
        semantics: definition of min and max, or a name in `stlc.compile.semantics.semantics.SEMANTICS`.
        end: treatment of windows that extend beyond the last sample.

    Trajectories are `(batch, time, dim)`, torch or NumPy, float32 or float64; results keep dtype and device.
    Methods have an argument `smoothing`. If it is given, min and max in that call are log-sum-exp with the
    scale `smoothing`.

    Raises:
        UsageError: U101, an unknown semantics, or `smoothing` for a semantics without a scale.
    """

    def __init__(
        self,
        rules: Sequence[Weighed],
        signature: Signature,
        semantics: str | Semantics = "exact",
        end: End = "strict",
    ) -> None:
        self.rules = tuple(rules)
        self.end = end
        self.signature = signature
        self.semantics = semantics_of(semantics)
        self._formulas: dict[tuple[bool, bool], list[ir.Formula]] = {}

    def robustness(self, x: Array, smoothing: float | None = None) -> Array:
        """Overall robustness of trajectories `x`, `(batch,)`.

        It is the minimum over the requirements of their weighed robustness, `weight * rho / scale`.
        """
        env, ops = self._columns(x)
        return self.columns(env, ops=ops, smoothing=smoothing)

    def per_requirement(self, x: Array, smoothing: float | None = None) -> Array:
        """Robustness of each requirement on trajectories `x`, without weight and scale: `(batch, rules)`."""
        env, ops = self._columns(x)
        return self.per_requirement_columns(env, ops=ops, smoothing=smoothing)

    def columns(self, env: Mapping[str, Array], *, ops: Ops, smoothing: float | None = None) -> Array:
        """Overall robustness, `(batch,)`, from the signals `env`.

        `env` maps the name of a signal to an array `(time, batch)`.
        """
        return self.overall(self.per_requirement_columns(env, ops=ops, smoothing=smoothing), smoothing)

    def overall(self, each: Array, smoothing: float | None = None) -> Array:
        """Overall robustness, `(batch,)`, from the robustness of each requirement, `(batch, rules)`.

        Without requirements, the overall robustness is +inf.
        """
        ops, rows = ops_of(each), each.T
        if not self.rules:
            return ops.full((each.shape[0],), math.inf, each)
        items = [rows[i : i + 1] for i in range(len(self.rules))]
        factors = (rule.factor for rule in self.rules)
        return TOLERANCE.overall(items, factors, ops, semantics_of(self.semantics, smoothing))[0]

    def per_requirement_columns(
        self, env: Mapping[str, Array], *, ops: Ops, smoothing: float | None = None
    ) -> Array:
        """Robustness of each requirement, `(batch, rules)`, from the signals `env`.

        `env` maps the name of a signal to an array `(time, batch)`.
        """
        semantics = semantics_of(self.semantics, smoothing)
        laws = semantics.associative, semantics.idempotent
        if laws not in self._formulas:
            self._formulas[laws] = [rule.under(semantics) for rule in self.rules]
        rows = evaluate(self._formulas[laws], env, ops=ops, semantics=semantics, end=self.end)
        if not rows:
            like = next(iter(env.values()))
            return ops.full((*like.shape[1:], 0), math.inf, like)
        return ops.cat(rows).T

    def _columns(self, x: Array) -> tuple[dict[str, Array], Ops]:
        if x.shape[-1] != len(self.signature):
            raise ValueError(f"{x.shape[-1]} columns where {len(self.signature)} are expected")
        ops = ops_of(x)
        return dict(zip(self.signature.names, ops.columns(x), strict=True)), ops


def ops_of(x: Array) -> Ops:
    """Return the array library of `x`. Torch is imported only for a torch tensor."""
    if isinstance(x, np.ndarray):
        return NUMPY
    return importlib.import_module("stlc.compile.backends.torch.ops").TORCH  # type: ignore[no-any-return]
