"""How a derivative becomes a step, written over IR numbers so that a step is data before it is run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.dynamics.model.algebra import add, multiply
from stlc.registry import Registry

State: TypeAlias = Mapping[str, ir.Num]
Rate: TypeAlias = Callable[[State], State]
Integrator: TypeAlias = Callable[[Rate, State, float], State]
"""(derivative, state, length of the step) -> the components that the derivative moves, one step later."""

INTEGRATORS: Registry[Integrator] = Registry("integrator")


def _along(state: State, rate: State, length: float) -> State:
    """`state + length * rate`, for the components that move; the others stay."""
    moved = {name: add(state[name], multiply(ir.Const(length), slope)) for name, slope in rate.items()}
    return {**state, **moved}


@INTEGRATORS.register("euler")
def euler(rate: Rate, state: State, length: float) -> State:
    """Explicit Euler: first order, one evaluation."""
    return _along(state, rate(state), length)


@INTEGRATORS.register("heun")
def heun(rate: Rate, state: State, length: float) -> State:
    """Heun's method: second order, two evaluations."""
    first = rate(state)
    second = rate(_along(state, first, length))
    return _along(state, {name: add(first[name], second[name]) for name in first}, length / 2)


@INTEGRATORS.register("rk4")
def rk4(rate: Rate, state: State, length: float) -> State:
    """The classical Runge-Kutta method: fourth order, four evaluations."""
    k1 = rate(state)
    k2 = rate(_along(state, k1, length / 2))
    k3 = rate(_along(state, k2, length / 2))
    k4 = rate(_along(state, k3, length))
    mean = {
        name: add(add(k1[name], k4[name]), multiply(ir.Const(2.0), add(k2[name], k3[name]))) for name in k1
    }
    return _along(state, mean, length / 6)
