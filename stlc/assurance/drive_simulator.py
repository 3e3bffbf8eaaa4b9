"""Closed-loop drives of a trained policy in its world, as a function of the random numbers of the world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import SearchSpace
from stlc.assurance.simulation import PARTS, Simulations, Simulator
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.deployment.batched import Setting, Worlds
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, Watch
from stlc.controller.deployment.simulator import simulate as run_worlds
from stlc.controller.deployment.tape import BELOW
from stlc.controller.evaluation.archive import trace_of
from stlc.controller.evaluation.rules import Rules
from stlc.controller.guard.guard import Guard
from stlc.controller.run.run import Run
from stlc.controller.world import world_type
from stlc.monitor.judgement import Verdict
from stlc.trace import Trace

MOST_COORDINATES = 4000
"""Random numbers of a drive at most that are searched; later ones are drawn."""
SEEDS = 2**31
"""Number of seeds from which the numbers without a coordinate may be drawn."""


@dataclass(frozen=True, slots=True)
class JudgedDrives:
    """Drives of several simulations, with their verdict.

    Attributes:
        verdict: verdict on all drives, simulation by simulation.
        agents: number of agents of a simulation.
    """

    verdict: Verdict
    agents: int

    @property
    def in_scope(self) -> NDArray[np.bool_]:
        """True for the drives that satisfy the assumptions of the specification, (count, agents)."""
        scope = self.verdict.requirements[0].scope
        inside = np.ones(1, dtype=np.bool_) if scope is None else np.asarray(scope)
        return np.broadcast_to(inside, (self.verdict.traces,)).reshape(-1, self.agents)

    @property
    def margins(self) -> NDArray[np.float64]:
        """Robustness of each drive, (count, agents, requirements).

        It is +inf where the assumptions of the specification do not hold: nothing is violated there.
        """
        each = np.stack([judgement.high.min(0) for judgement in self.verdict], 1)
        each = each.reshape(-1, self.agents, each.shape[1])
        return np.where(self.in_scope[..., None], each, np.inf)

    @property
    def inconclusive(self) -> NDArray[np.bool_]:
        """True for the drives that ended before their verdict, (count, agents)."""
        found: NDArray[np.bool_] = np.array(self.verdict.statuses) == "inconclusive"
        return found.reshape(-1, self.agents)


@dataclass(frozen=True)
class DriveSimulator(Simulator):
    """Simulator of drives: one world per point, whose random numbers are read from the point.

    The last coordinate of a point chooses the seed of all numbers for which there are no further coordinates.

    Attributes:
        run: the trained policy, with its scenario.
        guard: name of the guard.
        setting: agents, steps and replanning period, and a first seed.
        batch: number of worlds that are simulated side by side.
    """

    run: Run
    guard: str
    setting: Setting
    batch: int = 16

    @cached_property
    def _rules(self) -> Rules:
        """Specification by which drives are judged: that of the section `test`, or else that of the plans."""
        found = Rules.of(self.run)
        compiled = self.run.task.compiled
        return found or Rules(compiled.spec, compiled.name, self.run.task.system.decl.overrides)

    @cached_property
    def _guard(self) -> Guard:
        return Guard(self.run.task, self.run.policy, self.guard, limits=self.setting.limits)

    @cached_property
    def space(self) -> SearchSpace:
        """The search space: the random numbers that one simulation uses, `MOST_COORDINATES` at most."""
        point = np.random.default_rng(0).random(MOST_COORDINATES)
        worlds = Worlds(self.run.task, world_type(self.run.task.system.decl), self._at(point[None]))
        worlds.reset()
        first = 0 if worlds.tape is None else worlds.tape.used[0]
        dim = min(max(2 * first, first + 4 * self.setting.steps), MOST_COORDINATES) + 1
        return SearchSpace(dim, sparse=True)

    @property
    def part(self) -> int:
        """Number of points that are simulated at once where simulations are shared out."""
        return max(self.batch // PARTS, 1)

    @cached_property
    def requirements(self) -> tuple[str, ...]:
        """Names of the requirements on drives."""
        return tuple(each.name for each in self.judge(self.drive(np.full((1, 1), 0.5))).verdict)

    def simulate(self, points: NDArray[np.float64], requirement: int) -> Simulations:
        """Simulate `points`, (count, dim), and judge the drives by a requirement.

        A point is admissible if the assumptions of the specification hold for one of its agents. It has a
        verdict if one of them violates the requirement, or all have a verdict.
        """
        drives = self.judge(self.drive(points))
        margins = drives.margins.min(1)[:, requirement]
        open_ = np.array(drives.verdict.requirements[requirement].statuses) == "inconclusive"
        judged = TOLERANCE.violated(margins) | ~open_.reshape(len(points), -1).any(1)
        return Simulations(margins, np.asarray(drives.in_scope.any(1)), judged)

    def drive(self, points: NDArray[np.float64], watch: Watch | None = None) -> DeploymentRecording:
        """Simulate `points`, (count, dim), side by side, and return the recorded drives.

        `watch` is called at every step.
        """
        recorder = Recorder(self.setting.agents, pictured=False)
        world = world_type(self.run.task.system.decl)
        run_worlds(self._guard, world, self._at(points), recorder, watch)
        recording = recorder.recording()
        assert recording is not None
        return recording

    def judge(self, recording: DeploymentRecording) -> JudgedDrives:
        """Judge recorded drives by the specification of drives, or else by that of the plans."""
        return JudgedDrives(self._rules.verdict_on(self.run.task, recording), self.setting.agents)

    def trace(self, points: NDArray[np.float64]) -> Trace:
        """Drives at `points`, (count, dim), as a trace with one row per agent."""
        return trace_of(self.run, self.drive(points), self._at(points), self._rules)

    def _at(self, points: NDArray[np.float64]) -> Setting:
        (first,) = self.setting.seeds
        seeds = (first + int(min(each, BELOW) * SEEDS) for each in points[:, -1])
        return replace(self.setting, seeds=tuple(seeds), draws=tuple(points[:, :-1]))
