"""Search repairs plans, keeps what is good, and never makes a plan worse."""

from __future__ import annotations

import pytest
import torch

from stlc import native
from stlc.controller.problem.native import Effort
from stlc.controller.problem.task import Task
from stlc.controller.search.local_search import Searcher, SearchResult
from stlc.controller.training.samplers import CAPACITY, ReplayBuffer
from stlc.dynamics.system import System


@pytest.fixture(params=["native", "torch"])
def task(request: pytest.FixtureRequest, car_task: Task, monkeypatch: pytest.MonkeyPatch) -> Task:
    """The car, with and without a compiler."""
    if request.param == "native":
        if native.compiler() is None:
            pytest.skip("there is no C compiler here")
        return car_task
    monkeypatch.setattr(native, "compiler", lambda: None)
    return Task(car_task.compiled, System(car_task.system.decl))


def test_search_repairs_most_of_what_zero_plans_fail(task: Task) -> None:
    x0 = task.sample(200, seed=7)
    start = torch.zeros(200, task.horizon, 1)
    before = task.judge(x0, start).rho
    searcher = Searcher(task, torch.Generator().manual_seed(0), target=0.02)
    found = searcher.repair(x0, start, start[:0], tries=1280)
    assert (found.rho >= before - 1e-6).all()
    assert torch.allclose(found.rho, task.judge(x0, found.plans).rho)
    assert torch.equal(found.states, x0)
    assert (before >= 0).double().mean() < 0.6
    assert found.solved.double().mean() > 0.9
    assert found.plans.abs().max() <= 10.0


def test_a_plan_that_is_good_enough_is_left_alone(task: Task) -> None:
    x0 = task.sample(100, seed=7)
    start = torch.zeros(100, task.horizon, 1)
    searcher = Searcher(task, torch.Generator().manual_seed(0), target=0.02)
    found = searcher.repair(x0, start, start[:0], tries=64)
    good = task.judge(x0, start).rho >= 0.02
    assert torch.equal(found.plans[good], start[good])
    assert not torch.equal(found.plans[~good], start[~good])


def test_a_plan_without_any_margin_solves_its_state() -> None:
    """Best plan with a robustness of exactly 0, where an allowance is counted in whole steps."""
    rho = torch.tensor([-1e-3, -1e-7, 0.0, 0.3])
    found = SearchResult(torch.zeros(4, 2), torch.zeros(4, 3, 1), rho)
    assert found.solved.tolist() == [False, True, True, True]


def test_search_depends_on_its_generator_alone(task: Task) -> None:
    x0 = task.sample(30, seed=8)
    start = torch.zeros(30, task.horizon, 1)

    def run() -> torch.Tensor:
        torch.rand(3)  # the global generator must not matter
        searcher = Searcher(task, torch.Generator().manual_seed(5), target=0.02)
        return searcher.repair(x0, start, start[:0], tries=48).plans

    assert torch.equal(run(), run())


def test_plans_of_the_library_are_tried(task: Task) -> None:
    x0 = task.sample(100, seed=9)
    start = torch.zeros(100, task.horizon, 1)
    solved = Searcher(task, torch.Generator().manual_seed(0), target=0.02).repair(x0, start, start[:0])
    library = solved.plans[solved.solved]
    few = [
        Searcher(task, torch.Generator().manual_seed(1), target=0.02).repair(x0, start, plans, tries=64).rho
        for plans in (library, library[:0])
    ]
    assert (few[0] >= 0).double().mean() >= (few[1] >= 0).double().mean() - 0.02


@pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")
def test_a_native_search_does_not_depend_on_how_it_is_shared(car_task: Task) -> None:
    x0 = car_task.sample(50, seed=8)
    start = torch.zeros(50, car_task.horizon, 1)
    assert car_task.native is not None
    alone, shared = (
        car_task.native.local_search(x0, start, start[:0], Effort(5, 0.02, seed=3, threads=threads))
        for threads in (1, 3)
    )
    assert torch.equal(alone[0], shared[0])
    assert torch.equal(alone[1], shared[1])


def test_the_buffer_forgets_the_oldest() -> None:
    buffer = ReplayBuffer.empty(2, 3, 1, torch.device("cpu"))
    for start in range(0, CAPACITY + 10, 10):
        rows = torch.arange(start, start + 10, dtype=torch.float32)
        buffer.add(rows[:, None].expand(-1, 2), rows[:, None, None].expand(-1, 3, 1))
    assert len(buffer) == CAPACITY
    kept = buffer.states[:, 0]
    assert kept.min() == 10
    assert kept.max() == CAPACITY + 9
    states, plans = buffer.draw(100, torch.Generator().manual_seed(1))
    assert torch.equal(states[:, 0], plans[:, 0, 0])


def test_a_search_that_is_stopped_gives_what_it_has(task: Task) -> None:
    x0 = task.sample(40, seed=7)
    start = torch.zeros(40, task.horizon, 1)
    searcher = Searcher(task, torch.Generator().manual_seed(0), target=0.02)
    found = searcher.repair(x0, start, start[:0], stop=lambda: True)
    assert torch.equal(found.plans, start)
    assert torch.allclose(found.rho, task.judge(x0, start).rho)


def test_a_search_beside_the_steps_can_be_begun_again(task: Task) -> None:
    """Results that depend on the first plan; a share of the work is done with every step."""
    x0 = task.sample(20, seed=7)
    start = torch.zeros(20, task.horizon, 1)
    searcher = Searcher(task, torch.Generator().manual_seed(0), target=0.02)
    first = searcher.begin(x0, start, start[:0], tries=640, steps=5)
    assert task.native is not None or first.result(stop=lambda: True) is None
    again = searcher.begin(x0, start, start[:0], tries=640, steps=3, seed=first.seed)
    for _ in range(5):
        first.advance()
    assert task.native is not None or first.done()
    one, other = first.result(), again.result()
    assert one is not None
    assert other is not None
    assert torch.equal(one.plans, other.plans)
    assert bool((one.rho > task.judge(x0, start).rho).any())


def test_a_search_that_is_cancelled_comes_to_its_end(car_task: Task) -> None:
    x0 = car_task.sample(5000, seed=7)
    start = torch.zeros(5000, car_task.horizon, 1)
    searcher = Searcher(car_task, torch.Generator().manual_seed(0), target=1e9)
    search = searcher.begin(x0, start, start[:0], tries=10**6)
    if car_task.native is not None:
        search.cancel()
        assert search.result() is not None
