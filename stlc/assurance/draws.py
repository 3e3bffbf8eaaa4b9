"""Simulations drawn as a file declares, as the subject of a certificate: of a plant, or of a system.

Start values, parameters and input signals are drawn for each seed. A simulation is one observation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from stlc.assurance.campaign import CertificateVerification, StoredCertificate, compared, seed_ranges
from stlc.assurance.certificate import Judged, Sample, together
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.jsontext import Count
from stlc.monitor.judgement import chosen
from stlc.plants.declaration import PlantDecl, load_plant_decl
from stlc.provenance import sha256

if TYPE_CHECKING:
    from stlc.assurance.model_simulator import ModelSimulator
    from stlc.assurance.plant_judge import PlantJudge
    from stlc.compile.pipeline import CompiledRequirement
    from stlc.plants.plant import PlantFinding

MOST_FINDINGS = 20
"""Findings that a certificate describes; all are counted."""
MISSING = "missing"
"""Entry of the certificate for a file that does not exist."""


@dataclass(frozen=True, slots=True)
class PlantDraws:
    """Simulations of a plant at random points.

    Attributes:
        judge: the plant, which the caller closes, and the specification of its signals.
        spec: path of the specification.
        require: names of the requirements that count; all if empty.
        overrides: constants of the specification with new values.
        jobs: number of processes that simulate side by side.
        findings: failed simulations until now.
    """

    judge: PlantJudge
    spec: Path
    require: tuple[str, ...] = ()
    overrides: Mapping[str, str] = field(default_factory=dict)
    jobs: int = 1
    findings: list[PlantFinding] = field(default_factory=list)

    doing: ClassVar[str] = "simulating"
    per_seed: ClassVar[int] = 1
    assumptions: ClassVar[tuple[str, ...]] = (
        "a simulation does not depend on those before it in the same process (`fresh: true` makes sure)",
        "a failed simulation counts as not satisfied; time limits depend on the speed of the machine",
        "nothing is said about how far the simulated plant is from a real one",
    )

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages that simulate the plant."""
        return self.judge.plant.decl.packages

    def observed(self, seeds: Sequence[int]) -> Iterator[Sample]:
        """Simulate the plant at the random point of each seed, and yield the judged simulations.

        A simulation in which the assumptions of the specification do not hold is left out.

        Raises:
            SystemFileError: S401, the plant cannot be opened, or lacks what its file names.
            MissingError: R301, a package is not installed.
            UsageError: U101, there is no such requirement.
        """
        rules = chosen(self.judge.monitor.compiled.requirements, self.require)
        points = self.judge.random_points(seeds)
        for run in self.judge.runs(points, seeds, jobs=self.jobs, stream=self.judge.long):
            if run.finding is not None:
                self.findings.append(run.finding)
            if run.verdict is not None:
                judged = [Judged.by(run.verdict[rule.name]) for rule in rules]
            else:  # without a trace, it violates all
                no, yes, worst = np.array([False]), np.array([True]), np.array([-np.inf])
                judged = [Judged(rule.name, rule.unit, no, yes, worst) for rule in rules]
            sample = _sample(rules, judged)
            yield sample.in_scope(np.array([run.verdict is None or run.verdict.in_scope > 0]))

    def record(self, seeds: Sequence[int]) -> CertifiedDraws:
        """Record of the plant in the certificate, its files, its failures, and the conditions."""
        decl, monitor = self.judge.plant.decl, self.judge.monitor
        shown = self.findings[:MOST_FINDINGS]
        found = [FailedDraw(e.seed, e.reason, e.message, e.time, dict(e.point)) for e in shown]
        return CertifiedDraws(
            "plant",
            *(monitor.compiled.name, self.spec, decl.name, decl.path),
            plant_inputs(monitor.spec, decl),
            DrawnConditions(self.overrides, self.require, seed_ranges(seeds)),
            CertifiedFindings(len(self.findings), tuple(found)),
        )

    def close(self) -> None:
        """End the processes of the plant."""
        self.judge.plant.close()


