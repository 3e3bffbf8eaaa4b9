"""Explicit Runge-Kutta methods as Butcher tableaux, applied to symbolic expressions.

The result of a step is an expression in the compiler's intermediate representation. One tableau therefore
serves rollouts in torch, NumPy programs and generated C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from stlc.compile.ir import nodes as ir

State: TypeAlias = Mapping[str, ir.Num]
Rate: TypeAlias = Callable[[State], State]
Method: TypeAlias = Callable[[Rate, State, float, Rate], State]
"""One step of an integrator.

From the function that computes derivatives, the state, the length of the step in seconds, and a function that
gives names to expressions, so that each is computed once, it returns the state after the step.
"""


@dataclass(frozen=True, slots=True)
class Tableau:
    """Butcher tableau of an explicit Runge-Kutta method.

    Weights are integers over a common divisor, so that terms with equal weights share one product.

    Attributes:
        stages: row i holds the coefficients of the earlier derivatives in stage i; the first row is empty.
        weights: weights of the derivatives in the result, times `divisor`.
        divisor: common divisor of the weights.
    """

    stages: tuple[tuple[float, ...], ...]
    weights: tuple[float, ...]
    divisor: float = 1.0

    def __call__(self, rate: Rate, state: State, length: float, named: Rate | None = None) -> State:  # noqa: ARG002
        """Return the state after a step of `length` seconds; `rate` computes the derivatives."""
        slopes: list[State] = []
        for row in self.stages:
            slopes.append(rate(_moved(state, slopes, row, length)))
        return _moved(state, slopes, self.weights, length / self.divisor)


def _moved(state: State, slopes: Sequence[State], weights: Sequence[float], length: float) -> State:
    """Return `state + length * sum(weight * slope)`; a component without slope is unchanged."""
    groups: dict[float, list[State]] = {}
    for weight, slope in zip(weights, slopes, strict=True):
        if weight:
            groups.setdefault(weight, []).append(slope)
    if not groups:
        return state
    if len(groups) == 1:
        (scale,) = groups
        groups, length = {1.0: groups[scale]}, length * scale
    moved = {name: state[name] + ir.Const(length) * _sum(groups, name) for name in slopes[0]}
    return {**state, **moved}


def _sum(groups: Mapping[float, Sequence[State]], name: str) -> ir.Num:
    """Return the weighted sum of the derivatives of state `name`; `groups`: weight -> derivatives."""
    total: ir.Num | None = None
    for weight, slopes in groups.items():
        part = slopes[0][name]
        for slope in slopes[1:]:
            part = part + slope[name]
        part = part if weight == 1.0 else ir.Const(float(weight)) * part
        total = part if total is None else total + part
    assert total is not None
    return total
