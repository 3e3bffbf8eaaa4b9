"""Plans reach to the end of a mission and end there; one that satisfies the specification is never lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, simulate
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.evaluation.rules import judge_runs_by_plans
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import PlanNetwork
from stlc.controller.problem.task import LONGEST, Task
from stlc.controller.search.local_search import SearchResult, remainders
from stlc.controller.search.planner import PlanBudget, plan, planner_named
from stlc.controller.search.planner_policy import FIRST, PlannerPolicy
from stlc.controller.world import ModelWorld
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

CART = """
stlc: 1
name: cart
time: {dt: 0.2 s, horizon: 2 s%s}
state:
  x: {unit: m, range: [-10, 10]}
  v: {unit: m/s, range: [-2, 2], clamp: true}
  charge: {range: [0, 100]}
control: {a: {unit: m/s^2, range: [-1, 1]}}
flow: {x: v, v: a, charge: "-1 s^-1 - 2 s^-1 * abs(v) / (1 m/s)"}
init: {mixture: [{draw: {x: "uniform(-1, 1)", v: 0, charge: "uniform(40, 44)"}}]}
test: {steps: 12 s, agents: 4}
"""
ERRAND = """
spec errand
state signal x [m]
state signal v [m/s]
state signal charge
@safety
require charged: always[0, T] charge >= 2
@safety
require inside: always[0, T] (x > -3 m and x < 7 m)
require there: eventually@[0 s, 7 s] always[0, 1 s] x > 5 m
require back: always@[11 s, 12 s] (x > -1 m and x < 1 m)
"""


def task_of(folder: Path, time: str = "", text: str = ERRAND) -> Task:
    path = folder / "cart.yaml"
    path.write_text(CART % time)
    return Task.of(Spec.parse(Source("errand.stl", text)), System.load(path), whole=True)


@pytest.fixture
def task(tmp_path: Path) -> Task:
    return task_of(tmp_path)


def driven(task: Task, seeds: int, evaluations: int, guard: str = "none") -> DeploymentRecording:
    budget = PlanBudget(torch.inf, evaluations)
    policy = PlannerPolicy(task, planner_named("search"), budget)
    recorder = Recorder(4, pictured=False)
    setting = Setting(tuple(range(seeds)), 4, 60)
    simulate(Guard(task, policy, guard), ModelWorld, setting, recorder)
    recording = recorder.recording()
    assert recording is not None
    return recording


def test_plans_reach_to_the_end_of_the_mission(task: Task, tmp_path: Path) -> None:
    assert (task.horizon, task.window) == (60, 10)
    assert task.plain.horizon == task.system.horizon == 60
    shorter = task_of(tmp_path, ", mission: 8 s")
    assert (shorter.horizon, shorter.window, shorter.compiled.grid.end) == (40, 10, 40)
    windows = task_of(tmp_path, ", mission: 0")
    assert (windows.horizon, windows.compiled.grid.end) == (10, None)
    far = ERRAND.replace("[11 s, 12 s]", "[990 s, 991 s]")
    assert task_of(tmp_path, ", mission: 1000 s", far).horizon == LONGEST


def test_tasks_without_deadlines_and_those_without_end_keep_their_windows(tmp_path: Path) -> None:
    plain = "spec s\nstate signal x [m]\nrequire a: always[0, T] x < 7 m\n"
    assert task_of(tmp_path, text=plain).compiled.grid.end is None
    recurs = plain + "require b: always@[4 s, end] once[0, 4 s] x > 1 m\n"
    assert task_of(tmp_path, text=recurs).horizon == 10


def test_a_plan_is_asked_for_nothing_after_the_end(task: Task) -> None:
    """The battery lasts for the mission, and not for one plan more."""
    found = plan(task, task.sample(2, seed=1), budget=PlanBudget(torch.inf, 40_000))
    assert bool(found.satisfied.all())
    states = task.rollout(found.states, found.plans)
    late = states[:, 30]
    rest = torch.cat((found.plans[:, 30:], found.plans[:, -1:].expand(-1, 30, -1)), 1)
    judged = task.judge(late, rest)
    assert bool((judged.rho >= -1e-6).all())
    assert float(judged.columns["charge"][-1].min()) < 2.0


def test_a_mission_no_longer_than_a_plan_needs_no_deadline_to_end(tmp_path: Path) -> None:
    text = "state signal x\nrequire a: eventually[0, 1 s] x > 0.5 m\nrequire b: eventually[0, T] x < -0.5 m\n"
    spec, path = Spec.parse(Source("short.stl", text)), tmp_path / "cart.yaml"
    for steps, end in (("2 s", 10), ("12 s", None)):
        path.write_text((CART % "").replace("steps: 12 s", f"steps: {steps}"))
        task = Task.of(spec, System.load(path), whole=True)
        assert (task.horizon, task.compiled.grid.end) == (10, end)


def test_a_satisfying_plan_is_never_lost(task: Task) -> None:
    recording = driven(task, 3, 40_000)
    known = recording.rho >= -1e-6
    assert known[:, 0].sum() >= 10
    assert known[known[:, 0]].all()
    executed = judge_executed(task, recording, viable=np.ones(12, dtype=bool))
    assert executed.agents([rule.name for rule in task.rules])[known[:, 0]].all()


@pytest.mark.slow
def test_a_thousand_drives_keep_their_plans(task: Task) -> None:
    for guard in ("none", "full"):
        recording = driven(task, 125, 40_000, guard)
        known = recording.rho >= -1e-6
        assert known[known[:, 0]].all()
        assert known[:, 0].mean() > 0.9


@pytest.mark.apart
@pytest.mark.parametrize("seeds", [1, pytest.param(50, marks=pytest.mark.slow)])
def test_drives_that_lose_a_requirement_keep_the_others(tmp_path: Path, seeds: int) -> None:
    held = {}
    hopeless = "require soon: eventually@[0 s, 1 s] x > 5 m\n"
    for name, text in (("with", ERRAND), ("without", ERRAND + hopeless)):
        task = task_of(tmp_path, text=text)
        runs = judge_runs_by_plans(judge_executed(task, driven(task, seeds, 6_000)), task.system.dt)
        held[name] = {rule: int((each == "satisfied").sum()) for rule, each in runs.rules.items()}
    assert held["without"].pop("soon") == 0
    assert held["without"] == held["with"] == dict.fromkeys(held["with"], 4 * seeds)


def test_safety_goes_on_where_another_requirement_is_lost(task: Task) -> None:
    x = task.sample(6, seed=2, dtype=torch.float64)
    x[:, task.system.names.index("there")] = -1.0
    x[:, task.system.names.index("clock")] = 41.0
    found = plan(task, x, budget=PlanBudget(torch.inf, 20_000))
    assert bool(found.satisfied.all()), "the others can still be satisfied"
    judged = task.judge(x, found.plans)
    assert bool(torch.isinf(judged.requirements[:, 2]).all())
    assert bool((judged.safe >= 0).all())
    assert not bool(task.alive(x).any()), "and the mission counts as violated"


# --------------------------------------------------------------------------- policies


def test_a_network_proposes_what_is_left_of_a_plan_for_the_mission(task: Task) -> None:
    network = PlanNetwork(task, hidden=[8], plans=2)
    network.normalise(task.sample(64, seed=1))
    wanted = torch.linspace(-0.9, 0.9, 120).view(2, 60, 1)
    network.begin_at(wanted)
    x = task.sample(3, seed=0)
    x[1:, task.system.names.index("clock")] = torch.tensor([20.0, 90.0])
    plans = network(x)
    assert plans.shape == (3, 2, 60, 1)
    assert torch.allclose(plans[0], wanted, atol=0.1), "nearly the given plans, from any state"
    raw = network.body((task.system.observe(x) - network.centre) / network.spread).view(3, 2, 60, 1)
    assert torch.equal(torch.sign(plans[1, :, :40]), torch.sign(raw[1, :, 20:]))
    assert bool((plans[1, :, 40:] == plans[1, :, 39:40]).all())
    assert bool((plans[2] == plans[2, :, :1]).all()), "the last control, after the end"


def test_remainders_of_a_plan_satisfy_from_the_states_on_its_way(task: Task) -> None:
    found = plan(task, task.sample(2, seed=1), budget=PlanBudget(torch.inf, 40_000))
    rest = remainders(task, SearchResult(found.states, found.plans, found.rho), 6)
    assert len(rest.rho) == 12
    assert bool(rest.solved.all())
    assert torch.equal(rest.states[0], found.states[0])
    clock = rest.states[:, task.system.names.index("clock")]
    assert clock[:6].tolist() == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]


@pytest.mark.apart
def test_the_first_plan_of_a_mission_may_take_longer(task: Task) -> None:
    hard = task_of(Path(task.system.decl.path).parent, text=ERRAND.replace("x > 5 m", "x > 6.9 m"))
    policy = PlannerPolicy(hard, planner_named("search"), PlanBudget(0.001, target=torch.inf))
    x = hard.sample(1, seed=1, dtype=torch.float64)
    policy.plan_judged(x)
    first = policy.take_use()
    x[:, hard.system.names.index("clock")] = 1.0
    policy.plan_judged(x)
    later = policy.take_use()
    assert first is not None
    assert later is not None
    assert first.median >= FIRST * 0.001 > later.median
