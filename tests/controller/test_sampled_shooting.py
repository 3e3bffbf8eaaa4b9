"""Sampled beginnings of plans, against the same done one by one."""

from __future__ import annotations

import torch
from torch import Tensor

from stlc.controller.guard.stages.sampled_shooting import SampledPrefixes
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import Task
from stlc.runtime.prefixes import PrefixGrid
from tests.controller.guard.test_prefix_shooting import F64, Constant, grid


class Reached(Policy):
    """A policy whose plan tells the state that it was asked in, and the step of the plan."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.speed = task.system.names.index("v")

    def candidates(self, x0: Tensor) -> Tensor:
        return (0.1 * x0[:, self.speed, None] + 0.2 * torch.arange(self.task.horizon))[:, None, :, None]


def test_they_are_finished_from_where_they_end(car_task: Task) -> None:
    x = car_task.sample(9, seed=1, dtype=F64)
    policy = Reached(car_task)
    begun = SampledPrefixes(car_task, policy, grid(lengths=(1, 2), batch=70), 30).finished(x)
    assert begun.plans.shape == (9, 5 + 25, car_task.horizon, 1)
    assert begun.prefix_length[0].tolist() == [1] * 5 + [2] * 25
    for agent, row in ((0, 0), (3, 4), (8, 5), (8, 29)):
        length, plan = int(begun.prefix_length[agent, row]), begun.plans[agent, row]
        start = x[agent : agent + 1]
        reached = car_task.rollout(start, plan[None, :length])[:, -1]
        tail = policy.plan(reached)[0, : car_task.horizon - length]
        assert torch.allclose(plan[length:], tail, atol=1e-9)
        judged = car_task.judge(start, plan[None])
        assert float(begun.rho[agent, row]) == float(judged.rho)
        assert float(begun.safe[agent, row]) == float(judged.safe)
    heads = begun.plans[0, 5:, :2, 0]
    assert {tuple(head) for head in heads.tolist()} == {
        (a, b) for a in grid().values[0] for b in grid().values[0]
    }


def test_a_large_grid_is_sampled(car_task: Task) -> None:
    policy = Constant(car_task, 0.0)
    some = SampledPrefixes(car_task, policy, PrefixGrid(((-2.0, 0.0, 3.0, 4.0),), (1, 4), 64), 30)
    assert some.lengths.tolist() == [1] * 4 + [4] * 30
    long = some.heads[4:, :, 0]
    assert set(long.flatten().tolist()) == {-2.0, 0.0, 3.0, 4.0}
    assert len({tuple(head) for head in long.tolist()}) > 20


def test_no_more_than_a_batch_at_a_time(car_task: Task) -> None:
    policy = Constant(car_task, 0.0)
    SampledPrefixes(car_task, policy, grid(lengths=(1, 2), batch=70), 30).finished(
        car_task.sample(5, seed=1, dtype=F64)
    )
    assert policy.rows == [60, 60, 30]


def test_a_grid_without_lengths_has_none(car_task: Task) -> None:
    none = SampledPrefixes(car_task, Constant(car_task, 0.0), grid(lengths=()), 30)
    assert len(none.heads) == 0
