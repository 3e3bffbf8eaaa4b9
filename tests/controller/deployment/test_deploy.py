from __future__ import annotations

import pytest
import torch
from torch import Tensor

from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task

F64 = torch.float64


class Rule(Policy):
    """A policy from a function of the states."""

    def __init__(self, task: Task, action: float) -> None:
        super().__init__(task)
        self.action = action

    def candidates(self, x0: Tensor) -> Tensor:
        return torch.full((len(x0), 1, self.task.horizon, 1), self.action)


def test_without_a_guard_the_policy_acts_whatever_it_plans(car_task: Task) -> None:
    x = car_task.sample(200, seed=1)
    decision = Guard(car_task, Rule(car_task, 10.0), "none").decide(x)
    assert decision.action.dtype == F64
    assert (decision.action == 10.0).all()
    assert (decision.source == 0).all()
    assert torch.equal(decision.rho, decision.policy_rho)
    assert 0.1 < float((decision.rho >= -1e-6).double().mean()) < 0.9


def test_the_guard_only_touches_violated_plans(car_task: Task) -> None:
    x = car_task.sample(300, seed=2)
    free = Guard(car_task, Rule(car_task, 10.0), "none").decide(x)
    guarded = Guard(car_task, Rule(car_task, 10.0), "paper").decide(x)
    good = free.rho >= -1e-6
    assert torch.equal(guarded.plan[good], free.plan[good])
    assert torch.equal(guarded.source > 0, ~good)
    assert torch.equal(guarded.policy_rho, free.policy_rho)
    assert (guarded.t0[~good] > 0).all()
    assert (guarded.rho >= -1e-6).sum() > (free.rho >= -1e-6).sum() + 20
    assert guarded.safe.sum() > free.safe.sum() + 10
    again = car_task.judge(x.double(), guarded.plan)
    assert torch.equal(again.rho, guarded.rho)


def test_decisions_do_not_depend_on_who_else_decides(car_task: Task) -> None:
    x = car_task.sample(60, seed=3)
    guard = Guard(car_task, Rule(car_task, 10.0))
    together = guard.decide(x)
    for i in range(0, 60, 7):
        alone = guard.decide(x[i : i + 1])
        assert torch.equal(alone.plan[0], together.plan[i])
        assert int(alone.source[0]) == int(together.source[i])


def test_a_plan_that_is_no_number_is_never_executed_under_guard(car_task: Task) -> None:
    x = car_task.sample(20, seed=4)
    broken = Rule(car_task, float("nan"))
    guarded = Guard(car_task, broken, "paper").decide(x)
    assert torch.isfinite(guarded.plan).all()
    assert torch.isneginf(guarded.policy_rho).all()
    assert (guarded.source > 0).all()
    assert torch.isneginf(Guard(car_task, broken, "none").decide(x).rho).all()


class Slowing(Policy):
    """A policy that brakes the harder the faster it is."""

    def candidates(self, x0: Tensor) -> Tensor:
        return -x0[:, 1, None, None, None].expand(-1, 1, self.task.horizon, 1)


def test_a_plan_of_which_several_steps_were_taken_is_carried_on_by_the_policy(car_task: Task) -> None:
    """The last action held on may break what the plan promises: then nobody would go on with it."""
    policy, length = Slowing(car_task), car_task.horizon
    guard = Guard(car_task, policy, "none")
    x = car_task.sample(4, seed=6).double()
    begun, taken = guard.decide(x), torch.tensor([0, 3, length - 1, length + 2])
    left = begun.later(taken)
    found = guard.extended(x, left, taken)
    assert torch.equal(found.action, found.plan[:, 0])
    for row, steps in enumerate(taken.tolist()):
        kept = length - steps
        if steps == 0 or kept <= 0:
            assert torch.equal(found.plan[row], left.plan[row])
            continue
        assert torch.equal(found.plan[row, :kept], begun.plan[row, steps:])
        end = car_task.rollout(x[row : row + 1], left.plan[row : row + 1, :kept])[:, -1]
        assert torch.equal(found.plan[row, kept:], policy.plan(end)[0, :steps])


def test_the_rest_of_a_plan_holds_its_last_action(car_task: Task) -> None:
    guard = Guard(car_task, Rule(car_task, 10.0))
    decision = guard.decide(car_task.sample(30, seed=5))
    rest = decision.later(3)
    assert torch.equal(rest.plan[:, :-3], decision.plan[:, 3:])
    assert (rest.plan[:, -3:] == decision.plan[:, -1:]).all()
    assert torch.equal(rest.action, rest.plan[:, 0])


