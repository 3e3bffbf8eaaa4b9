"""Search repairs plans, keeps what is good, and never makes a plan worse."""

from __future__ import annotations

import torch

from stlc.controller.buffer import CAPACITY, Buffer
from stlc.controller.search import Effort, Searcher
from stlc.controller.task import Task


def test_search_repairs_most_of_what_zero_plans_fail(car_task: Task) -> None:
    x0 = car_task.sample(200, seed=7)
    start = torch.zeros(200, car_task.horizon, 1)
    before = car_task.judge(x0, start).rho
    searcher = Searcher(car_task, torch.Generator().manual_seed(0), enough=0.02)
    found = searcher.repair(x0, start, torch.zeros(0, car_task.horizon, 1), (Effort(rounds=20, tries=64),))
    assert (found.rho >= before).all()
    assert torch.allclose(found.rho, car_task.judge(x0, found.plans).rho)
    assert (before >= 0).double().mean() < 0.6
    assert found.solved.double().mean() > 0.9
    assert found.plans.abs().max() <= 10.0
    untouched = before >= 0.02
    assert torch.equal(found.plans[untouched], start[untouched])


def test_search_depends_on_its_generator_alone(car_task: Task) -> None:
    x0 = car_task.sample(30, seed=8)
    start = torch.zeros(30, car_task.horizon, 1)

    def run() -> torch.Tensor:
        torch.rand(3)  # the global generator must not matter
        searcher = Searcher(car_task, torch.Generator().manual_seed(5), enough=0.02)
        return searcher.repair(x0, start, start[:0], (Effort(rounds=3, tries=16),)).plans

    assert torch.equal(run(), run())


def test_the_buffer_forgets_the_oldest() -> None:
    buffer = Buffer.empty(2, 3, 1, torch.device("cpu"))
    for start in range(0, CAPACITY + 10, 10):
        rows = torch.arange(start, start + 10, dtype=torch.float32)
        buffer.add(rows[:, None].expand(-1, 2), rows[:, None, None].expand(-1, 3, 1))
    assert len(buffer) == CAPACITY
    kept = buffer.states[:, 0]
    assert kept.min() == 10
    assert kept.max() == CAPACITY + 9
    states, plans = buffer.draw(100, torch.Generator().manual_seed(1))
    assert torch.equal(states[:, 0], plans[:, 0, 0])
