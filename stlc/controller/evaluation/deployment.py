"""Deployment over several seeds: trajectories, metrics, decisions and decision latency."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, Watch, simulate
from stlc.controller.evaluation.executed import Executed, judge_executed
from stlc.controller.evaluation.metrics import measure
from stlc.controller.evaluation.rules import Rules, RunVerdicts, judge_runs, judge_runs_by_plans
from stlc.controller.evaluation.stats import MeanInterval
from stlc.controller.guard.candidates import SOURCES
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.controller.search.feasibility import solvable
from stlc.controller.search.planner_policy import PlannerPolicy, SearchUse
from stlc.controller.world import world_type
from stlc.jsontext import Num

LATENCY_SAMPLES = 200
LATENCY_SECONDS = 5.0
"""Seconds after which latency is estimated from the samples taken so far."""


@dataclass(frozen=True, slots=True)
class DecisionLatency:
    """Seconds that the guard takes to decide for one agent: median and 99 % quantile over visited states."""

    median: Num
    p99: Num
    samples: int


@dataclass(frozen=True, slots=True)
class Unsafe:
    """Agent with an unsafe trajectory.

    Attributes:
        seed: index of its seed among the seeds of the deployment.
        agent: index of the agent in its seed.
        viable: whether a safe plan from the agent's initial state is known.
    """

    seed: int
    agent: int
    viable: bool


@dataclass(frozen=True, slots=True)
class Deployment:
    """Results of one guard over all seeds.

    Attributes:
        guard: name of the guard, one of `stlc.registry.GUARDS`.
        recording: trajectories and decisions.
        metrics: name -> mean over seeds with its confidence interval; see `metrics.METRICS`. Further entries:
            `holds.NAME`, the share of start instants at which requirement NAME holds, and the world's
            progress.
        decisions: source of the followed plan -> share of the decisions; "backup" counts all plans of the
            backup policy, "backup T0=1" those with a prefix of 1 action.
        latency: time of one decision.
        unsafe: the agents with an unsafe trajectory.
        runs: verdicts on the closed-loop runs.
        search: use of the budget by the searches of a policy that plans; None for any other policy.
    """

    guard: str
    recording: DeploymentRecording
    metrics: Mapping[str, MeanInterval]
    decisions: Mapping[str, float]
    latency: DecisionLatency
    unsafe: tuple[Unsafe, ...]
    runs: RunVerdicts
    search: SearchUse | None = None


class InterruptedDeploymentError(Exception):
    """Error that ends a deployment early.

    Its attribute `recording` holds the steps before the error; None if there are none.
    """

    def __init__(self, recording: DeploymentRecording | None) -> None:
        super().__init__("the deployment ended early")
        self.recording = recording


def deploy(
    task: Task,
    policy: Policy,
    setting: Setting,
    guard: str,
    *,
    watch: Watch | None = None,
    rules: Rules | None = None,
) -> Deployment:
    """Simulate a policy in the world of its system under a guard; `watch` is called at every step.

    `rules`: specification that judges the closed-loop runs; if None, the specification of the plans judges
    them.

    Raises:
        InterruptedDeploymentError: the deployment ended early. Its `__cause__` tells why: a SystemFileError
            or RunError that `simulate` raised, or an interruption by the user.
        SystemFileError: S206, the world cannot be loaded.
    """
    make = world_type(task.system.decl)
    guarded = Guard(task, policy, guard, limits=setting.limits)
    recorder = Recorder(setting.agents)
    try:
        simulate(guarded, make, setting, recorder, watch)
        recording = recorder.recording()
        assert recording is not None
        search = policy.take_use() if isinstance(policy, PlannerPolicy) else None
        found = replace(judged(guarded, recording, setting.known_feasible, rules), search=search)
        if isinstance(policy, PlannerPolicy):
            policy.take_use()  # searches of the measured latency are none of the simulation
        return found
    except BaseException as error:
        raise InterruptedDeploymentError(recorder.recording()) from error


def judged(
    guard: Guard, recording: DeploymentRecording, known_feasible: int = 0, rules: Rules | None = None
) -> Deployment:
    """Compute the metrics, verdicts and decision latency of a deployment that was recorded under a guard.

    Args:
        guard: the guard under which the deployment was recorded. It makes some decisions anew, so that their
            latency can be measured.
        recording: the recorded deployment.
        known_feasible: number of visited states whose feasibility is determined; see `feasible_states`.
        rules: specification that judges the closed-loop runs. If None, the specification of the plans judges
            them: a run must satisfy it from every sample from which a whole planning window is recorded (see
            `Executed`).
    """
    executed = judge_executed(guard.task, recording)
    runs = (
        judge_runs_by_plans(executed, guard.task.system.dt)
        if rules is None
        else judge_runs(rules, guard.task, recording, executed.viable)
    )
    return Deployment(
        guard.kind.name,
        recording,
        measure(recording, executed, feasible_states(guard.task, recording, known_feasible)),
        decided(recording),
        latency(guard, recording),
        unsafe_agents(executed, recording.agents),
        runs,
    )


def unsafe_agents(executed: Executed, agents: int) -> tuple[Unsafe, ...]:
    """Agents whose trajectory violates a requirement tagged `@safety`.

    `agents`: number of agents per seed.
    """
    rows = np.flatnonzero(executed.failing(executed.safety)).tolist()
    return tuple(Unsafe(*divmod(row, agents), bool(executed.viable[row])) for row in rows)


def feasible_states(task: Task, recording: DeploymentRecording, count: int) -> NDArray[np.float64]:
    """Determine the feasibility of `count` visited states, evenly spread over the recording.

    A state is feasible if the followed plan satisfies the specification, or if a search finds a plan that
    does.

    Returns:
        (rows, steps): 1 for a feasible state, 0 for a state without a known plan, and NaN for a state that
        was not among the `count` chosen ones.
    """
    known = np.full(recording.rho.shape, math.nan)
    if count:
        known.ravel()[np.linspace(0, known.size - 1, min(count, known.size)).astype(int)] = 1.0
    open_ = np.isfinite(known) & ~TOLERANCE.satisfied(recording.rho)
    known[open_] = solvable(task, torch.from_numpy(recording.states[:, :-1][open_])).numpy()
    return known


def decided(recording: DeploymentRecording) -> dict[str, float]:
    """Method that made the followed plan, such as "policy" -> share of the decisions.

    "backup" counts all plans of the backup policy, "backup T0=1" those with a prefix of 1 action.
    """
    found = {name: float((recording.source == index).mean()) for index, name in enumerate(SOURCES)}
    backup = recording.source == SOURCES.index("backup")
    for length in np.unique(recording.t0[backup]).tolist():
        found[f"backup T0={length}"] = float((backup & (recording.t0 == length)).mean())
    return found


def latency(guard: Guard, recording: DeploymentRecording) -> DecisionLatency:
    """Measure the time of single-agent decisions in random visited states, for a few seconds at most.

    As in a deployment, the guard gets the remainder of a previous plan together with each state. The previous
    plan is made in the preceding state, before the time is measured.
    """
    rows, steps = recording.actions.shape[:2]
    picked = np.linspace(0, rows * steps - 1, min(LATENCY_SAMPLES, rows * steps)).astype(int)
    picked, seconds, stop = np.random.default_rng(0).permutation(picked), [], perf_counter() + LATENCY_SECONDS
    for row, step in zip(picked // steps, picked % steps, strict=True):
        before, now = torch.from_numpy(recording.states[row, [max(step - 1, 0), step]])[:, None]
        previous = guard.decide(before).later()
        begin = perf_counter()
        if recording.options is not None:
            guard.prefer(torch.from_numpy(recording.options[row, step])[None], previous)
        guard.decide(now, previous)
        seconds.append(perf_counter() - begin)
        if perf_counter() > stop:
            break
    return DecisionLatency(float(np.median(seconds)), float(np.quantile(seconds, 0.99)), len(seconds))
