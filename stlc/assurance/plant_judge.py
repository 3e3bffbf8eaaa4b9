"""Simulations of a plant, judged by the specification of its signals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.grammar.spec import Spec
from stlc.jsontext import Num
from stlc.monitor.judgement import Verdict
from stlc.monitor.signals import arrange, needs_of
from stlc.monitor.streamed import verdict_of
from stlc.monitor.verdict import Monitor
from stlc.plants.plant import Plant, PlantFinding, PlantVariable, load_plant
from stlc.trace import Trace
from stlc.version import __version__

Floats: TypeAlias = NDArray[np.float64]
STREAMED = 1_000_000
"""Steps from which simulations are judged while they run, in constant memory."""


@dataclass(frozen=True, slots=True)
class PlantRequirement:
    """Result of one requirement on one simulation: verdict, robustness, and its bounds."""

    name: str
    verdict: str
    robustness: Num
    low: Num
    high: Num
    unit: str


@dataclass(frozen=True, slots=True)
class JudgedRun:
    """Simulation of a plant with its verdict.

    A simulation fails if the plant crashes, hangs or gives invalid outputs.

    Attributes:
        seed: seed of the simulation.
        point: name of each variable of the plant file -> its value.
        verdict: the verdict; None if the simulation failed.
        finding: the failure; None if there was none.
        trace: the trace; None if the simulation failed, or was judged while the plant ran.
    """

    JSON: ClassVar = "seed point samples verdict=outcome requirements finding"

    seed: int
    point: Mapping[str, float]
    verdict: Verdict | None
    finding: PlantFinding | None = None
    trace: Trace | None = None

    @property
    def samples(self) -> int:
        """Number of samples; 0 if the simulation failed."""
        return 0 if self.verdict is None else self.verdict.about.samples

    @property
    def outcome(self) -> Literal["satisfied", "violated", "inconclusive", "out of scope", "finding"]:
        """Verdict over all requirements, or that the simulation failed."""
        return "finding" if self.verdict is None else self.verdict.scoped

    @property
    def requirements(self) -> tuple[PlantRequirement, ...]:
        """Results of the requirements."""
        found = []
        for each in self.verdict or ():
            low, high = (float(end.min()) for end in each.margins)
            status, least = each.statuses[0], float(each.least[0])
            found.append(PlantRequirement(each.name, status, least, low, high, each.unit))
        return tuple(found)


@dataclass(frozen=True, slots=True)
class PlantSimulation:
    """Simulations of a plant, and their verdicts.

    Attributes:
        spec: name of the specification.
        plant: name of the plant.
        kind: kind of the plant.
        dt: time step in seconds.
        steps: number of steps.
        streamed: whether simulations were judged while they ran.
        trace: file of the traces; None if they were not written.
        runs: the simulations.
        variables: variables of the plant, in the order of points.
    """

    JSON: ClassVar = (
        "spec plant kind dt steps streamed satisfied violated inconclusive out_of_scope findings trace runs"
    )

    spec: str
    plant: str
    kind: str
    dt: float
    steps: int
    streamed: bool
    trace: str | None
    runs: tuple[JudgedRun, ...]
    variables: tuple[PlantVariable, ...] = ()

    def __repr__(self) -> str:
        satisfied = f"{self.satisfied} of {len(self.runs)} simulations satisfy every requirement"
        return f"PlantSimulation({self.spec} on {self.plant}: {satisfied})"

    def count(self, outcome: str) -> int:
        """Number of simulations with an outcome."""
        return sum(run.outcome == outcome for run in self.runs)

    @property
    def satisfied(self) -> int:
        """Number of simulations that satisfy every requirement."""
        return self.count("satisfied")

    @property
    def violated(self) -> int:
        """Number of simulations that violate a requirement."""
        return self.count("violated")

    @property
    def inconclusive(self) -> int:
        """Number of simulations that are too short."""
        return self.count("inconclusive")

    @property
    def out_of_scope(self) -> int:
        """Number of simulations that violate an assumption."""
        return self.count("out of scope")

    @property
    def findings(self) -> int:
        """Number of simulations that failed."""
        return self.count("finding")


@dataclass(frozen=True, slots=True)
class PlantJudge:
    """A plant with the specification of its signals.

    Attributes:
        plant: the black box, which the caller closes.
        monitor: the specification, compiled for the time step of the plant.
        overrides: constants of the specification with new values.
    """

    plant: Plant
    monitor: Monitor
    overrides: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def load(cls, spec: Path | str, plant: Path | str, overrides: Mapping[str, str]) -> PlantJudge:
        """Read a plant file and the specification of its signals; nothing is simulated.

        Raises:
            UsageError: U102, a file does not exist.
            SpecError, SystemFileError: a file is invalid.
            TraceError: E601, E605, the plant lacks a signal that the requirements read, or has another unit.
        """
        found = load_plant(plant)
        monitor = Monitor(Spec.load(spec), dt=found.decl.dt, overrides=overrides)
        compiled, signature = monitor.compiled, found.signature
        sample = Trace(
            signature,
            float(found.decl.dt),
            {name: np.zeros((1, 1)) for name in signature.names},
            name=found.decl.name,
        )
        arrange(sample, needs_of(compiled, [*compiled.requirements, *compiled.assumptions]), plain=True)
        return cls(found, monitor, overrides)

    def at_half_step(self) -> PlantJudge | None:
        """Return the same at half the time step; None if the plant file does not allow it."""
        if not self.plant.decl.halves:
            return None
        finer = self.plant.decl.at_half_step()
        return PlantJudge(
            Plant(finer), Monitor(self.monitor.spec, dt=finer.dt, overrides=self.overrides), self.overrides
        )

    @property
    def long(self) -> bool:
        """True if a simulation is so long that it is judged while the plant runs."""
        return self.plant.decl.steps >= STREAMED

    def random_points(self, seeds: Sequence[int]) -> Floats:
        """Return the random point of each seed, (seeds, dim)."""
        return np.array([self.plant.random_point(seed) for seed in seeds]).reshape(len(seeds), -1)

    def runs(
        self, points: Floats, seeds: Sequence[int], *, jobs: int = 1, stream: bool = False
    ) -> Iterator[JudgedRun]:
        """Simulate the plant at each point, (batch, dim), and yield the judged simulations in order.

        Args:
            points: values of the variables.
            seeds: seed of each simulation, for plants that draw random numbers.
            jobs: number of processes that simulate side by side; one if `stream`.
            stream: whether simulations are judged while they run, so that memory does not depend on their
                length. The runs then have no traces.

        Raises:
            SystemFileError: S401, the plant cannot be opened, or lacks what its file names.
            MissingError: R301, a package is not installed.
        """
        if stream:
            for point, seed in zip(points, seeds, strict=True):
                online = self.monitor.online(dt=self.plant.decl.dt)
                finding = self.plant.watch(point, online, seed=seed)
                yield JudgedRun(seed, self._named(point), None if finding else verdict_of(online), finding)
            return
        for first in range(0, len(points), jobs):
            chosen = range(first, min(first + jobs, len(points)))
            batch = [seeds[row] for row in chosen]
            for run in self.plant.simulate(points[chosen], seeds=batch, jobs=jobs):
                point, outcome = self._named(run.point), run.outcome
                if isinstance(outcome, PlantFinding):
                    yield JudgedRun(run.seed, point, None, outcome)
                else:
                    verdict = self.monitor.check(outcome).told(reasons=False)
                    yield JudgedRun(run.seed, point, verdict, trace=outcome)

    def stored(self, traces: Sequence[Trace]) -> Trace:
        """Join traces into one with the specification; shorter ones end in unknown samples (NaN)."""
        longest = max(trace.samples for trace in traces)
        data = {}
        for name in traces[0].signature.names:
            data[name] = np.full((len(traces), longest), np.nan)
            for row, trace in enumerate(traces):
                data[name][row, : trace.samples] = trace.data[name][0]
        spec = self.monitor.spec
        library = spec.imported_texts()
        meta = replace(
            traces[0].meta,
            spec_name=self.monitor.compiled.name,
            spec_path=spec.source.name,
            spec_text=spec.source.text,
            spec_library=library,
            spec_set=dict(self.overrides),
            spec_hash=spec.sha256,
            seed=traces[0].meta.seed if len(traces) == 1 else None,
            stlc_version=__version__,
        )
        return replace(traces[0], data=data, meta=meta)

    def _named(self, point: Floats) -> dict[str, float]:
        return {each.name: float(value) for each, value in zip(self.plant.variables, point, strict=True)}
