"""Drives of a trained, guarded policy in its world, as the subject of a certificate."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from stlc.assurance.campaign import (
    CertificateVerification,
    CertifiedConditions,
    CertifiedDrives,
    CertifiedInputs,
    StoredCertificate,
    compared,
    seed_ranges,
)
from stlc.assurance.certificate import Judged, Noun, Sample, together
from stlc.assurance.model_simulator import in_scope
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, Watch, simulate
from stlc.controller.evaluation.executed import executed_robustness
from stlc.controller.evaluation.rules import Rules
from stlc.controller.guard.guard import Guard
from stlc.controller.problem.task import Task
from stlc.controller.run.checkpoint import newest_tensors
from stlc.controller.run.run import Run
from stlc.controller.world import independent_agents, world_type
from stlc.dynamics.declaration.decl import SystemDecl
from stlc.jsontext import plain
from stlc.monitor.judgement import chosen
from stlc.provenance import sha256
from stlc.registry import GUARDS
from stlc.rundir import RunDir

ROWS = 1000
"""Largest number of agents that are simulated at once."""


# ---------------------------------------------------------------------- judging


def sample_of(
    task: Task,
    recording: DeploymentRecording,
    rules: Rules | None = None,
    require: Sequence[str] = (),
) -> Sample:
    """Judge a recorded deployment drive by drive; drives in which an assumption does not hold are left out.

    Independent observations are the worlds, or single drives if the agents of a world are independent.

    Args:
        task: specification of the plans, and system.
        recording: the recorded drives.
        rules: specification of drives; None if the specification of the plans judges them.
        require: names of the requirements that count; all if empty.

    Raises:
        UsageError: U101, there is no such requirement.
        SpecError: the rules use names that the system does not have.
    """
    rows = len(recording.states)
    if rules is None:  # undecided where a drive ends before a window does
        bounds = executed_robustness(task, recording)
        lows = ((rule, *bounds[rule.name]) for rule in task.rules)
        judged = tuple(
            Judged(each.name, each.unit, TOLERANCE.satisfied(a), TOLERANCE.violated(b), a)
            for each, a, b in lows
        )
        states = np.moveaxis(recording.states, -1, 0).swapaxes(1, 2)
        inside = in_scope(task, dict(zip(task.system.names, states, strict=True)))
        weights: Mapping[str, float] = {rule.name: rule.factor for rule in task.rules}
    else:
        verdict = rules.verdict_on(task, recording)
        judged, weights = tuple(map(Judged.by, verdict)), verdict.factors
        inside = np.broadcast_to(verdict.scope, (rows,))
    counted = chosen(judged, require)
    alone = recording.agents == 1 or independent_agents(world_type(task.system.decl))
    units = np.arange(rows) if alone else np.arange(rows) // recording.agents
    noun: Noun = "drive" if alone and recording.agents > 1 else "world"
    sample = Sample(together(counted, weights), counted, units, noun, recording.rho)
    return sample.in_scope(inside)


# ---------------------------------------------------------------------- deploying


@dataclass(frozen=True, slots=True)
class PolicyDrives:
    """Drives of a policy, as requested.

    Attributes:
        run: the run, with its scenario.
        rules: specification of drives; None if that of the plans judges them.
        guard: name of the guard.
        setting: options of each deployment; its seeds are not used.
        require: names of the requirements that count; all if empty.
        overrides: values of `--set` in the deployment.
        watch: function that is told about each step; None for none.
    """

    run: Run
    rules: Rules | None
    guard: str
    setting: Setting
    require: tuple[str, ...] = ()
    overrides: Mapping[str, str] = field(default_factory=dict)
    watch: Watch | None = None

    doing: ClassVar[str] = "driving"
    packages: ClassVar[tuple[str, ...]] = ()
    assumptions: ClassVar[tuple[str, ...]] = ()

    @property
    def per_seed(self) -> int:
        """Number of independent units that a seed gives: its agents, or the world that couples them."""
        alone = independent_agents(world_type(self.run.task.system.decl))
        return self.setting.agents if alone else 1

    def observed(self, seeds: Sequence[int]) -> Iterator[Sample]:
        """Simulate the worlds of `seeds`, at most about `ROWS` agents at once, and yield the judged drives.

        Raises:
            SystemFileError: the world fails.
            RunError: R402, the policy's plan is not a number; R405, there is no start with a plan.
            UsageError: U101, there is no such requirement.
        """
        task, limit = self.run.task, self.setting
        size = max(1, ROWS // limit.agents)
        for begin in range(0, len(seeds), size):
            setting = replace(limit, seeds=tuple(seeds[begin : begin + size]))
            guard = Guard(task, self.run.policy, self.guard, limits=limit.limits)
            recorder = Recorder(setting.agents, pictured=False)
            simulate(guard, world_type(task.system.decl), setting, recorder, self.watch)
            recording = recorder.recording()
            assert recording is not None
            yield sample_of(task, recording, self.rules, self.require)

    def record(self, seeds: Sequence[int]) -> CertifiedDrives:
        """Record of the run in the certificate, and of how its policy was deployed."""
        run, setting = self.run, self.setting
        scenario = run.task.system.decl.scenario
        conditions = CertifiedConditions(
            self.guard,
            None if scenario is None else scenario.name,
            self.overrides,
            self.require,
            setting.margin,
            setting.limit if GUARDS.get(self.guard).timed else setting.paper_limit,
            *(setting.agents, setting.steps, setting.replan),
            seed_ranges(seeds),
        )
        decl = run.task.system.decl
        inputs = inputs_of(run.dir, decl, self.rules, self.guard)
        return CertifiedDrives(run.dir.shown, run.task.compiled.name, decl.name, inputs, conditions)

    def close(self) -> None:
        """Do nothing: drives have no processes of their own."""


# ---------------------------------------------------------------------- verification


def inputs_of(folder: RunDir, decl: SystemDecl, rules: Rules | None, guard: str) -> CertifiedInputs:
    """Return the present inputs of the drives of a run.

    Raises:
        UsageError: U101, there is no guard called `guard`.
    """
    files = sorted(decl.files.items())
    judge = "" if rules is None else rules.spec.sha256
    changes = [] if rules is None else sorted(rules.overrides.items())
    return CertifiedInputs(
        folder.hashes["spec_hash"],
        folder.hashes["system_hash"],
        functions=sha256("\0".join(f"{name} {sha256(path.read_bytes())}" for name, path in files)),
        rules=None if rules is None else sha256(f"{judge} {changes}"),
        world=None if decl.test.world is None else sha256(decl.test.world.path.read_bytes()),
        policy=sha256("\0".join(map(sha256, (folder.read(RunDir.CONFIG), *newest_tensors(folder))))),
        guard_version=GUARDS.get(guard).version,
    )


def verify(stored: StoredCertificate, folder: RunDir) -> CertificateVerification:
    """Compare a certificate with the present state of a run's folder and of the software.

    The policy is not loaded, so that a changed checkpoint is a difference and not an error.

    Raises:
        ValueError: its numbers are no counts of drives.
        UsageError: U101, there is no such guard.
        SpecError, SystemFileError, RunError: the folder is damaged.
    """
    conditions = stored.conditions
    decl = Run.declaration_in(folder, conditions.overrides, conditions.scenario)
    present: Any = plain(inputs_of(folder, decl, Rules.stored(folder, decl), conditions.guard))
    return compared(stored, present)