def test_each_agent_may_be_as_far_into_its_plan_as_it_likes(car_task: Task) -> None:
    decision = Guard(car_task, Rule(car_task, 10.0)).decide(car_task.sample(3, seed=5))
    rest = decision.later(torch.tensor([0, 2, 40]))
    assert torch.equal(rest.plan[0], decision.plan[0])
    assert torch.equal(rest.plan[1, :-2], decision.plan[1, 2:])
    assert torch.equal(rest.plan[2], decision.plan[2, -1:].expand_as(rest.plan[2]))


def test_some_agents_decide_anew(car_task: Task) -> None:
    guard, x = Guard(car_task, Rule(car_task, 10.0)), car_task.sample(5, seed=6)
    old, rows = guard.decide(x), torch.tensor([1, 4])
    new = Guard(car_task, Rule(car_task, -10.0), "none").decide(x[rows])
    mixed = old.with_new(rows, new)
    assert torch.equal(mixed.plan[rows], new.plan)
    assert torch.equal(mixed.of(torch.tensor([0, 2, 3])).rho, old.rho[[0, 2, 3]])
    assert torch.equal(mixed.of(rows).policy_rho, new.policy_rho)


def test_the_option_that_can_be_planned_for_is_preferred(car_task: Task) -> None:
    """To brake is right before a line, and a free road asks for nothing else."""
    guard, columns = Guard(car_task, Rule(car_task, -10.0), "none"), list(car_task.system.names)
    x = car_task.sample(400, seed=7).double()
    fine = x[guard.decide(x).rho >= 0.0][:3]
    hit = fine.clone()
    hit[:, columns.index("dx")] = 0.5
    assert guard.prefer(torch.stack((hit, fine), 1)).tolist() == [1, 1, 1]
    assert guard.prefer(torch.stack((fine, hit), 1)).tolist() == [0, 0, 0]
    assert guard.prefer(torch.stack((fine, fine), 1)).tolist() == [0, 0, 0]


def test_what_was_begun_speaks_for_the_option_that_it_belongs_to(car_task: Task) -> None:
    x = car_task.sample(400, seed=8).double()
    brake, go = (Guard(car_task, Rule(car_task, action), "none") for action in (-10.0, 10.0))
    rows = torch.nonzero((brake.decide(x).rho >= 0.0) & (go.decide(x).rho < 0.0)).squeeze(1)[:3]
    x, easy = x[rows], x[rows].clone()
    columns = list(car_task.system.names)
    for name, value in {"x": 1.0, "sign": 1.0, "dx": -1.0, "v_lead": 0.0, "yielding": 0.0}.items():
        easy[:, columns.index(name)] = value
    options = torch.stack((x, easy), 1)
    assert go.prefer(options).tolist() == [1, 1, 1]
    begun = brake.decide(x)
    assert float(begun.rho.min()) >= 0.0
    kept = go.prefer(options, begun)
    better = go.task.cost(go.task.judge(easy, go.policy.plan(easy).double())) < go.task.cost(
        go.task.judge(x, begun.plan)
    )
    assert torch.equal(kept == 1, better)


def test_a_begun_plan_goes_on_while_it_holds_and_is_no_worse(car_task: Task) -> None:
    """A policy that would wait at every step is overruled by what was begun."""
    state = {"x": -1.3, "v": 0.0, "sign": 0.0, "tau": 0.0, "dx": -1.0, "v_lead": 0.0, "yielding": 0.0}
    x = torch.tensor([[state[name] for name in car_task.system.names]], dtype=F64)

    class Later(Policy):
        """Waits for half a second, then moves up to the line."""

        def candidates(self, x0: Tensor) -> Tensor:
            steps = torch.zeros(len(x0), car_task.horizon, 1, dtype=x0.dtype)
            steps[:, 5:8], steps[:, 9:12] = 10.0 / 3, -10.0 / 3
            return steps[:, None]

    guard = Guard(car_task, Later(car_task), "none")
    decision, begun = guard.decide(x), None
    assert float(decision.rho[0]) >= 0
    fresh = x
    for _ in range(16):
        fresh = car_task.system.step(fresh, guard.decide(fresh).action)
        decision = guard.decide(x, begun)
        x, begun = car_task.system.step(x, decision.action), decision.later()
    at = car_task.system.names.index("x")
    assert float(fresh[0, at]) == pytest.approx(-1.3)
    assert float(x[0, at]) > -1.0
