"""Simulations of a black box at points of the unit cube: start values, parameters and input signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stlc.assurance.falsify import Simulations
from stlc.assurance.search_space import SearchSpace, SignalBlock
from stlc.diagnostics import Diagnostic, RunError
from stlc.files import find_spec, read_source
from stlc.grammar.parse.parser import parse
from stlc.monitor.verdict import Monitor
from stlc.plants.plant import Plant, PlantFinding, load_plant
from stlc.trace import Trace

if TYPE_CHECKING:
    from stlc.plants.plant import PlantRun


@dataclass(frozen=True)
class PlantSimulator:
    """Simulator of a plant file.

    A simulation that fails has no margin: it counts as inadmissible, and is kept among the findings.

    Attributes:
        plant: the black box, which the caller closes.
        monitor: the specification of its signals.
        jobs: number of processes that simulate side by side.
        findings: failed simulations until now.
    """

    plant: Plant
    monitor: Monitor
    jobs: int = 1
    findings: list[PlantFinding] = field(default_factory=list)

    @classmethod
    def load(cls, spec: str, plant: Path, overrides: Mapping[str, str], jobs: int = 1) -> PlantSimulator:
        """Load a plant file and the specification of its signals.

        Raises:
            UsageError, SpecError, SystemFileError: a file is missing or invalid.
        """
        found = load_plant(plant)
        text = parse(read_source(find_spec(Path(spec))))
        return cls(found, Monitor(text, dt=found.decl.dt, overrides=overrides), jobs)

    @property
    def batch(self) -> int:
        """Number of simulations side by side."""
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
                blocks.append(SignalBlock(signal.name, values, times, () if times else shares))
        return SearchSpace(len(place), tuple(blocks))

    @cached_property
    def requirements(self) -> tuple[str, ...]:
        """Names of the requirements."""
        return self.monitor.requirements

    def seen(self, requirement: int) -> float:  # noqa: ARG002
        """Return 1, since all values of an input may affect a requirement."""
        return 1.0

    def simulate(self, points: NDArray[np.float64]) -> Simulations:
        """Simulate and judge `points`, (count, dim)."""
        runs = self.plant.simulate(self.plant.points_of(points), jobs=self.jobs)
        margins = np.stack([self._margins(run) for run in runs])
        failed: NDArray[np.bool_] = np.array([np.isnan(each).any() for each in margins], dtype=np.bool_)
        return Simulations(margins, margins, ~failed)

    def at_half_step(self, points: NDArray[np.float64]) -> NDArray[np.float64] | None:  # noqa: ARG002
        """Return None, since the time step of a black box is fixed by its plant file."""
        return None

    def trace(self, points: NDArray[np.float64], seed: int | None = None) -> Trace:  # noqa: ARG002
        """Simulate one point, (1, dim), and return its trace.

        Raises:
            RunError: R402, the simulation fails, as it did not before.
        """
        (run,) = self.plant.simulate(self.plant.points_of(points))
        if isinstance(run.outcome, PlantFinding):
            raise RunError(Diagnostic("R402", f"`{self.plant.decl.name}` failed: {run.outcome.message}"))
        return run.outcome

    def _margins(self, run: PlantRun) -> NDArray[np.float64]:
        """Robustness of each requirement, (requirements,); NaN if the simulation failed."""
        if isinstance(run.outcome, PlantFinding):
            self.findings.append(run.outcome)
            return np.full(len(self.requirements), np.nan)
        judgements: Sequence[float] = [float(each.high.min()) for each in self.monitor.check(run.outcome)]
        return np.array(judgements)
