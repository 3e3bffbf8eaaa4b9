"""Simulations of a black box at points of the unit cube: start values, parameters and input signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.plant_judge import PlantJudge
from stlc.assurance.search_space import Point, SearchSpace, SignalBlock
from stlc.assurance.simulation import Simulations, Simulator
from stlc.diagnostics import SystemFileError
from stlc.monitor.verdict import Monitor
from stlc.plants.plant import Plant, PlantFinding, PlantRun
from stlc.trace import Trace


@dataclass(frozen=True, slots=True)
class FailedSimulation:
    """A point at which a plant gave no trace.

    Attributes:
        point: the point of the unit cube, (dim,).
        finding: the failure.
    """

    point: Point
    finding: PlantFinding


@dataclass(frozen=True, slots=True)
class RepeatedSimulation:
    """Trace of a point that was simulated once more.

    Attributes:
        trace: the trace, with the specification.
        margin: its exact robustness.
    """

    trace: Trace
    margin: float


@dataclass(frozen=True)
class PlantSimulator(Simulator):
    """Simulator of a plant file.

    A simulation that fails gives no trace, so that it violates no requirement: its robustness is +inf, and it
    is kept among the findings. A simulation in which the assumptions of the specification do not hold is not
    admissible.

    Attributes:
        judge: the black box, which the caller closes, and the specification of its signals.
        jobs: number of processes that simulate side by side.
        findings: failed simulations until now, one for each point.
    """

    judge: PlantJudge
    jobs: int = 1
    findings: list[FailedSimulation] = field(default_factory=list)

    @classmethod
    def load(cls, spec: str, plant: Path, overrides: Mapping[str, str], jobs: int = 1) -> PlantSimulator:
        """Load a plant file and the specification of its signals.

        Raises:
            UsageError, SpecError, SystemFileError, TraceError: see `PlantJudge.load`.
        """
        return cls(PlantJudge.load(spec, plant, overrides), jobs)

    @property
    def plant(self) -> Plant:
        """The black box."""
        return self.judge.plant

    @property
    def monitor(self) -> Monitor:
        """The specification of its signals."""
        return self.judge.monitor

    @property
    def batch(self) -> int:
        """Number of simulations side by side."""
        return self.jobs

    @property
    def part(self) -> int:
        """Number of points that are simulated at once where simulations are shared out: one per process."""
        return self.jobs

    @cached_property
    def space(self) -> SearchSpace:
        """The search space: a coordinate per variable of the plant."""
        place = {each.name: index for index, each in enumerate(self.plant.variables)}
        blocks = []
        for signal in self.plant.decl.free:
            if all(name in place for name in signal.columns):
                shares = tuple(float(end / signal.duration) for end in signal.ends[: signal.points])
                values = tuple(place[name] for name in signal.values)
                times = tuple(place[name] for name in signal.times)
                blocks.append(SignalBlock(signal.name, values, times, () if times else shares, signal.lead))
        return SearchSpace(len(place), tuple(blocks))

    @cached_property
    def requirements(self) -> tuple[str, ...]:
        """Names of the requirements."""
        return self.monitor.requirements

    def seen(self, requirement: int) -> float:
        """Share of the duration, at most 1, after which values of inputs no longer affect a requirement.

        An input may affect outputs at the same time, so the last sample that the requirement reads counts.
        """
        decl = self.plant.decl
        compiled = self.monitor.compiled
        read_by = (compiled.requirements[requirement], *compiled.assumptions)
        for rule in read_by:  # one that reads a simulation to its end, whatever its length
            if rule.windowed or rule.uses_end:
                return 1.0
        if not decl.free:
            return 1.0
        return min((max(rule.reach for rule in read_by) + 1) * float(decl.dt) / float(decl.duration), 1.0)

    # ------------------------------------------------------------------------ simulation

    def simulate(self, points: NDArray[np.float64], requirement: int) -> Simulations:
        """Simulate `points`, (count, dim), and judge them by a requirement."""
        runs = self.plant.simulate(self.plant.points_of(points), jobs=self.jobs)
        for point, run in zip(points, runs, strict=True):
            known = any(np.array_equal(each.point, point) for each in self.findings)
            if isinstance(run.outcome, PlantFinding) and not known:
                self.findings.append(FailedSimulation(point, run.outcome))
        return _judged(self.monitor, runs, requirement)

    def at_half_step(self, points: NDArray[np.float64], requirement: int) -> Simulations | None:
        """Outcomes at half the time step; None if the plant file does not allow it.

        None too for a requirement that counts samples, which would mean other times there.
        """
        rule = self.monitor.compiled.requirements[requirement]
        if self._finer is None or rule.typed.formula.counts_samples:
            return None
        plant = self._finer.plant
        return _judged(self._finer.monitor, plant.simulate(plant.points_of(points)), requirement)

    @cached_property
    def _finer(self) -> PlantJudge | None:
        return self.judge.at_half_step()

    def close(self) -> None:
        """End all processes of the plant."""
        self.plant.close()
        finer = self.__dict__.get("_finer")
        if finer is not None:
            finer.plant.close()

    def outcome(self, point: Point) -> Trace | PlantFinding:
        """Simulate one point, (dim,); return its trace, or the failure."""
        (run,) = self.plant.simulate(self.plant.points_of(point[None]))
        return run.outcome

    def repeated(self, point: Point, requirement: int) -> RepeatedSimulation:
        """Simulate a point, (dim,), once more, and judge what is kept of it.

        Raises:
            SystemFileError: S401, the simulation fails, as it did not before.
        """
        trace = self.trace(point[None])
        verdict = self.monitor.check(trace, require=(self.requirements[requirement],))
        return RepeatedSimulation(trace, float(verdict.requirements[0].high.min()))

    def trace(self, points: NDArray[np.float64], seed: int | None = None) -> Trace:  # noqa: ARG002
        """Simulate one point, (1, dim), and return its trace, with the specification.

        Raises:
            SystemFileError: S401, the simulation fails, as it did not before.
        """
        found = self.outcome(points[0])
        if isinstance(found, PlantFinding):
            decl = self.plant.decl
            message = f"`{decl.name}` gave a trace, and fails when it is simulated again at the same point"
            note = (f"{found.reason}: {found.message}",)
            raise SystemFileError.of("S401", message, decl.places.get(decl.kind), note=note)
        return self.judge.stored([found])


def _judged(monitor: Monitor, runs: Sequence[PlantRun], requirement: int) -> Simulations:
    """Judge simulations by a requirement; the robustness of a failed one is +inf."""
    name = monitor.compiled.requirements[requirement].name
    margins = np.full(len(runs), np.inf)
    inside, judged = np.ones(len(runs), dtype=np.bool_), np.zeros(len(runs), dtype=np.bool_)
    for index, run in enumerate(runs):
        if not isinstance(run.outcome, PlantFinding):
            verdict = monitor.check(run.outcome, require=(name,))
            margins[index] = verdict.requirements[0].high.min()
            inside[index] = verdict.statuses[0] != "out of scope"
            judged[index] = verdict.statuses[0] != "inconclusive"
    return Simulations(margins, inside, judged)
