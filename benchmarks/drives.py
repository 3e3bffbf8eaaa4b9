"""Closed-loop measurements for the paper's comparison: a policy or planner in the world of a benchmark.

The world is the simulated environment of a benchmark. As in the paper, each method is measured without a
guard and with the paper's backup policy. The number of agents, of steps, and of steps between two plans are
those in the section `test` of the system file. Each result is stored as soon as it is measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from time import process_time
from typing import Any

import numpy as np
import torch

from benchmarks.deployments import recorded
from benchmarks.measured import Measured, has_changed, measured, reason
from benchmarks.plannings import PlanCell, time_text
from benchmarks.store import Key, Result, ResultStore, load
from benchmarks.timing import Times, one_thread
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording
from stlc.controller.evaluation.deployment import decided
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.evaluation.metrics import METRICS, measure
from stlc.controller.guard.candidates import Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.search.planner import PlanBudget, planner_named, planning_version
from stlc.controller.search.planner_policy import PlannerPolicy
from stlc.diagnostics import UsageError
from stlc.jsontext import plain
from stlc.provenance import sha256
from stlc.registry import GUARDS

WITH_BACKUP = (GUARDS.default, PAPER.name)
"""Guards of the paper: none, and the backup policy."""
DECISIONS, LEAST_DECISIONS, TIMING = 60, 5, 60.0
"""Number of decisions that are timed, each for one agent; fewer, if they take longer than so many seconds."""


@dataclass(frozen=True, slots=True)
class Drive:
    """Description of one closed-loop measurement.

    Attributes:
        plan: planner with its time budget, or the run of a trained policy.
        guard: name of the guard.
        seeds: seeds of the simulations.
        agents: greatest number of agents in a simulation; None for the number in the system file.
        steps: greatest number of steps of a simulation; None for the number in the system file.
    """

    plan: PlanCell
    guard: str
    seeds: tuple[int, ...]
    agents: int | None = None
    steps: int | None = None

    @property
    def name(self) -> str:
        """Name under which the result is stored, such as `traffic-plan-search-10ms-paper`."""
        return f"{self.plan.name}-{self.guard}"

    def setting(self, task: Task) -> Setting:
        """Return the settings of the simulation: seeds, agents, steps, and steps between two plans."""
        test = task.system.decl.test
        agents, steps = (
            min(self.agents or test.agents, test.agents),
            min(self.steps or test.steps, test.steps),
        )
        return Setting(self.seeds, agents, steps, test.replan)

    @property
    def key(self) -> Key:
        """Key under which the result is stored: its name and all its inputs."""
        task = load(self.plan.benchmark)
        setting = self.setting(task)
        planned = {
            name: value for name, value in self.plan.key.values.items() if not name.startswith("starts")
        }
        return Key(
            self.name,
            {
                **planned,
                **{"guard": self.guard, "guard_version": GUARDS.get(self.guard).version},
                **{"seeds": list(setting.seeds), "agents": setting.agents, "steps": setting.steps},
                **_deployed(task),
            },
        )

    def policy(self, task: Task) -> Policy:
        """Return the trained policy, or else the planner wrapped as a policy.

        Raises:
            UsageError: the planner cannot solve this task.
        """
        cell = self.plan
        if cell.run is not None:
            return Run.open(cell.run.path).policy.for_task(task)
        planner = planner_named(cell.contender.method, **cell.contender.options_on(cell.benchmark))
        return PlannerPolicy(task, planner, PlanBudget(cell.seconds, cell.evaluations))


def _deployed(task: Task) -> dict[str, str | None]:
    """Hashes of the world, and of what a system file says about the backup policy and a deployment."""
    backup, test = task.system.decl.backup, task.system.decl.test
    text = repr((backup, test.replan, test.events, test.starts))
    world = None if test.world is None else sha256(test.world.path.read_text(encoding="utf-8"))
    return {"world_sha256": world, "deployed_sha256": sha256(text)}


def drive(cell: Drive) -> Result:
    """Carry out a closed-loop measurement: simulate, judge the closed-loop runs, and time decisions.

    If the planner cannot solve the task, the result contains only the reason, under the key `refused`.

    Raises:
        MissingError: R301, a package is missing.
        RunError, SystemFileError: the run is damaged, or the world (simulated environment) fails.
    """
    task = load(cell.plan.benchmark)
    began = process_time()
    with one_thread():
        try:
            policy = cell.policy(task)
        except UsageError as error:
            return {"refused": reason(error)}
        guard = Guard(task, policy, cell.guard, limits=Limits())
        recording = recorded(guard, cell.setting(task))
        times = _timed(guard, recording)
    metrics = measure(recording, judge_executed(task, recording))
    return {
        "metrics": {name: plain(metrics[name]) for name in METRICS if name in metrics},
        "acted": 1.0 - decided(recording)["policy"],
        "decision": {"median": times.median, "p99": times.p99, "samples": times.samples},
        "seconds": process_time() - began,
    }


def _timed(guard: Guard, recording: DeploymentRecording) -> Times:
    """Measure the processor time of single decisions, in states that are evenly chosen from the recording."""
    rows, steps = recording.actions.shape[:2]
    picked = np.random.default_rng(0).permutation(
        np.unique(np.linspace(0, rows * steps - 1, DECISIONS).astype(int))
    )
    seconds: list[float] = []
    for row, step in zip(picked // steps, picked % steps, strict=True):
        if sum(seconds) > TIMING and len(seconds) >= LEAST_DECISIONS:
            break
        before, now = torch.from_numpy(recording.states[row, [max(step - 1, 0), step]])[:, None]
        previous = guard.decide(before).later()
        begin = process_time()
        guard.decide(now, previous)
        seconds.append(process_time() - begin)
    times = Times.of(seconds)
    assert times is not None
    return times


@dataclass(frozen=True, slots=True)
class DriveRow:
    """Results of a policy or planner in closed loop with one guard.

    Attributes:
        benchmark: name of the specification.
        method: name of the method.
        label: label of a trained policy, such as `guided-60s-seed0`; "" for a planner.
        seconds: processor time per plan; None if the planner's own settings end its search.
        guard: name of the guard.
        size: seeds x agents x steps, as text.
        accuracy: share of the followed plans that satisfy the specification, mean over seeds.
        accuracy_half: half-width of the 95 % interval of `accuracy` (Student's t); None with one seed.
        safety: share of agents that were safe at all instants; None if no requirement is tagged `@safety`.
        safety_half: half-width of the 95 % interval of `safety`; None with one seed.
        median_ms: median processor time of a decision for one agent.
        p99_ms: 99th percentile of the processor time of a decision.
        refused: reason why the planner cannot solve the task; "" if it can.
        fewer: worlds, agents and steps if they are fewer than in the system file, else "".
        outdated: whether the specification, the system or a version has changed since the measurement.
    """

    benchmark: str
    method: str
    label: str
    seconds: float | None
    guard: str
    size: str
    accuracy: float | None
    accuracy_half: float | None
    safety: float | None
    safety_half: float | None
    median_ms: float | None
    p99_ms: float | None
    refused: str = ""
    fewer: str = ""
    outdated: bool = False

    @classmethod
    def of(cls, result: Result) -> DriveRow:
        """Return the row of the table that shows a stored result."""
        key, metrics, decision = result["key"], result.get("metrics", {}), result.get("decision", {})
        accuracy, safety = metrics.get("plan_accuracy", {}), metrics.get("executed_safe", {})
        return cls(
            *(key["benchmark"], key["contender"], key["label"], key["seconds"], key["guard"]),
            f"{len(key['seeds'])} x {key['agents']} x {key['steps']}",
            *(accuracy.get("mean"), _half(accuracy), safety.get("mean"), _half(safety)),
            *(decision.get("median"), decision.get("p99"), result.get("refused", "")),
            *(_fewer(key), is_outdated(result)),
        )


def _fewer(key: Mapping[str, Any]) -> str:
    """Size of a measurement as text, such as `3 worlds of 5 agents`; "" if it is the system file's."""
    test, agents, steps = load(key["benchmark"]).system.decl.test, key["agents"], key["steps"]
    worlds = len(key["seeds"])
    of_agents = f"{worlds} world{'s' * (worlds > 1)} of {agents} agent{'s' * (agents > 1)}"
    notes = (of_agents if agents < test.agents else "", f"{steps} steps" if steps < test.steps else "")
    return ", ".join(filter(None, notes))


def _half(metric: Mapping[str, Any]) -> float | None:
    high = metric.get("high")
    return None if high is None else float(high) - float(metric["mean"])


def is_outdated(result: Result) -> bool:
    """True if the specification, the system, the world or a version has changed since a measurement."""
    key = result["key"]
    versions = {"planner_version": planning_version(key["planner"])}
    versions["guard_version"] = GUARDS.get(key["guard"]).version
    return has_changed(result, {**versions, **_deployed(load(key["benchmark"]))})


def driven(
    cells: Iterable[Drive], store: ResultStore, *, driving: Callable[[Drive], Result] = drive
) -> Measured:
    """Return the results of closed-loop measurements; those that are not stored yet are measured now.

    `driving` is the function that carries out a measurement.
    """
    return measured(cells, store, driving, doing="deploying")


def budget_text(seconds: float | None) -> str:
    """Return a time budget per plan as text, such as `10 ms`; None gives `own settings`."""
    return time_text(math.inf if seconds is None else seconds)
