"""Multiple shooting: planning as a nonlinear program, made from dynamics and formulas of the IR.

All states that controls affect are variables of the program; the dynamics are equality constraints (Bock &
Plitt 1984). States that no control affects are parameters of the program. If a state is clamped to a range,
its variable is bounded to this range. A further variable in the dynamics is the correction by the clamp. The
cost penalises this correction.

A formula requires conditions at certain samples. Each condition is a constraint
`value + shortfall >= margin`. All these constraints share the variable `shortfall`, which the cost minimises.
Minima and maxima within a condition are log-sum-exp (Pant et al. 2017).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias, final

import casadi
import numpy as np
from numpy.typing import NDArray

from benchmarks.methods.planners._casadi import CASADI, GREAT, SymbolicColumn
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.text import show_number
from stlc.compile.namespace import Array, Ops
from stlc.compile.semantics.kinds.smooth import LogSumExp

STEPS = ("floor", "ceil", "round", "sign", "mod")
"""Functions that jump."""
LEAST = GREAT
"""Greatest robustness that is aimed at, and minus the value of a condition that never holds."""
EFFORT = 1e-3
"""Cost of controls at the ends of their ranges, which makes a plan unique."""
CORRECTION = 10.0
"""Cost of corrections, per unit of the state, where the shortfall costs 1."""

Vector: TypeAlias = NDArray[np.float64]


class NotSmoothError(Exception):
    """Error: an expression that depends on the controls is discontinuous, or has no CasADi form."""


@final
@dataclass(frozen=True, slots=True)
class Eased:
    """Switch that evaluates conditions by smooth indicators (Eq. 6 of Meng and Fan 2023).

    The indicator of a condition with the margin rho is `(1 + tanh(w rho)) / 2`. `sharpness` is the greatest
    value of w that is used.
    """

    exact: ClassVar[bool] = False
    sharpness: float

    def indicator(self, rho: Array, strict: bool, sharpness: float | None, ops: Ops) -> Array:  # noqa: ARG002
        """Smooth indicator `(1 + tanh(w rho)) / 2` of the margin `rho`.

        The switch has an attribute `sharpness`. w is this attribute or the argument `sharpness`, whichever is
        smaller. If the argument is None, w is the attribute.
        """
        width = self.sharpness if sharpness is None else min(self.sharpness, sharpness)
        return ops.sigmoid(rho * (2.0 * width))

    def settle(self, weight: Array, truth: Array, ops: Ops) -> Array:  # noqa: ARG002
        """Return the smooth indicator `weight` unchanged, without use of the exact truth `truth`."""
        return weight

    def blend(self, weight: Array, yes: Array | float, no: Array | float, ops: Ops) -> Array:
        """`no + weight (yes - no)`."""
        return ops.lerp(no, yes, weight)


@dataclass(frozen=True, slots=True)
class ShootingDynamics:
    """Dynamics of a system, in which the expressions of a step do not include the clamps of states.

    Attributes:
        lets: intermediate variables of a step as (name, expression), in order.
        step: state -> expression of its value one step later, before any clamp; states that do not change are
            absent.
        clamps: state -> range to which it is clamped.
        bounds: control -> its range.
        horizon: number of steps of a plan.
    """

    lets: Sequence[tuple[str, ir.Num]]
    step: Mapping[str, ir.Num]
    clamps: Mapping[str, tuple[float, float]]
    bounds: Mapping[str, tuple[float, float]]
    horizon: int

    def reached(self) -> frozenset[str]:
        """Names of the controls, and of the states and intermediate variables that controls affect."""
        found, before = set(self.bounds), -1
        while len(found) > before:
            before = len(found)
            found |= {name for name, num in (*self.lets, *self.step.items()) if _names(num) & found}
        return frozenset(found)

    def needed(self, columns: Iterable[str]) -> frozenset[str]:
        """Return the names `columns`, and the names of all signals and variables on which these depend."""
        table: dict[str, set[str]] = {}
        for name, num in (*self.lets, *self.step.items()):
            table.setdefault(name, set()).update(_names(num))
        found, stack = set[str](), list(columns)
        while stack:
            name = stack.pop()
            if name not in found:
                found.add(name)
                stack.extend(table.get(name, ()))
        return frozenset(found)


@dataclass(frozen=True, slots=True)
class ScaledFormula:
    """A formula that must hold at the first sample, and the factor that scales its robustness."""

    formula: ir.Formula
    factor: float


class Shooting:
    """Nonlinear program (multiple shooting) whose solution is a plan.

    It is built once for given dynamics and formulas; the initial state is a parameter.

    Attributes:
        program: the program for CasADi: variables `x`, parameters `p`, cost `f`, constraints `g`.
        states: names of the states that are variables.
        given: names of the signals whose values at all samples are parameters.
    """

    def __init__(
        self,
        motion: ShootingDynamics,
        demands: Sequence[ScaledFormula],
        *,
        smoothing: float,
        sharpness: float,
    ) -> None:
        """Build the program.

        Args:
            motion: dynamics of the system.
            demands: formulas that must hold.
            smoothing: scale of log-sum-exp.
            sharpness: greatest factor w in a smooth indicator `(1 + tanh(w rho)) / 2` of a condition.

        Raises:
            NotSmoothError: an expression that depends on the controls is discontinuous or has no CasADi form,
                or a formula contains `freeze`.
        """
        self._motion, self._switch = motion, Eased(sharpness)
        self._semantics = LogSumExp(smoothing)
        reached = motion.reached()
        read = {name for each in demands for num in each.formula.numbers() for name in _names(num)}
        needed = motion.needed(read)
        self._lets = [(name, num) for name, num in motion.lets if name in needed]
        self.states = tuple(name for name in motion.step if name in reached & needed)
        moving = {*motion.bounds, *self.states, *(name for name, _ in motion.lets), ir.ELAPSED}
        initial = {name for each in demands for num in each.formula.numbers() for name in _initial(num)}
        self.given = tuple(sorted((needed | initial) - moving))
        used = (*(num for _, num in self._lets), *(motion.step[name] for name in self.states))
        for num in (*used, *(num for each in demands for num in each.formula.numbers())):
            _require_smooth(num, reached)
        for each in demands:
            for node in each.formula.walk():
                if isinstance(node, ir.Freeze):
                    raise NotSmoothError("`freeze`")
                if isinstance(node, ir.Predicate) and node.guard and _names(node.num) & reached:
                    raise NotSmoothError(f"the time test `{show_number(node.num)}`")
        self._write(demands)

    def _write(self, demands: Sequence[ScaledFormula]) -> None:
        """Set `program`: variables, parameters, cost and constraints."""
        motion, steps = self._motion, self._motion.horizon
        controls = casadi.SX.sym("u", steps, len(motion.bounds))
        later = casadi.SX.sym("x", steps, len(self.states))
        self._clamped = tuple(name for name in self.states if name in motion.clamps)
        raised, cut = (casadi.SX.sym(name, steps, len(self._clamped)) for name in ("raised", "cut"))
        shortfall, margin = casadi.SX.sym("e"), casadi.SX.sym("margin")
        first = casadi.SX.sym("first", 1, len(self.states))
        data = casadi.SX.sym("given", steps + 1, len(self.given))
        whole = casadi.vertcat(first, later)
        rows = {name: SymbolicColumn(whole[:, i]) for i, name in enumerate(self.states)}
        rows |= {name: SymbolicColumn(data[:, i]) for i, name in enumerate(self.given)}
        inputs = {name: SymbolicColumn(controls[:, i]) for i, name in enumerate(motion.bounds)}
        moved = self._moved({name: column[:-1] for name, column in rows.items()} | inputs)
        defects = []
        for i, name in enumerate(self.states):
            after = moved[name].entries
            if name in self._clamped:
                place = self._clamped.index(name)
                after = after + raised[:, place] - cut[:, place]
            defects.append(later[:, i] - after)
        values = self._values(demands, rows)
        ends = np.array(list(motion.bounds.values()))
        effort = casadi.sumsqr(
            (controls - np.tile(ends.mean(1), (steps, 1))) / np.tile(0.5 * np.ptp(ends, axis=1), (steps, 1))
        )
        corrections = casadi.sum1(casadi.vec(raised)) + casadi.sum1(casadi.vec(cut))
        self.program = {
            "x": casadi.vertcat(*map(casadi.vec, (controls, later, raised, cut, shortfall))),
            "p": casadi.vertcat(*map(casadi.vec, (first, data, margin))),
            "f": shortfall + EFFORT / steps * effort + CORRECTION * corrections,
            "g": casadi.vertcat(*defects, values + shortfall - margin),
        }
        self._equations = steps * len(self.states)
        self._demands = int(values.shape[0])

    def _moved(self, env: Mapping[str, SymbolicColumn]) -> Mapping[str, SymbolicColumn]:
        """States after each step: name -> series (steps, 1).

        `env` maps the name of a state or control to its values at the start of each step, (steps, 1).
        """
        steps = self._motion.horizon
        known = {**env, ir.ELAPSED: CASADI.counted(0, steps, None)}
        for name, num in self._lets:
            known[name] = ArrayProgram({name: num})(known, CASADI, self._switch)[name]
        step = {name: self._motion.step[name] for name in self.states}
        if not step:
            return {}
        moved = ArrayProgram(step)(known, CASADI, self._switch)
        return {
            name: column if len(column) == steps else CASADI.cat([column] * steps)
            for name, column in moved.items()
        }

    def _values(self, demands: Sequence[ScaledFormula], rows: Mapping[str, SymbolicColumn]) -> Any:
        """Scaled robustness of the required conditions, as a column (conditions, 1).

        Each formula in `demands` is split into conditions at single samples. Conditions that always hold are
        left out. `rows` maps the name of a signal to its values.
        """
        found = []
        for each in demands:
            for formula, first, last in _conditions(each.formula, 0, 0, self._motion.horizon):
                count = last - first + 1
                (value,) = evaluate(
                    [formula], rows, ops=CASADI, semantics=self._semantics, start=first, count=count
                )
                left = [row.entries for row in value.rows() if not _holds(row)]
                found += [-LEAST if row.is_constant() else each.factor * row for row in left]
        return casadi.vertcat(*found) if found else casadi.SX(0, 1)

    # ------------------------------------------------------------------- numbers

    def limits(self, *, maximise: bool) -> dict[str, Vector]:
        """Bounds of variables (`lbx`, `ubx`) and constraints (`lbg`, `ubg`), under the names of CasADi.

        The last variable is the shortfall: the amount by which the worst condition misses the required
        robustness. If `maximise`, the shortfall may be negative, so that robustness above the required one is
        rewarded.
        """
        motion, steps = self._motion, self._motion.horizon
        free = (-math.inf, math.inf)
        ranges = [*motion.bounds.values(), *(motion.clamps.get(name, free) for name in self.states)]
        ranges += [(0.0, math.inf)] * (2 * len(self._clamped))
        low, high = (np.repeat([each[side] for each in ranges], steps) for side in (0, 1))
        return {
            "lbx": np.append(low, -LEAST if maximise else 0.0),
            "ubx": np.append(high, math.inf),
            "lbg": np.zeros(self._equations + self._demands),
            "ubg": np.append(np.zeros(self._equations), np.full(self._demands, math.inf)),
        }

    def guess(self, controls: Vector, columns: Mapping[str, Vector]) -> Vector:
        """Initial guess of the variables: the plan `controls` (T, m), and its states in `columns`.

        `columns` maps the name of a state to its values (T + 1,) under the plan.
        """
        states = [columns[name][1:] for name in self.states]
        blank = np.zeros(2 * len(self._clamped) * self._motion.horizon + 1)
        return np.concatenate([controls.T.ravel(), *states, blank])

    def data(self, columns: Mapping[str, Vector], margin: float) -> Vector:
        """Values of the program's parameters for one initial state.

        Args:
            columns: signal name -> values (T + 1,). For the states of the program only the first value is
                read, for the signals in `given` all values.
            margin: robustness that every condition should reach.
        """
        first = [columns[name][0] for name in self.states]
        return np.concatenate([first, *(columns[name] for name in self.given), [margin]])

    def controls(self, values: Vector) -> Vector:
        """Extract the plan (T, m) from the values of the variables."""
        steps, count = self._motion.horizon, len(self._motion.bounds)
        return values[: steps * count].reshape(count, steps).T


def _conditions(
    formula: ir.Formula, first: int, last: int, end: int
) -> Iterator[tuple[ir.Formula, int, int]]:
    """Yield conditions that together are equivalent to `formula` at the samples `first` to `last`.

    Each condition is a formula with the first and last sample, both included, at which it must hold. `end` is
    the last sample of the horizon.
    """
    match formula:
        case ir.BoolOp("and", items):
            for item in items:
                yield from _conditions(item, first, last, end)
        case ir.AtStart(body):
            yield from _conditions(body, 0, 0, end)
        case ir.Temporal("always", window, body) if window.hi is not None or first == last:
            until = end if window.hi is None else last + window.hi
            yield from _conditions(body, first + window.lo, until, end)
        case _:
            yield formula, first, last


def _names(num: ir.Num | ir.Formula) -> set[str]:
    """Names of the signals that an expression reads, except those read at the first sample only."""
    read = (leaf for leaf in num.leaves() if isinstance(leaf, ir.Signal | ir.ShiftedSignal))
    return {leaf.name for leaf in read if leaf != ir.Signal(leaf.name).at_first}


def _initial(num: ir.Num) -> set[str]:
    """Names of the signals whose value at the first sample of the plan an expression reads."""
    read = (leaf for leaf in num.leaves() if isinstance(leaf, ir.ShiftedSignal))
    return {leaf.name for leaf in read if leaf == ir.Signal(leaf.name).at_first}


def _require_smooth(num: ir.Num, reached: frozenset[str]) -> None:
    """Raise NotSmoothError if an expression has a discontinuity that depends on the controls.

    `reached` contains the names of the controls, and of all signals that the controls affect.
    """
    for part in num.subexpressions():
        match part:
            case ir.Op(name) if name in STEPS and _names(part) & reached:
                raise NotSmoothError(show_number(part))
            case ir.Where(cond) if _names(cond) & reached:
                raise NotSmoothError(show_number(part))
            case ir.Extern(function=function):
                if not isinstance(function, ir.Body):
                    raise NotSmoothError(f"the function `{part.name}`")
                for inner in (*(each for _, each in function.lets), *function.outputs):
                    _require_smooth(inner, reached | _names(inner))


def _holds(row: SymbolicColumn) -> bool:
    """True if `row` is a nonnegative constant, so that the condition with this robustness always holds."""
    return bool(row.entries.is_constant()) and float(row.entries) >= 0.0
