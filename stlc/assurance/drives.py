"""Sequential deployment: drives of a trained, guarded policy in batches, until a claim is decided.

The certificate names everything that the drives depend on by hashes and versions, so that it can be compared
with a run later.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from stlc.assurance.certificate import (
    FORMAT,
    Assessment,
    Claim,
    Judged,
    Noun,
    Sample,
    assess,
    joined,
    together,
    wrong_numbers,
)
from stlc.compile.frontend.modules import spec_sha256
from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.deployment.simulator import Recorder, Setting, simulate
from stlc.controller.evaluation.executed import executed_robustness
from stlc.controller.evaluation.rules import Rules, rules_for, verdict_on_runs
from stlc.controller.guard.candidates import Limits, Mode
from stlc.controller.guard.guard import GUARD_VERSION, Guard
from stlc.controller.training.checkpoint import FOLDER, POINTER
from stlc.controller.training.run import CONFIG, spec_hash, system_hash, task_of_run
from stlc.controller.world import independent_agents, world_type
from stlc.dynamics.robots.functions import function_files
from stlc.jsontext import plain
from stlc.monitor.judgement import unknown_requirement
from stlc.provenance import hardware, sha256, versions
from stlc.rundir import RunDir, now

if TYPE_CHECKING:
    from stlc.controller.deployment.simulator import DeploymentRecording, Watch
    from stlc.controller.problem.task import Task
    from stlc.controller.training.run import Run

SEED = 1 << 41
"""First seed of certificates; those of `simulate` begin at 0, those after a training at 2^40."""
FIRST = 100
"""Number of units in the first batch, which calibrates the conformal bounds."""
BATCH = 50
"""Number of units in each further batch."""
ROWS = 1000
"""Largest number of agents that are simulated at once."""


# ---------------------------------------------------------------------- judging


def sample_of(
    task: Task,
    recording: DeploymentRecording,
    rules: Rules | None = None,
    require: Sequence[str] = (),
) -> Sample:
    """Judge a recorded deployment drive by drive; units are the worlds, or drives if agents are independent.

    Args:
        task: specification of the plans, and system.
        recording: the recorded drives.
        rules: specification of drives; None if the specification of the plans judges them.
        require: names of the requirements that count; all if empty.

    Raises:
        UsageError: U101, there is no such requirement.
        SpecError: the rules use names that the system does not have.
    """
    if rules is None:
        judged, weights = _judged_by_plans(task, recording)
    else:
        judged, weights = _judged_by_rules(task, recording, rules)
    names = [each.name for each in judged]
    for name in require:
        if name not in names:
            raise unknown_requirement(name, names)
    chosen = tuple(each for each in judged if each.name in require or not require)
    rows = len(recording.states)
    alone = recording.agents == 1 or independent_agents(world_type(task.system.decl))
    units = np.arange(rows) if alone else np.arange(rows) // recording.agents
    noun: Noun = "drive" if alone and recording.agents > 1 else "world"
    return Sample(together(chosen, weights), chosen, units, noun, recording.rho)


def _judged_by_plans(
    task: Task, recording: DeploymentRecording
) -> tuple[tuple[Judged, ...], Mapping[str, float]]:
    """Verdicts by the specification of the plans, from every start that has a whole window after it."""
    judged, found = [], executed_robustness(task, recording)
    for rule in task.rules:
        least = found[rule.name]
        known, held = ~np.isneginf(least), least >= -TOLERANCE
        judged.append(Judged(rule.name, rule.unit, held, known & ~held, least))
    return tuple(judged), {rule.name: rule.weight / rule.scale for rule in task.rules}


def _judged_by_rules(
    task: Task, recording: DeploymentRecording, rules: Rules
) -> tuple[tuple[Judged, ...], Mapping[str, float]]:
    found = [
        (
            judgement.rule,
            np.array(judgement.statuses),
            np.nan_to_num(judgement.low.min(0), nan=-np.inf, posinf=np.inf, neginf=-np.inf),
        )
        for judgement in verdict_on_runs(rules, task, recording)
    ]
    judged = tuple(
        Judged(rule.name, rule.unit, statuses == "satisfied", statuses == "violated", least)
        for rule, statuses, least in found
    )
    return judged, {rule.name: rule.weight / rule.scale for rule, _, _ in found}


# ---------------------------------------------------------------------- deploying


@dataclass(frozen=True, slots=True)
class Campaign:
    """A sequential deployment, as requested.

    Attributes:
        run: the run, with its scenario.
        rules: specification of drives; None if that of the plans judges them.
        guard: name of the guard.
        setting: options of each deployment; its seeds are not used.
        claim: the claim that the drives are to decide.
        require: names of the requirements that count; all if empty.
        width: width of the interval at which the deployment stops; None: it stops once the claim is decided.
        overrides: values of `--set` in the deployment.
        most: largest number of units.
        seeds: seeds fixed in advance, which are all driven; None: seeds from `SEED` on, as many as needed.
    """

    run: Run
    rules: Rules | None
    guard: Mode
    setting: Setting
    claim: Claim
    require: tuple[str, ...] = ()
    width: float | None = None
    overrides: Mapping[str, str] = field(default_factory=dict)
    most: int = 1000
    seeds: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class Progress:
    """State of a sequential deployment after a batch.

    Attributes:
        assessment: bounds from the drives so far.
        seeds: seeds so far.
        batches: number of batches so far.
        done: whether no further batch follows.
    """

    assessment: Assessment
    seeds: tuple[int, ...]
    batches: int
    done: bool


def campaign(order: Campaign, watch: Watch | None = None) -> Iterator[Progress]:
    """Deploy in batches, and yield the state of the deployment after each batch.

    Without fixed seeds, the deployment stops once the claim is answered, or the interval is as narrow as
    asked, or there are `order.most` units; only bounds that are valid at any stopping time are then used.

    Raises:
        SystemFileError: the world fails.
        RunError: R402, the policy's plan is not a number; R405, there is no start with a plan.
        UsageError: U101, there is no such requirement.
    """
    fixed, each = order.seeds is not None, _units_per_seed(order)
    first = min(FIRST, order.most)
    claim = replace(order.claim, any_time=not fixed, calibration=None if fixed else first)
    every = order.seeds or tuple(range(SEED, SEED + max(1, order.most // each)))
    parts: list[Sample] = []
    known, batches = 0, 0
    while known < len(every):
        count = len(every) if fixed else math.ceil((BATCH if known else first) / each)
        seeds = every[known : known + count]
        parts += driven(order, seeds, watch)
        known, batches = known + len(seeds), batches + 1
        assessment = assess(joined(parts), claim)
        done = known == len(every) or _answered(assessment, order.width)
        yield Progress(assessment, every[:known], batches, done)
        if done:
            return


def _answered(found: Assessment, width: float | None) -> bool:
    return found.width <= width if width is not None else found.answer in ("certified", "refuted")


def _units_per_seed(order: Campaign) -> int:
    alone = independent_agents(world_type(order.run.task.system.decl))
    return order.setting.agents if alone else 1


def driven(order: Campaign, seeds: Sequence[int], watch: Watch | None = None) -> Iterator[Sample]:
    """Simulate the worlds of `seeds`, at most about `ROWS` agents at once, and yield the judged drives.

    Raises:
        SystemFileError, RunError, UsageError: see `campaign`.
    """
    task, limit = order.run.task, order.setting
    limits = Limits(seconds=limit.limit, margin=limit.margin, paper=limit.paper_limit)
    size = max(1, ROWS // limit.agents)
    for begin in range(0, len(seeds), size):
        setting = replace(limit, seeds=tuple(seeds[begin : begin + size]))
        guard = Guard(task, order.run.policy, order.guard, limits=limits)
        recorder = Recorder(setting.agents, pictured=False)
        simulate(guard, world_type(task.system.decl), setting, recorder, watch)
        recording = recorder.recording()
        assert recording is not None
        yield sample_of(task, recording, order.rules, order.require)


# ---------------------------------------------------------------------- certificates


def certificate(order: Campaign, progress: Progress) -> dict[str, Any]:
    """Content of a certificate file: answer, bounds, assumptions, and everything that they depend on."""
    run, setting = order.run, order.setting
    document = {
        "certificate": FORMAT,
        "made": now(),
        "run": run.dir.shown,
        "spec": run.task.compiled.name,
        "system": run.task.system.decl.name,
        **progress.assessment.summary(),
        "width": order.width,
        "finished": progress.done,
        "batches": progress.batches,
        "inputs": inputs_of(run.dir, run.task, order.rules),
        "conditions": {
            "guard": order.guard,
            "scenario": None if run.task.system.decl.scenario is None else run.task.system.decl.scenario.name,
            "overrides": dict(order.overrides),
            "require": list(order.require),
            "margin": dict(setting.margin),
            "time_limit": setting.limit if order.guard == "full" else setting.paper_limit,
            "agents": setting.agents,
            "steps": setting.steps,
            "replan": setting.replan,
            "seeds": _ranges(progress.seeds),
        },
        "versions": versions(),
        "hardware": hardware(),
    }
    found: Any = plain(document)
    result: dict[str, Any] = found
    return result


def _ranges(seeds: Sequence[int]) -> list[list[int]]:
    """Seeds as ranges [first, last], in order."""
    found: list[list[int]] = []
    for seed in seeds:
        if found and seed == found[-1][1] + 1:
            found[-1][1] = seed
        else:
            found.append([seed, seed])
    return found


def inputs_of(folder: RunDir, task: Task, rules: Rules | None) -> dict[str, str | int | None]:
    """Hashes and versions of everything that the drives of a run depend on, beside their conditions.

    `spec`, `system`: files in the folder of the run, with imports and the changes of the training.
    `functions`: files that the system file names. `rules`: the specification of drives with its imports and
    changes, None if there is none. `world`: the file of the world, None for the model. `policy`: the
    checkpoint and the options of the method. `guard_version`: raised with every change of a guard's
    decisions.
    """
    decl = task.system.decl
    files = sorted(function_files(decl).items())
    judge = "" if rules is None else spec_sha256(rules.spec.source.text, rules.spec.library or {})
    changes = [] if rules is None else sorted(rules.overrides.items())
    return {
        "spec": spec_hash(folder),
        "system": system_hash(folder),
        "functions": sha256("\0".join(f"{name} {sha256(path.read_bytes())}" for name, path in files)),
        "rules": None if rules is None else sha256(f"{judge} {changes}"),
        "world": None if decl.test.world is None else sha256(decl.test.world.path.read_bytes()),
        "policy": _policy(folder),
        "guard_version": GUARD_VERSION,
    }


@dataclass(frozen=True, slots=True)
class Difference:
    """An entry of a certificate that differs now."""

    name: str
    certificate: str
    present: str


@dataclass(frozen=True, slots=True)
class CertificateVerification:
    """Comparison of a certificate with a run.

    Attributes:
        inputs: hashes and versions of inputs that differ; the certificate is then not about this run.
        numbers: bounds that do not follow from the counts in the certificate.
        software: versions of packages that differ.
    """

    inputs: tuple[Difference, ...]
    numbers: tuple[str, ...]
    software: tuple[Difference, ...]

    @property
    def same(self) -> bool:
        """True if the certificate is about this run, and its numbers are consistent."""
        return not self.inputs and not self.numbers


def verify(document: Mapping[str, Any], folder: RunDir) -> CertificateVerification:
    """Compare a certificate with the present state of a run's folder and of the software.

    The policy is not loaded, so that a changed checkpoint is a difference and not an error.

    Raises:
        KeyError, TypeError, ValueError: the document is no certificate.
        SpecError, SystemFileError, RunError: the folder is damaged.
    """
    conditions = document["conditions"]
    changed = {str(name): str(text) for name, text in conditions["overrides"].items()}
    scenario = conditions["scenario"]
    task = task_of_run(folder, changed, None if scenario is None else str(scenario))
    present = inputs_of(folder, task, rules_for(folder, task.system.decl))
    return CertificateVerification(
        _different(document["inputs"], present),
        tuple(wrong_numbers(document)),
        _different(document["versions"], versions()),
    )


def _different(then: Mapping[str, Any], present: Mapping[str, Any]) -> tuple[Difference, ...]:
    names = dict.fromkeys((*present, *then))
    pairs = ((str(name), str(then.get(name)), str(present.get(name))) for name in names)
    return tuple(Difference(*each) for each in pairs if each[1] != each[2])


def _policy(folder: RunDir) -> str:
    """Hash of the tensors of the newest checkpoint, if there is one, and of the resolved options."""
    pointer = folder.path / FOLDER / POINTER
    parts = [(folder.path / CONFIG).read_bytes()]
    if pointer.is_file():
        name = folder.read_json(f"{FOLDER}/{POINTER}")["file"]
        parts.append((folder.path / FOLDER / str(name)).read_bytes())
    return sha256(b"\0".join(sha256(part).encode() for part in parts))
