"""Simulations of a system without controls: its model from initial states, parameters and input signals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.assurance.search_space import Point, SearchSpace, SignalBlock
from stlc.assurance.simulation import PARTS, Simulations
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.kernel import Adjoint, ObjectiveSlopes
from stlc.controller.problem.native import NativeGradient, NativeJudge
from stlc.controller.problem.task import Task
from stlc.controller.search.plan_traces import trace_of
from stlc.controller.search.planner import PlanResult
from stlc.diagnostics import usage
from stlc.dynamics.quantiles import InitialPoints
from stlc.monitor.instants import rule_bounds
from stlc.monitor.values import Record
from stlc.trace import Trace

Columns = Mapping[str, NDArray[np.float64]]
"""Signals of simulations: name -> (time, batch)."""
SMALL = 1e-4
"""Differences, in the unit cube, by which initial states are differentiated."""
SLOPE = 10.0
"""Slope of the smooth step that stands for conditions in gradients; see `NativeGradient`."""


@dataclass(frozen=True)
class ModelSimulator:
    """Simulator of a system that has no controls, over the horizon of its system file.

    Attributes:
        task: specification and system.
        finer: function that loads the same task at half the time step, or, if its argument is True, with half
            the step of the integration and the same samples; None if it has no finer one.
        batch: number of simulations side by side; 1 lets the search learn from each.
    """

    task: Task
    finer: Callable[[bool], Task] | None = None
    batch: int = 1

    @classmethod
    def load(cls, spec: str, system: str | None, overrides: Mapping[str, str]) -> ModelSimulator:
        """Load a specification and its system.

        Raises:
            UsageError: U101, the system has controls, so that it needs a controller.
            SpecError, SystemFileError: a file is invalid.
        """
        task = Task.load(spec, system, overrides)
        decl = task.system.decl
        if decl.controls:
            listed = ", ".join(f"`{control.name}`" for control in decl.controls)
            message = f"`{decl.name}` has controls ({listed}), which a controller must choose"
            raise usage(message, "stlc falsify RUN, for a trained policy", "declare them as `inputs`")
        digital = bool({each.name for each in decl.updates} - {each.name for each in decl.inputs})

        @cache
        def finer(sampled: bool) -> Task:
            halved = {"time.dt": f"{decl.dt / 2} s", "time.horizon": f"{2 * decl.horizon} steps"}
            if sampled:  # what is computed or counted at samples keeps its period
                halved = {"time.substeps": str(2 * decl.substeps)}
            return Task.load(spec, system, {**overrides, **halved})

        return cls(task, None if decl.discrete else lambda counts: finer(digital or counts))

    @cached_property
    def points(self) -> InitialPoints:
        """Map from the unit cube to initial states."""
        return InitialPoints(self.task.system)

    @cached_property
    def space(self) -> SearchSpace:
        """The search space: coordinates of the initial states, and which of them belong to input signals."""
        blocks = []
        for each in self.task.system.decl.inputs:
            found = self.points.coordinates_of(each.values)
            first = self.points.last_coordinates_of(each.times)
            if len(found) == len(each.values):
                shares = tuple(float(end / each.duration) for end in each.ends[: each.points])
                values = tuple(found[name] for name in each.values)
                length = float(each.duration) / _duration(self.task)
                blocks.append(
                    SignalBlock(each.name, values, first, () if first else shares, each.lead, length)
                )
        return SearchSpace(self.points.dim, tuple(blocks))

    @property
    def part(self) -> int:
        """Number of points that are simulated at once where simulations are shared out."""
        return max(self.batch // PARTS, 1)

    @cached_property
    def requirements(self) -> tuple[str, ...]:
        """Names of the requirements."""
        return tuple(rule.name for rule in self.task.rules)

    def seen(self, requirement: int) -> float:
        """Share of the inputs' duration, at most 1, after which inputs no longer affect a requirement."""
        inputs = self.task.system.decl.inputs
        if not inputs:
            return 1.0
        names = {each.name for each in inputs}
        read_by = (self.task.rules[requirement], *self.task.compiled.assumptions)
        last = max(rule.reach + bool(rule.formula.columns & names) for rule in read_by)
        # an input is also read at the last sample
        return min(last * self.task.system.dt / _duration(self.task), 1.0)

    def graded(self, requirement: int) -> bool:
        """True if a predicate reads a real signal, so that its margin varies continuously."""
        whole = {each.name for each in self.task.system.decl.signature.columns if each.kind != "real"}
        predicates = [each for each in self.task.rules[requirement].formula.predicates() if not each.guard]
        return not predicates or any(each.columns - whole for each in predicates)

    def simulate(self, points: NDArray[np.float64], requirement: int) -> Simulations:
        """Simulate `points`, (count, dim), and judge them by a requirement."""
        return self.simulate_apart([points], [requirement])[0]

    def simulate_apart(
        self, parts: Sequence[NDArray[np.float64]], requirements: Sequence[int]
    ) -> list[Simulations]:
        """Simulate the points of several searches side by side, and judge each part by its own requirement.

        The native kernel takes about as long for sixteen points as for one.
        """
        states = self.points.states(torch.from_numpy(np.concatenate(parts)))
        admissible = self.points.admissible(states).numpy()
        columns, found, end = self.columns_of(self.task, states), [], 0
        for part, requirement in zip(parts, requirements, strict=True):
            rows, end = slice(end, end + len(part)), end + len(part)
            own = {name: np.ascontiguousarray(column[:, rows]) for name, column in columns.items()}
            found.append(self._judged(self.task, own, requirement, admissible[rows]))
        return found

    @staticmethod
    def _judged(task: Task, columns: Columns, requirement: int, admissible: NDArray[np.bool_]) -> Simulations:
        margins = _margins(task, columns, [requirement])[:, 0]
        broken = ~np.isfinite(np.stack([column[-1] for column in columns.values()])).all(0)
        margins = np.where(broken | np.isnan(margins), -np.inf, margins)
        every = np.ones(len(margins), dtype=np.bool_)
        return Simulations(margins, admissible & in_scope(task, columns), every)

    def at_half_step(self, points: NDArray[np.float64], requirement: int) -> Simulations | None:
        """Outcomes at half the time step; None for a system in discrete time.

        A requirement that counts samples is judged by the same samples, at half the step of the integration.
        """
        if self.finer is None:
            return None
        states = self.points.states(torch.tensor(points))
        admissible = self.points.admissible(states).numpy()
        task = self.finer(self.task.rules[requirement].typed.formula.counts_samples)
        return self._judged(task, self.columns_of(task, states), requirement, admissible)

    def gradient(self, point: Point, requirement: int) -> Point | None:
        """Gradient of the exact robustness at a point, (dim,), by the native kernel.

        None without that kernel, and for dynamics with jumps or whole-number states, whose switching instants
        the gradient would not see.
        """
        if self._adjoint is None:
            return None
        moved = np.where(point > 0.5, -SMALL, SMALL)  # differences of the initial states, inwards
        states = self.points.states(torch.from_numpy(np.concatenate((point[None], point + np.diag(moved)))))
        slopes = (states[1:] - states[:1]).numpy() / moved[:, None]
        chosen = np.zeros((1, len(self.task.rules)))
        chosen[0, requirement] = 1.0
        start, plans = states[:1].numpy(), self._plans(self.task, 1).numpy()
        by_states = self._adjoint.pull_starts(start, plans, ObjectiveSlopes(chosen, None, SLOPE))
        found: Point = slopes @ by_states[0]
        return found

    @cached_property
    def _adjoint(self) -> Adjoint | None:
        decl, system = self.task.system.decl, self.task.system
        whole = any(column.kind != "real" for column in decl.signature.columns)
        judge = None if whole or decl.jumps else _kernel(self.task)
        found = NativeGradient.of(system, self.task.rules, judge)
        return None if found is None else found.adjoint

    def trace(self, points: NDArray[np.float64], seed: int | None = None) -> Trace:
        """Simulated trajectories of `points`, (count, dim), as a trace."""
        states = self.points.states(torch.tensor(points))
        rho = _margins(self.task, self.columns_of(self.task, states), range(len(self.task.rules)))
        rho = rho.min(1, initial=np.inf)
        nothing = torch.zeros(len(states))
        plans = self._plans(self.task, len(states))
        result = PlanResult(states, plans, torch.from_numpy(rho), nothing.bool(), nothing, nothing.long())
        return trace_of(self.task, result, seed)

    @staticmethod
    def columns_of(task: Task, states: Tensor) -> Columns:
        """Signals of simulations from states (count, n), by the fastest kernel: name -> (time, count).

        Requirements are judged apart from that, in time that does not grow with their windows.
        """
        plans = ModelSimulator._plans(task, len(states))
        kernel = _kernel(task)
        moved = (
            task.system.rollout_columns(states, plans)
            if kernel is None
            else kernel.judge(states, plans, columns=True)[1]
        )
        return {name: column.numpy() for name, column in moved.items()}

    @staticmethod
    def _plans(task: Task, count: int) -> Tensor:
        return torch.zeros((count, task.horizon, 0), dtype=torch.float64)


def _duration(task: Task) -> float:
    """Duration of the longest input signal in seconds; infinite if there are none."""
    return max((float(each.duration) for each in task.system.decl.inputs), default=np.inf)


def in_scope(task: Task, columns: Columns) -> NDArray[np.bool_]:
    """True for the simulations that violate no assumption of the specification, (count,)."""
    scope = np.ones(next(iter(columns.values())).shape[1], dtype=np.bool_)
    for rule in task.compiled.assumptions:
        _, high = rule_bounds(rule, Record.of(columns), range(1), task.horizon, "open")
        scope &= ~TOLERANCE.violated(high[0])
    return scope


@cache
def _kernel(task: Task) -> NativeJudge | None:
    return NativeJudge.of(task.system, ())


def _margins(task: Task, columns: Columns, requirements: Sequence[int]) -> NDArray[np.float64]:
    """Exact robustness of some requirements of a task, (count, requirements)."""
    formulas = [task.rules[index].formula for index in requirements]
    each = evaluate(formulas, columns) if formulas else []
    count = next(iter(columns.values())).shape[1]
    found = np.zeros((count, len(formulas)))
    for index, margin in enumerate(each):
        found[:, index] = margin[0]
    return found
