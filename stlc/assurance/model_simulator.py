"""Simulations of a system without controls: its model from initial states, parameters and input signals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from stlc.assurance.falsify import Simulations
from stlc.assurance.guidance import Columns, ScaledRobustness
from stlc.assurance.search_space import SearchSpace, SignalBlock
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.controller.planning.planner import PlanResult
from stlc.controller.planning.traces import trace_of
from stlc.controller.problem.load import load_task
from stlc.controller.problem.native import NativeJudge
from stlc.diagnostics import usage
from stlc.dynamics.init.quantiles import InitialPoints

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.controller.problem.task import Task
    from stlc.trace import Trace


@dataclass(frozen=True)
class ModelSimulator:
    """Simulator of a system that has no controls, over the horizon of its system file.

    Attributes:
        task: specification and system.
        finer: function that loads the same task at half the time step; None if it has no finer one.
        batch: number of simulations side by side; 1 lets the search learn from each.
    """

    task: Task
    finer: Callable[[], Task] | None = None
    batch: int = 1

    @classmethod
    def load(cls, spec: str, system: str | None, overrides: Mapping[str, str]) -> ModelSimulator:
        """Load a specification and its system.

        Raises:
            UsageError: U101, the system has controls, so that it needs a controller.
            SpecError, SystemFileError: a file is invalid.
        """
        task = load_task(spec, system, overrides)
        decl = task.system.decl
        if decl.controls:
            listed = ", ".join(f"`{control.name}`" for control in decl.controls)
            message = f"`{decl.name}` has controls ({listed}), which a controller must choose"
            raise usage(message, "stlc falsify RUN, for a trained policy", "declare them as `inputs`")
        halved = {
            **overrides,
            "time.dt": f"{float(decl.dt / 2)!r} s",
            "time.horizon": f"{2 * decl.horizon} steps",
        }
        return cls(task, None if decl.discrete else lambda: load_task(spec, system, halved))

    def renewed(self) -> ModelSimulator:
        """Return a copy without earlier simulations, which measures the scales of the guidance anew."""
        made = ModelSimulator(self.task, self.finer, self.batch)
        made.__dict__.update(points=self.points, space=self.space, _finer=self._finer)
        return made

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
            first = self._time_coordinates(each.times)
            if len(found) == len(each.values):
                shares = [float(end / each.duration) for end in each.ends[: each.points]]
                values = tuple(found[name] for name in each.values)
                blocks.append(SignalBlock(each.name, values, first, () if first else tuple(shares)))
        return SearchSpace(self.points.dim, tuple(blocks))

    def _time_coordinates(self, names: Sequence[str]) -> tuple[int, ...]:
        """Coordinates of the free switching times `names` of an input.

        A time is computed from several coordinates; the last of them belongs to this time alone.
        """
        return self.points.last_coordinates_of(names)

    @cached_property
    def requirements(self) -> tuple[str, ...]:
        """Names of the requirements."""
        return tuple(rule.name for rule in self.task.rules)

    @cached_property
    def _guides(self) -> tuple[ScaledRobustness, ...]:
        return tuple(ScaledRobustness(rule.formula) for rule in self.task.rules)

    @cached_property
    def _finer(self) -> Task | None:
        return None if self.finer is None else self.finer()

    def seen(self, requirement: int) -> float:
        """Share of the inputs' duration, at most 1, after which inputs no longer affect a requirement."""
        inputs = self.task.system.decl.inputs
        if not inputs:
            return 1.0
        longest = max(float(each.duration) for each in inputs)
        return min(self.task.rules[requirement].reach * self.task.system.dt / longest, 1.0)

    def simulate(self, points: NDArray[np.float64]) -> Simulations:
        """Simulate and judge `points`, (count, dim)."""
        states = self.points.states(torch.from_numpy(np.ascontiguousarray(points)))
        admissible = self.points.admissible(states).numpy()
        columns = self._moved(self.task, states)
        guidance = []
        for guide in self._guides:
            guide.measure(columns)
            guidance.append(guide(columns))
        margins = _margins(self.task, columns)
        broken = ~np.isfinite(np.stack([column[-1] for column in columns.values()])).all(0)
        margins = np.where(broken[:, None] | np.isnan(margins), -np.inf, margins)
        guided = np.where(np.isneginf(margins), -np.inf, np.stack(guidance, 1))
        return Simulations(margins, guided, admissible)

    def at_half_step(self, points: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Margins at half the time step, (count, requirements); None for a system in discrete time."""
        if self._finer is None:
            return None
        states = self.points.states(torch.from_numpy(np.ascontiguousarray(points)))
        return _margins(self._finer, self._moved(self._finer, states))

    def trace(self, points: NDArray[np.float64], seed: int | None = None) -> Trace:
        """Simulated trajectories of `points`, (count, dim), as a trace."""
        states = self.points.states(torch.from_numpy(np.ascontiguousarray(points)))
        return self.trace_from(states, seed)

    def trace_from(self, states: Tensor, seed: int | None = None) -> Trace:
        """Simulated trajectories from initial states (count, n), as a trace."""
        rho = _margins(self.task, self._moved(self.task, states)).min(1, initial=np.inf)
        nothing = torch.zeros(len(states))
        plans = self._plans(self.task, len(states))
        result = PlanResult(states, plans, torch.from_numpy(rho), nothing.bool(), nothing, nothing.long())
        return trace_of(self.task, result, seed)

    @staticmethod
    def _moved(task: Task, states: Tensor) -> Columns:
        """Simulate from initial states (count, n): signal -> (time, count), by the fastest kernel there is.

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


@cache
def _kernel(task: Task) -> NativeJudge | None:
    """Native kernel of a task's dynamics alone."""
    return NativeJudge.of(task.system, ())


def _margins(task: Task, columns: Columns) -> NDArray[np.float64]:
    """Exact robustness of the requirements of a task, (count, requirements)."""
    each = evaluate([rule.formula for rule in task.rules], columns, ops=NUMPY)
    count = next(iter(columns.values())).shape[1]
    return np.stack([np.broadcast_to(margin[0], (count,)) for margin in each], 1)
