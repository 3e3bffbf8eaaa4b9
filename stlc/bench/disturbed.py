"""`stlc bench disturbed`: policies in worlds that are not as the model says, without a guard and with one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import torch

from stlc.bench.cells import BENCHMARKS, read_json
from stlc.controller.deployment.simulator import Recorder, Setting, drive
from stlc.controller.evaluation.deployment import decided, feasible_states, measure
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.evaluation.stats import Interval
from stlc.controller.guard.feasibility import savable
from stlc.controller.guard.guard import Guard, Mode
from stlc.controller.guard.margin_request import Asked, parse_margins
from stlc.controller.guard.plan_repair import Limits
from stlc.controller.training.run import SPEC, SYSTEM, Run
from stlc.controller.world import world_type
from stlc.diagnostics import Diagnostic, UsageError
from stlc.dynamics.declaration.deployment import ErrorsDecl
from stlc.dynamics.scenarios.scenario import DISTURBED
from stlc.files import write_atomic
from stlc.jsontext import dumps
from stlc.provenance import git_state, hardware, sha256, versions
from stlc.registry import closest
from stlc.rundir import RunDir, now

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.controller.problem.task import Task

FORMAT = "bench-disturbed/1"
FILE = "disturbed.json"
NOMINAL = "as it is"
SCENARIOS = (NOMINAL, *DISTURBED)
GUARDS: tuple[Mode, ...] = ("none", "paper", "full")
USUAL = (*GUARDS, "full+auto")
"""Guards, and behind a `+` what they ask safety requirements to spare; see `guard.margin_request`."""
SHOWN = (
    *(
        "saved",
        "saved_starts",
        "savable",
        "executed_safe",
        "executed_starts",
        "executed_safe_starts",
        "foreseen_safe_starts",
        "quiet",
        "quiet_safe_starts",
    ),
    *("plan_accuracy", "plan_safety", "policy_accuracy", "feasible", "feasible_followed"),
)
"""The metrics that are kept; see `stlc.controller.evaluation.deployment.METRICS`."""


@dataclass(frozen=True, slots=True)
class Extent:
    """Which deployments are wanted.

    Attributes:
        scenarios: some of `SCENARIOS`, or others that the systems know.
        guards: such as those of `USUAL`.
        seeds: of the deployments.
        agents: in each, at most; None: as many as the system says.
        steps: of each, at most; None: as many as the system says.
        limit: seconds that a decision of the full guard may take per agent.
        ceiling: visited states that are searched for a plan; see
            `stlc.controller.evaluation.deployment.feasible_states`.
        file: that the deployments are kept in.
    """

    scenarios: Sequence[str] = SCENARIOS
    guards: Sequence[str] = USUAL
    seeds: tuple[int, ...] = (0, 1, 2)
    agents: int | None = None
    steps: int | None = None
    limit: float | None = 0.1
    ceiling: int = 0
    file: str = FILE

    def setting(self, run: Run) -> Setting:
        """How a run is deployed."""
        test = run.task.system.decl.test
        agents = min(self.agents or test.agents, test.agents)
        steps = min(self.steps or test.steps, test.steps)
        return Setting(self.seeds, agents, steps, test.replan, self.limit, self.ceiling)


@dataclass(frozen=True, slots=True)
class Deployed:
    """A deployment of the table.

    Attributes:
        name: such as `traffic-noise-paper`.
        document: what is kept of it.
        kept: it was there already.
    """

    name: str
    document: Mapping[str, Any]
    kept: bool


def fill(
    runs: Sequence[RunDir], extent: Extent, folder: Path, begun: Callable[[str], None] = lambda _: None
) -> Iterator[Deployed]:
    """All deployments, one after the other; each is kept as soon as it is over, and never driven twice.

    Args:
        runs: of the policies.
        extent: which scenarios and guards, and how long.
        folder: of the results.
        begun: called with the name of a deployment before it starts.

    Raises:
        RunError, SystemFileError: a run is damaged, or a world fails.
    """
    for folder_of_run in runs:
        starts = _Starts()
        for scenario in extent.scenarios:
            laid = Run.open(folder_of_run.path, scenario=None if scenario == NOMINAL else scenario)
            setting = extent.setting(laid)
            for guard in extent.guards:
                name = f"{laid.task.compiled.name}-{scenario.replace(' ', '_')}-{guard}"
                key = _key(laid, scenario, guard, setting)
                known = (read_json(folder / extent.file).get("deployments") or {}).get(name) or {}
                if known.get("key") == key:
                    yield Deployed(name, known, kept=True)
                    continue
                begun(name)
                found = {"key": key, "scenario": scenario, **_deployed(laid, guard, setting, starts)}
                _keep(folder / extent.file, name, found)
                yield Deployed(name, found, kept=False)


def guard_of(name: str) -> tuple[Mode, Asked]:
    """The guard of a name such as `full`, `full+0.2` or `full+auto`, and what it asks.

    Raises UsageError (U101) where there is none.
    """
    mode, _, margin = name.partition("+")
    for known in GUARDS:
        if mode == known:
            return known, parse_margins([margin] if margin else [])
    near = closest(name, USUAL)
    help_ = (f"did you mean `{near}`?",) if near else (", ".join(USUAL),)
    raise UsageError(Diagnostic("U101", f"there is no guard `{name}`", help=help_))


@dataclass(slots=True)
class _Starts:
    """Which starts can be saved: searched for once, scenarios and guards begin alike."""

    x0: list[Tensor] = field(default_factory=list)
    found: list[Tensor] = field(default_factory=list)

    def savable(self, task: Task, x0: Tensor) -> Tensor:
        """Where a search finds a safe plan, (rows,)."""
        for known, found in zip(self.x0, self.found, strict=True):
            if known.shape == x0.shape and bool((known == x0).all()):
                return found
        self.x0.append(x0)
        self.found.append(savable(task, x0))
        return self.found[-1]


def _deployed(run: Run, name: str, setting: Setting, starts: _Starts) -> dict[str, Any]:
    """Drive, and measure what was driven."""
    recorder, begin = Recorder(setting.agents), perf_counter()
    mode, asked = guard_of(name)
    margin = asked.of(run.task, run.policy, mode, setting.replan)
    guard = Guard(run.task, run.policy, mode, limits=Limits(seconds=setting.limit, margin=margin))
    drive(guard, world_type(run.task.system.decl), setting, recorder)
    recording = recorder.recording()
    assert recording is not None
    seconds = perf_counter() - begin
    known = starts.savable(run.task, torch.from_numpy(recording.states[:, 0]))
    feasible = feasible_states(run.task, recording, setting.ceiling)
    metrics = measure(recording, judge_executed(run.task, recording, savable=known.numpy()), feasible)
    return {
        "spec": run.task.compiled.name,
        "run": run.dir.name,
        "policy": policy_of(run.dir),
        "guard": name,
        **({"margin": dict(margin)} if margin else {}),
        "seeds": list(setting.seeds),
        **{"agents": setting.agents, "steps": setting.steps, "replan": setting.replan},
        "time_limit": setting.limit if mode == "full" else None,
        "metrics": {name: _plain(metrics[name]) for name in SHOWN if name in metrics},
        "progress": {name: _plain(metrics[name]) for name in recording.progress[0] if name in metrics},
        "acted": 1.0 - decided(recording)["policy"],
        "seconds": seconds,
        **{"date": now(), "versions": versions(), "git": git_state(), "hardware": hardware()},
    }


def policy_of(folder: RunDir) -> dict[str, Any]:
    """How the policy of a run was trained, and how much of the held-out starts it solves."""
    record = folder.record()
    result = record.get("result") or {}
    return {
        "method": (record.get("engine") or {}).get("method"),
        "seed": record.get("seed"),
        **{name: result.get(name) for name in ("accuracy", "seconds")},
    }


def _plain(found: Interval) -> dict[str, Any]:
    return {"mean": found.mean, "low": found.low, "high": found.high, "values": list(found.values)}


def _key(run: Run, scenario: str, guard: str, setting: Setting) -> str:
    """All that a deployment depends on, in a few digits."""
    folder, world = run.dir.path, run.task.system.decl.test.world
    texts = [(folder / name).read_text(encoding="utf-8") for name in (SPEC, SYSTEM, "ckpt/last.json")]
    texts += [world.path.read_text(encoding="utf-8")] if world is not None else []
    mode, asked_for = guard_of(guard)
    limit = setting.limit if mode == "full" else None
    asked = [
        scenario,
        guard,
        *map(str, (setting.seeds, setting.agents, setting.steps, setting.replan, limit)),
    ]
    asked += [str(setting.ceiling)] if setting.ceiling else []
    asked += [str(each) for each in (asked_for.share, _errors_of(run)) if each is not None]
    return sha256("\0".join([*texts, *asked]))[:16]


def _errors_of(run: Run) -> ErrorsDecl | None:
    """What the scenario of a run has wrong with actuators, numbers and sensors; None for nothing."""
    scenario = run.task.system.decl.scenario
    return scenario.errors if scenario is not None and scenario.errors != ErrorsDecl() else None


def _keep(path: Path, name: str, found: Mapping[str, Any]) -> None:
    """Enter a deployment into a file."""
    kept = read_json(path).get("deployments") or {}
    kept[name] = dict(found)
    lines = ",\n".join(f"{dumps(key)}: {dumps(value)}" for key, value in kept.items())  # one a line
    write_atomic(path, f'{{"format": {dumps(FORMAT)}, "deployments": {{\n{lines}\n}}}}\n')


def kept_in(folder: Path, file: str = FILE) -> list[dict[str, Any]]:
    """All deployments that a file of a folder holds."""
    return list((read_json(folder / file).get("deployments") or {}).values())


# ----------------------------------------------------------------------- the table


@dataclass(frozen=True, slots=True)
class Row:
    """A policy under a scenario, by guard.

    Attributes:
        spec: name of the specification.
        scenario: name.
        size: seeds, agents and steps.
        guards: guard -> its document.
    """

    spec: str
    scenario: str
    size: tuple[int, int, int]
    guards: Mapping[str, Mapping[str, Any]]

    def metric(self, guard: str, name: str) -> Mapping[str, Any] | None:
        """Mean and interval of a metric under a guard; None where that was not driven, or is of nothing."""
        found: Mapping[str, Any] | None = (self.guards.get(guard) or {}).get("metrics", {}).get(name)
        return found


def disturbed_rows(documents: Iterable[Mapping[str, Any]]) -> list[Row]:
    """The table: specifications in the paper's order, then others; scenarios in that of `SCENARIOS`."""
    groups: dict[tuple[str, str, tuple[int, int, int]], dict[str, Mapping[str, Any]]] = {}
    for each in documents:
        size = (len(each["seeds"]), int(each["agents"]), int(each["steps"]))
        groups.setdefault((each["spec"], each["scenario"], size), {})[each["guard"]] = each
    return sorted((Row(*key, guards) for key, guards in groups.items()), key=_place)


def _place(row: Row) -> tuple[int, str, int, str, tuple[int, int, int]]:
    spec = BENCHMARKS.index(row.spec) if row.spec in BENCHMARKS else len(BENCHMARKS)
    scenario = SCENARIOS.index(row.scenario) if row.scenario in SCENARIOS else len(SCENARIOS)
    return spec, row.spec, scenario, row.scenario, row.size
