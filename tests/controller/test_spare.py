"""Safety requirements with something to spare: robustness is less by that much, and guards keep away."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from stlc.compile.ir.nodes import Const, Predicate, Signal
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, simulate
from stlc.controller.guard.candidates import Limits
from stlc.controller.guard.guard import Guard
from stlc.controller.guard.margins import tightened, with_margins
from stlc.controller.guard.safe_prefix import prefix_robustness, robustness_until
from stlc.controller.policies.policy import BestOfKPolicy, PlanNetwork, Policy
from stlc.controller.problem.task import Task
from stlc.controller.world import world_type
from stlc.dynamics.load import parse_system
from stlc.dynamics.scenario import under
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

SYSTEM = """\
stlc: 1
name: cart
time: {dt: 0.5 s, horizon: 6 steps}
state: {p: {unit: m, range: [-4, 4]}, w: {unit: m/s, range: [-2, 2]}}
control: {u: {unit: m/s^2, range: [-2, 2]}}
flow: {p: w, w: u}
init: {mixture: [{draw: {p: 0, w: "uniform(0, 0.2)"}}]}
backup: {bins: 5, T0: [1, 2], batch: 256}
test: {steps: 24, agents: 8, replan: 4}
"""
SPEC = """\
signal p, w
@safety
require clear: always[0, T] p <= 2
require quick: eventually[0, T] w >= 0.1
"""


def task_of(scenario: str = "") -> Task:
    decl = parse_system(Source("cart.yaml", SYSTEM), Path("cart.yaml"))
    return Task.of(Spec.parse(Source("a.stl", SPEC)), System(under(decl, scenario) if scenario else decl))  # type: ignore[arg-type]


class Onward(Policy):
    """Speeds up for half of the plan, and brakes for the other half."""

    def candidates(self, x0: Tensor) -> Tensor:
        plan = torch.full((len(x0), 1, self.task.horizon, 1), 0.4, dtype=x0.dtype)
        plan[:, :, self.task.horizon // 2 :] = -0.4
        return plan


def driven(mode: str, margin: float, scenario: str = "") -> DeploymentRecording:
    task = task_of(scenario)
    guard = Guard(task, Onward(task), mode, limits=Limits(margin={"clear": margin}, seconds=None))
    recorder = Recorder(8)
    simulate(guard, world_type(task.system.decl), Setting((0,), 8, 24, 4), recorder)
    found = recorder.recording()
    assert found is not None
    return found


def test_robustness_is_less_by_the_margin(car_task: Task) -> None:
    x0 = car_task.sample(300, seed=0, dtype=torch.float64)
    low, high = car_task.system.control_low.double(), car_task.system.control_high.double()
    generator = torch.Generator().manual_seed(1)
    u = low + (high - low) * torch.rand((300, car_task.horizon, 1), generator=generator, dtype=torch.float64)
    margin = {rule.name: 0.25 / (1 + at) for at, rule in enumerate(car_task.compiled.safety[:-1])}
    strict = with_margins(car_task, margin)
    before, after = car_task.judge(x0, u).requirements, strict.judge(x0, u).requirements
    assert len(margin) >= 2
    for index, rule in enumerate(car_task.rules):
        less = margin.get(rule.name, 0.0)
        torch.testing.assert_close(after[:, index], before[:, index] - less, rtol=0, atol=1e-9)
    assert with_margins(car_task, dict.fromkeys(margin, 0.0)) is with_margins(car_task, {}) is car_task


def test_time_tests_stay_and_negated_predicates_are_tightened_too() -> None:
    guard = Predicate(Signal("t"), guard=True)
    assert tightened(guard, Const(1.0)) is guard
    task = Task.of(Spec.parse(Source("a.stl", SPEC.replace("p <= 2", "not (p > 2)"))), task_of().plain)
    x0 = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    still = torch.zeros((1, 6, 1), dtype=torch.float64)
    assert float(with_margins(task, {"clear": 0.5}).judge(x0, still).requirements[0, 0]) == pytest.approx(0.5)


@pytest.mark.apart
@pytest.mark.parametrize("mode", ["paper", "full"])
def test_a_guard_keeps_away_and_tells_the_plain_verdict(mode: str) -> None:
    task, x = task_of(), torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    policy = Onward(task)
    plain = Guard(task, policy, mode, limits=Limits(seconds=None)).decide(x)
    assert int(plain.source[0]) == 0
    away = Guard(task, policy, mode, limits=Limits(seconds=None, margin={"clear": 0.3})).decide(x)
    assert int(away.source[0]) != 0
    judged = task.judge(x, away.plan)
    assert float(away.rho[0]) == pytest.approx(float(judged.rho[0]))
    assert float(judged.safe[0]) >= 0.3 - 1e-6
    assert float(away.policy_rho[0]) == pytest.approx(float(plain.policy_rho[0]))
    none = Guard(task, policy, "none", limits=Limits(margin={"clear": 0.3})).decide(x)
    assert int(none.source[0]) == 0


def test_a_network_chooses_among_its_plans_by_what_they_spare() -> None:
    task = task_of()
    torch.manual_seed(0)

    class Two(PlanNetwork):
        def __init__(self) -> None:
            torch.nn.Module.__init__(self)
            self.changes = torch.zeros(0, task.horizon, 1)

        def forward(self, x0: Tensor) -> Tensor:
            fast, slow = (torch.full((len(x0), 1, task.horizon, 1), u) for u in (0.15, 0.08))
            return torch.cat((fast, slow), 1).to(x0)

    x = torch.tensor([[1.2, 0.0]], dtype=torch.float64)
    guard = Guard(task, BestOfKPolicy(task, Two()), "paper", limits=Limits(margin={"clear": 0.4}))
    assert guard.strict.judge(x, guard.policy.plan(x)).safe >= 0


def test_a_margin_makes_up_for_a_mistaken_model() -> None:
    """Violation that a guard without a margin lets pass, by actuators that give more than they are told."""
    passed = {margin: driven("paper", margin, "mismatch-80").states[:, :, 0].max() for margin in (0.0, 0.9)}
    assert passed[0.0] > 2.0
    assert passed[0.9] <= 2.0


@pytest.mark.apart
def test_what_nobody_has_planned_is_no_danger() -> None:
    """As the model says, a safe plan stays safe to its end, also where `sweep` looks beyond that."""
    decl = parse_system(Source("cart.yaml", SYSTEM), Path("cart.yaml"))
    spec = "signal p, w\n@safety\nrequire clear: always[0, T] sweep([p, 0]) not in box([2.2, -1], [9, 1])\n"
    task, planned = Task.of(Spec.parse(Source("a.stl", spec)), System(decl)), []  # type: ignore[arg-type]

    class Faster(Onward):
        def candidates(self, x0: Tensor) -> Tensor:
            return torch.full((len(x0), 1, self.task.horizon, 1), 0.4, dtype=x0.dtype)

    guard = Guard(task, Faster(task), "full", limits=Limits(seconds=None))
    recorder = Recorder(8)
    watch = lambda moment: planned.append(moment.planned)  # noqa: E731
    simulate(guard, world_type(decl), Setting((0,), 8, 4, 4), recorder, watch)
    assert planned == [8, 0, 0, 0, 0]
    x = torch.from_numpy(recorder.recording().states[:, 3])  # type: ignore[union-attr]
    rest = recorder.decisions[0].later(3)
    assert guard.endangered(x, rest, 3).any()  # of the sample at the end of the plan


def test_the_full_guard_looks_at_all_that_is_left_of_a_plan() -> None:
    """Plans at once of an agent that the present plan makes unsafe only after the next planning."""
    task = task_of("disturb-50")
    guard, recorder = Guard(task, Onward(task), "full", limits=Limits(seconds=None)), Recorder(8)
    planned: list[int] = []
    simulate(
        guard,
        world_type(task.system.decl),
        Setting((1,), 8, 2, 4),
        recorder,
        lambda moment: planned.append(moment.planned),
    )
    rest = recorder.decisions[0].later(1)
    later, soon = (int(guard.endangered(recorder.states[1], rest, last).sum()) for last in (4, 3))
    assert planned[:2] == [8, later]
    assert later > soon == 0


def test_so_many_steps_count_for_each_agent() -> None:
    task = task_of()
    guard, x = Guard(task, Onward(task), "full"), torch.tensor([[0.0, 0.0], [1.2, 0.3]])
    begun = Guard(task, Onward(task), "none").decide(x.double())
    assert guard.endangered(x, begun, 6).tolist() == [False, True]
    assert guard.endangered(x, begun, torch.tensor([6, 2])).tolist() == [False, False]


def test_who_runs_into_danger_plans_before_the_others() -> None:
    task = task_of()
    guard = Guard(task, Onward(task), "full")
    x = torch.tensor([[0.0, 0.0], [1.6, 0.0]], dtype=torch.float64)
    begun = Guard(task, Onward(task), "none").decide(x)
    assert guard.endangered(x, begun, 4).tolist() == [False, True]
    assert guard.endangered(x, begun, 1).tolist() == [False, False]
    for mode in ("none", "paper"):  # the paper's guard looks at plans when they are made
        assert not Guard(task, Onward(task), mode).endangered(x, begun, 4).any()


def test_robustness_until_a_sample_is_that_of_the_prefix() -> None:
    task = task_of()
    generator = torch.Generator().manual_seed(0)
    x0 = task.sample(50, seed=3, dtype=torch.float64)
    u = 2 * torch.randn((50, task.horizon, 1), generator=generator, dtype=torch.float64)
    columns = task.system.rollout_columns(x0, u)
    formulas = [rule.formula for rule in task.compiled.safety]
    every = prefix_robustness(formulas, columns)
    for last in range(task.horizon + 1):
        torch.testing.assert_close(robustness_until(formulas, columns, last), every[last])


def test_a_margin_may_grow_along_a_plan() -> None:
    task = task_of()
    x0, still = torch.tensor([[1.0, 0.0]], dtype=torch.float64), torch.zeros((1, 6, 1), dtype=torch.float64)
    least = float(task.judge(x0, still).requirements[0, 0])
    grown = with_margins(task, {"clear": 0.6}, {"clear": 12.0})
    assert float(grown.judge(x0, still).requirements[0, 0]) == pytest.approx(least - 0.3)
    assert float(grown.requirement_robustness(task.rollout(x0, still))[0, 0]) == pytest.approx(least - 0.3)
