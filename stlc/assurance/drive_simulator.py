"""Closed-loop drives of a trained policy in its world, as a function of the random numbers of the world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.search_space import SearchSpace
from stlc.assurance.simulation import PARTS, Simulations, Simulator
from stlc.compile.semantics.tolerance import violated
from stlc.controller.deployment.batched import Setting, Worlds
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, Watch
from stlc.controller.deployment.simulator import simulate as run_worlds
from stlc.controller.deployment.tape import BELOW
from stlc.controller.evaluation.archive import trace_of
from stlc.controller.evaluation.rules import Rules, rules_of, verdict_on_runs
from stlc.controller.guard.guard import Guard
from stlc.controller.world import world_type

if TYPE_CHECKING:
    from stlc.controller.run.run import Run
    from stlc.monitor.judgement import Verdict
    from stlc.trace import Trace

MOST_COORDINATES = 4000
"""Random numbers of a drive at most that are searched; later ones are drawn."""
SEEDS = 2**31
"""Number of seeds from which the numbers without a coordinate may be drawn."""


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
        found = rules_of(self.run)
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
        return tuple(each.name for each in self._verdict(self.drive(np.full((1, 1), 0.5))))

    def simulate(self, points: NDArray[np.float64], requirement: int) -> Simulations:
        """Simulate `points`, (count, dim), and judge the drives by a requirement.

        A point is admissible if the assumptions of the specification hold for one of its agents. It has a
        verdict if one of them violates the requirement, or all have a verdict.
        """
        verdict = self._verdict(self.drive(points))
        margins = self._margins(verdict).min(1)[:, requirement]
        inside = np.broadcast_to(_inside(verdict), (len(points) * self.setting.agents,))
        admissible: NDArray[np.bool_] = np.any(inside.reshape(len(points), -1), axis=1)
        open_ = np.array(verdict.requirements[requirement].statuses) == "inconclusive"
        judged = violated(margins) | ~open_.reshape(len(points), -1).any(1)
        return Simulations(margins, admissible, judged)

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

    def margins_of_agents(self, recording: DeploymentRecording) -> NDArray[np.float64]:
        """Robustness of each agent of each simulation, (count, agents, requirements).

        It is +inf where the assumptions of the specification do not hold: nothing is violated there.
        """
        return self._margins(self._verdict(recording))

    def inconclusive(self, recording: DeploymentRecording) -> NDArray[np.bool_]:
        """True for the agents of each simulation whose drive ended before its verdict, (count, agents)."""
        found = np.array(self._verdict(recording).statuses) == "inconclusive"
        each: NDArray[np.bool_] = found.reshape(-1, self.setting.agents)
        return each

    def _margins(self, verdict: Verdict) -> NDArray[np.float64]:
        inside = _inside(verdict)
        each = np.stack([np.where(inside, judgement.high.min(0), np.inf) for judgement in verdict], 1)
        return each.reshape(-1, self.setting.agents, each.shape[1])

    def trace(self, points: NDArray[np.float64]) -> Trace:
        """Drives at `points`, (count, dim), as a trace with one row per agent."""
        return trace_of(self.run, self.drive(points), self._at(points), self._rules)

    def _verdict(self, recording: DeploymentRecording) -> Verdict:
        return verdict_on_runs(self._rules, self.run.task, recording)

    def _at(self, points: NDArray[np.float64]) -> Setting:
        (first,) = self.setting.seeds
        seeds = (first + int(min(each, BELOW) * SEEDS) for each in points[:, -1])
        return replace(self.setting, seeds=tuple(seeds), draws=tuple(points[:, :-1]))


def _inside(verdict: Verdict) -> NDArray[np.bool_]:
    """True for the drives that satisfy the assumptions, (drives,), or (1,) if there are none."""
    scope = verdict.requirements[0].scope
    return np.ones(1, dtype=np.bool_) if scope is None else np.asarray(scope)
