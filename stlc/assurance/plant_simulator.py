"""Simulations of a black box at points of the unit cube: start values, parameters and input signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.guidance import ScaledRobustness
from stlc.assurance.search_space import Point, SearchSpace, SignalBlock
from stlc.assurance.simulation import Focus, Simulations
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.discretize import counts_samples
from stlc.compile.ir.traverse import nodes
from stlc.diagnostics import Diagnostic, SystemFileError
from stlc.monitor.instants import rule_bounds, starts_of
from stlc.monitor.signals import arrange, needs_of
from stlc.monitor.values import Record
from stlc.monitor.verdict import Monitor
from stlc.plants.judge import PlantJudge
from stlc.plants.plant import Plant, PlantFinding, PlantRun

if TYPE_CHECKING:
    from stlc.compile.pipeline import CompiledRequirement
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


@dataclass(frozen=True, slots=True)
class _JudgedTrace:
    """One simulation under one requirement.

    Attributes:
        margin: exact robustness; +inf if the simulation failed.
        guidance: robustness with scaled predicates.
        sizes: sizes of the margins of the predicates, (predicates,); empty if they are not wanted.
        inside: whether the assumptions of the specification hold.
        failed: whether there is no trace.
        judged: whether there is a verdict: a simulation that ended early may have none.
    """

    margin: float
    guidance: float
    sizes: NDArray[np.float64]
    inside: bool = True
    failed: bool = False
    judged: bool = True


@dataclass(frozen=True)
class _Judging:
    """Judgement of simulations by the requirements of a monitor, with scaled guidance."""

    monitor: Monitor

    @cached_property
    def _guides(self) -> tuple[ScaledRobustness, ...]:
        return tuple(ScaledRobustness(rule.formula) for rule in self.monitor.compiled.requirements)

    def __call__(self, run: PlantRun, focus: Focus) -> _JudgedTrace:
        """Judge one simulation."""
        guide, compiled = self._guides[focus.requirement], self.monitor.compiled
        sizes = np.zeros(len(guide.predicates) if focus.sized else 0)
        if isinstance(run.outcome, PlantFinding):
            return _JudgedTrace(np.inf, np.inf, sizes, failed=True, judged=False)
        rule = compiled.requirements[focus.requirement]
        verdict = self.monitor.check(run.outcome, require=(rule.name,))
        margin = float(verdict.requirements[0].high.min())
        inside, judged = verdict.statuses[0] != "out of scope", verdict.statuses[0] != "inconclusive"
        signals, guidance = arrange(run.outcome, needs_of(compiled, [rule]), plain=True), margin
        if focus.sized:
            (sizes,) = guide.sizes(signals.env)
        if focus.scales is not None:
            scaled = guide.scaled(focus.scales)
            rule = replace(rule, formula=scaled, lowered=scaled)
            starts = starts_of(rule, signals.samples, compiled.grid.horizon, None)
            record = Record.of(signals.env, signals.ops)
            _, high = rule_bounds(rule, record, starts, compiled.grid.horizon, "open")
            guidance = float(high.min())
        return _JudgedTrace(margin, guidance, sizes, inside, judged=judged)


def _together(found: Sequence[_JudgedTrace]) -> Simulations:
    """Outcomes of several simulations; the sizes of failed ones are taken to be typical of the others."""
    sizes = np.stack([each.sizes for each in found])
    failed = np.array([each.failed for each in found], dtype=np.bool_)
    if failed.any() and not failed.all():
        sizes[failed] = np.median(sizes[~failed], axis=0)
    return Simulations(
        np.array([each.margin for each in found]),
        np.array([each.guidance for each in found]),
        np.array([each.inside for each in found], dtype=np.bool_),
        sizes,
        np.array([each.judged for each in found], dtype=np.bool_),
    )


@dataclass(frozen=True)
class PlantSimulator:
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

    @cached_property
    def _judging(self) -> _Judging:
        return _Judging(self.judge.monitor)

    def seen(self, requirement: int) -> float:
        """Share of the duration, at most 1, after which values of inputs no longer affect a requirement.

        An input may affect outputs at the same time, so the last sample that the requirement reads counts.
        """
        decl = self.plant.decl
        compiled = self.monitor.compiled
        read_by = (compiled.requirements[requirement], *compiled.assumptions)
        if not decl.free or any(_reads_everything(rule) for rule in read_by):
            return 1.0
        return min((max(rule.reach for rule in read_by) + 1) * float(decl.dt) / float(decl.duration), 1.0)

    def graded(self, requirement: int) -> bool:  # noqa: ARG002
        """True: the outputs of a plant are real numbers."""
        return True

    # ------------------------------------------------------------------------ simulation

    def simulate(self, points: NDArray[np.float64], focus: Focus) -> Simulations:
        """Simulate and judge `points`, (count, dim)."""
        runs = self.plant.simulate(self.plant.points_of(points), jobs=self.jobs)
        for point, run in zip(points, runs, strict=True):
            known = any(np.array_equal(each.point, point) for each in self.findings)
            if isinstance(run.outcome, PlantFinding) and not known:
                self.findings.append(FailedSimulation(point, run.outcome))
        return _together([self._judging(run, focus) for run in runs])

    def at_half_step(self, points: NDArray[np.float64], focus: Focus) -> Simulations | None:
        """Outcomes at half the time step; None if the plant file does not allow it.

        None too for a requirement that counts samples, which would mean other times there.

        The margin of a simulation without a verdict is NaN there: it neither confirms a violation nor refutes
        it.
        """
        rule = self.monitor.compiled.requirements[focus.requirement]
        if self._finer is None or counts_samples(rule.typed.formula):
            return None
        plant = self._finer.plant
        found = [self._finer_judging(run, focus) for run in plant.simulate(plant.points_of(points))]
        confirmed = [each if each.judged else replace(each, margin=np.nan) for each in found]
        return _together(confirmed)

    def gradient(self, point: Point, requirement: int) -> Point | None:  # noqa: ARG002
        """None: a black box has no gradient."""
        return None

    @cached_property
    def _finer_judging(self) -> _Judging:
        assert self._finer is not None
        return _Judging(self._finer.monitor)

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
            raise SystemFileError(Diagnostic("S401", message, decl.places.get(decl.kind), note=note))
        return self.judge.stored([found])


def _reads_everything(rule: CompiledRequirement) -> bool:
    """True if a requirement reads a simulation to its end, whatever its length."""
    ahead = (node for node in nodes(rule.formula) if isinstance(node, ir.Windowed) and not node.back)
    return rule.windowed or rule.uses_end or any(node.window.hi is None for node in ahead)