@dataclass(frozen=True, slots=True)
class ModelDraws:
    """Simulations of a system without controls from random initial states.

    Attributes:
        simulator: the system, with its specification.
        spec: path of the specification.
        require: names of the requirements that count; all if empty.
        overrides: values of `--set`.
    """

    simulator: ModelSimulator
    spec: Path
    require: tuple[str, ...] = ()
    overrides: Mapping[str, str] = field(default_factory=dict)

    doing: ClassVar[str] = "simulating"
    per_seed: ClassVar[int] = 1
    packages: ClassVar[tuple[str, ...]] = ()
    assumptions: ClassVar[tuple[str, ...]] = (
        "a simulation whose states are not finite counts as not satisfied",
        "nothing is said about the error of time steps, nor about how far the model is from a real system",
    )

    def observed(self, seeds: Sequence[int]) -> Iterator[Sample]:
        """Simulate the system from the initial state of each seed, and yield the judged simulations.

        A simulation in which the assumptions of the specification do not hold is left out.

        Raises:
            SystemFileError: S301, the conditions `where` reject (nearly) every state.
            UsageError: U101, there is no such requirement.
        """
        import torch

        from stlc.assurance.model_simulator import in_scope

        task = self.simulator.task
        rules = chosen(task.rules, self.require)
        states = [task.system.sample(1, seed=seed, dtype=torch.float64) for seed in seeds]
        columns = self.simulator.columns_of(task, torch.cat(states))
        scope = in_scope(task, columns)
        found: Sequence[Any] = evaluate([rule.formula for rule in rules], columns)
        margins = np.stack([np.broadcast_to(each[0], len(seeds)) for each in found])
        finite = np.isfinite(np.stack([column[-1] for column in columns.values()])).all(0)
        margins = np.where(finite & ~np.isnan(margins), margins, -np.inf)
        judged = [
            Judged(rule.name, rule.unit, TOLERANCE.satisfied(row), TOLERANCE.violated(row), row)
            for rule, row in zip(rules, margins, strict=True)
        ]
        yield _sample(rules, judged).in_scope(scope)

    def record(self, seeds: Sequence[int]) -> CertifiedDraws:
        """Record of the system in the certificate, its files, and the conditions."""
        task = self.simulator.task
        decl = task.system.decl
        return CertifiedDraws(
            "system",
            *(task.compiled.name, self.spec, decl.name, decl.path),
            system_inputs(task.compiled.spec, decl.path, self.overrides),
            DrawnConditions(self.overrides, self.require, seed_ranges(seeds)),
            CertifiedFindings(0, ()),
        )

    def close(self) -> None:
        """Do nothing: the system is simulated in this process."""


@dataclass(frozen=True, slots=True)
class FailedDraw:
    """Simulation of a plant that failed, as a certificate states it; see `stlc.plants.plant.PlantFinding`."""

    seed: int
    reason: str
    message: str
    time: float | None
    point: dict[str, float]


@dataclass(frozen=True, slots=True)
class CertifiedFindings:
    """Number of failed simulations, and the first of them."""

    count: Count
    first: tuple[FailedDraw, ...]


@dataclass(frozen=True, slots=True)
class DrawnConditions:
    """Options of the simulations of a plant or system; seeds are ranges [first, last]."""

    overrides: Mapping[str, str]
    require: Sequence[str]
    seeds: Sequence[Sequence[int]]


@dataclass(frozen=True, slots=True)
class CertifiedDraws:
    """Plant or system of a certificate; the inputs are hashes of its files and of the specification."""

    kind: Literal["plant", "system"]
    spec: str
    spec_file: Path
    system: str
    system_file: Path
    inputs: dict[str, str]
    conditions: DrawnConditions
    findings: CertifiedFindings


def _sample(rules: Sequence[CompiledRequirement], judged: Sequence[Judged]) -> Sample:
    weights = {rule.name: rule.factor for rule in rules}
    units = np.arange(len(judged[0].satisfied))
    return Sample(together(judged, weights), tuple(judged), units, "simulation")


# ---------------------------------------------------------------------- verification


def plant_inputs(spec: Spec, decl: PlantDecl) -> dict[str, str]:
    """Hashes of what the simulations of a plant depend on.

    `spec`: the specification with its imports. `plant`: the plant file. `file …`: each file that the plant
    file names, and the modules beside it that a Python file imports. Installed packages are compared by their
    versions.
    """
    files = {f"file {name}": _file_hash(path) for name, path in sorted(decl.files.items())}
    return {"spec": spec.sha256, "plant": sha256(decl.source.text), **files}


def system_inputs(spec: Spec, system: Path, overrides: Mapping[str, str]) -> dict[str, str]:
    """Hashes of what the simulations of a system depend on: as `plant_inputs`."""
    from stlc.dynamics.load import load_system_decl

    files = load_system_decl(system, overrides).files
    hashes = {f"file {name}": _file_hash(path) for name, path in sorted(files.items())}
    return {"spec": spec.sha256, "system": sha256(File(system).read().text), **hashes}


def _file_hash(path: Path) -> str:
    return sha256(path.read_bytes()) if path.is_file() else MISSING


def verify_draws(stored: StoredCertificate, spec: str | None, system: str | None) -> CertificateVerification:
    """Compare a certificate with the present files of its specification and of its plant or system.

    Nothing is simulated, and nothing that the files name is run.

    Args:
        stored: content of the certificate.
        spec: path of the specification; by default the one that the certificate names.
        system: path of the plant file or system file; by default the one that the certificate names.

    Raises:
        ValueError: its numbers are no counts of drives.
        UsageError, SpecError, SystemFileError: a file is missing or invalid.
    """
    text = Spec.load(spec or stored.spec_file)
    named = Path(system or stored.system_file)
    if stored.kind == "plant":
        decl = load_plant_decl(named)
        return compared(stored, plant_inputs(text, decl), decl.packages)
    found = File(named).system(text.source.name)
    return compared(stored, system_inputs(text, found, stored.conditions.overrides))
