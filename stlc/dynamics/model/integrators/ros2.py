"""Rosenbrock method of second order for stiff systems, with two evaluations and one Jacobian per step.

The method is that of Verwer, Spee, Blom and Hundsdorfer (1999), with gamma = 1 - 1/sqrt(2). Stages are
linearly implicit: they solve linear equations with the matrix I - gamma h J, where J is the Jacobian of the
flow. The method is L-stable, so that a fast mode does not limit the step, and its order does not depend on J.
The derivatives and the elimination are symbolic, without pivoting: a step is straight-line code in every back
end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass

from stlc.compile.ir import nodes as ir
from stlc.dynamics.model.derivative import derivative
from stlc.dynamics.model.integrators._tableau import Rate, State


@dataclass(frozen=True, slots=True)
class Rosenbrock:
    """Rosenbrock method with two stages.

    Attributes:
        gamma: coefficient of the Jacobian.
    """

    gamma: float

    def __call__(self, rate: Rate, state: State, length: float, named: Rate) -> State:
        """Return the state after a step of `length` seconds.

        `rate` computes the derivatives at a state whose values are constants or columns, and `named` gives
        names to expressions.
        """
        here = rate(state)
        system = _Elimination(here, state, -self.gamma * length, named)
        first = system.solved(here)
        middle = rate({**state, **_moved(state, first, length)})
        twice = {name: 2.0 * num for name, num in first.items()}
        second = system.solved({name: middle[name] - twice[name] for name in here})
        half = _moved(state, first, 1.5 * length)
        return {**state, **_moved(half, second, 0.5 * length)}


def _moved(state: State, slopes: State, length: float) -> State:
    """Return the states that have slopes, `length` seconds later."""
    return {name: state[name] + ir.Const(length) * slope for name, slope in slopes.items()}


class _Elimination:
    """Gaussian elimination on the matrix I + s J, for several right-hand sides.

    The variable whose elimination changes the fewest entries comes first, so that a triangular matrix stays
    one.
    """

    def __init__(self, rates: State, state: State, scale: float, named: Rate) -> None:
        self._named = named
        self._rows = {name: _row(rates, state, name, scale) for name in rates}
        self._steps: list[tuple[str, Mapping[str, ir.Num]]] = []
        left = list(rates)
        while left:
            pivot = min(left, key=lambda name: self._changes(name, left))
            left.remove(pivot)
            self._eliminate(pivot, left)

    def solved(self, right: State) -> State:
        """Return the solution for one right-hand side."""
        values = dict(self._named(right))
        for pivot, factors in self._steps:
            for name, factor in factors.items():
                values[name] = values[name] - factor * values[pivot]
            values |= self._named({name: values[name] for name in factors})
        done: dict[str, ir.Num] = {}
        for pivot, _ in reversed(self._steps):
            num = values[pivot]
            for name, entry in self._rows[pivot].items():
                if name in done:
                    num = num - entry * done[name]
            diagonal = self._rows[pivot][pivot]
            if diagonal != ir.Const(1.0):
                num = num / diagonal
            done |= self._named({pivot: num})
        return {name: done[name] for name in right}

    def _changes(self, pivot: str, left: Sequence[str]) -> int:
        """Number of entries that the elimination of a variable changes."""
        below = sum(pivot in self._rows[name] for name in left) - 1
        return below * (sum(name in self._rows[pivot] for name in left) - 1)

    def _eliminate(self, pivot: str, left: Sequence[str]) -> None:
        """Subtract multiples of the row of `pivot` from the rows in `left` that have an entry there."""
        rows = self._rows
        rows[pivot] = dict(self._named(rows[pivot]))
        found = {name: rows[name].pop(pivot) / rows[pivot][pivot] for name in left if pivot in rows[name]}
        factors = self._named(found)
        for name, factor in factors.items():
            for other in left:
                if other in rows[pivot]:
                    change = factor * rows[pivot][other]
                    before = rows[name].get(other)
                    rows[name][other] = -change if before is None else before - change
        self._steps.append((pivot, factors))


def _row(rates: State, state: State, name: str, scale: float) -> MutableMapping[str, ir.Num]:
    """Return the entries of one row of I + s J that are not 0 everywhere."""
    row: dict[str, ir.Num] = {name: ir.Const(1.0)}
    for other in rates:
        at = state[other]
        slope = derivative(rates[name], at.name) if isinstance(at, ir.Signal) else None
        if slope is not None:
            entry = ir.Const(scale) * slope
            row[other] = 1.0 + entry if other == name else entry
    return row


TABLEAU = Rosenbrock(gamma=1.0 - math.sqrt(0.5))
