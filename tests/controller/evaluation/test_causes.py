"""Causes of failed drives, on a point for which each of them is arranged."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import Recorder, simulate
from stlc.controller.evaluation.causes import Lost, losses
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.evaluation.rules import Broken, judge_runs_by_plans
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.controller.world import world_type
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

POINT = """
stlc: 1
name: point
time: {dt: 0.5 s, horizon: 4 steps}
state: {x: {unit: m, range: [-20, 20]}}
control: {u: {unit: m/s, range: [-1, 1]}}
flow: {x: u}
init: {mixture: [{draw: {x: 0}}]}
test: {steps: 14, agents: 2, events: [{name: blow, every: 3 s, set: {x: "x - 9 m"}}]}
"""


class Still(Policy):
    """Stays where it is."""

    def candidates(self, x0: Tensor) -> Tensor:
        return torch.zeros(len(x0), 1, self.task.horizon, 1, dtype=x0.dtype)


def driven(folder: Path, rules: str, calm: str):  # type: ignore[no-untyped-def]
    path = folder / "point.yaml"
    path.write_text(POINT if calm == "blown" else POINT.replace(POINT[POINT.index(", events") : -2], ""))
    system = System.load(path)
    task = Task.of(Spec.parse(Source("s.stl", f"state signal x [m]\n{rules}")), system)
    recorder = Recorder(2, pictured=False)
    guard = Guard(task, Still(task), "none")
    simulate(guard, world_type(system.decl), Setting((0,), 2, 14), recorder)
    recording = recorder.recording()
    assert recording is not None
    runs = judge_runs_by_plans(judge_executed(task, recording), task.system.dt)
    return task, recording, runs


@pytest.mark.apart
@pytest.mark.parametrize(
    ("rules", "calm", "cause", "time"),
    [
        ("require there: eventually@[0 s, 6 s] x > 4 m", "calm", "later", 6.0),
        ("require there: eventually@[0 s, 2 s] x > 1 m", "calm", "missed", 2.0),
        ("require there: eventually@[0 s, 2 s] x > 3 m", "calm", "start", 2.0),
        ("require there: eventually@[0 s, 2 s] x > 2.02 m", "calm", "near", 2.0),
        ("require there: always[0, T] x > -3 m", "blown", "told", 3.0),
        ("@safety\nrequire there: always[0, T] x > -3 m", "blown", "told", 3.0),
    ],
)
def test_the_cause_and_the_time_of_a_failure(
    tmp_path: Path, rules: str, calm: str, cause: str, time: float
) -> None:
    task, recording, runs = driven(tmp_path, rules, calm)
    assert [each.rules for each in runs.broken] == [{"there": time}] * 2
    found = losses(task, recording, runs.broken, runs.safety)
    assert [found[row].why for row in (0, 1)] == [cause, cause]


def test_rules_that_ask_for_more_than_the_plans_are_the_cause(tmp_path: Path) -> None:
    task, recording, runs = driven(tmp_path, "require here: always[0, T] x < 3 m", "calm")
    assert runs.broken == ()
    assert losses(task, recording, [Broken(1, {"more": 2.0})], ()) == {1: Lost("rules", 2.0)}


def test_a_search_that_is_ended_too_early_names_no_cause(tmp_path: Path) -> None:
    task, recording, runs = driven(tmp_path, "require there: eventually@[0 s, 2 s] x > 1 m", "calm")
    assert losses(task, recording, runs.broken, (), lambda: True) == {}
