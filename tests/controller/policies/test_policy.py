"""Plans stay within their bounds; the monitor's choice is the best of the candidates."""

from __future__ import annotations

from copy import deepcopy

import torch

from stlc.controller.policies.policy import BestOfKPolicy, PlanNetwork
from stlc.controller.problem.task import Task, rank


def _policy(task: Task, plans: int) -> BestOfKPolicy:
    torch.manual_seed(0)
    network = PlanNetwork(task, hidden=(16, 16), plans=plans)
    network.normalise(task.sample(500, seed=1))
    return BestOfKPolicy(task, network)


def test_the_choice_is_the_best_of_the_candidates(car_task: Task) -> None:
    policy = _policy(car_task, 5)
    x0 = car_task.sample(100, seed=2, dtype=torch.float64)
    candidates = policy.candidates(x0)
    assert candidates.shape == (100, 5, car_task.horizon, 1)
    assert candidates.abs().max() <= 10.0
    plans, judged = policy.plan_judged(x0)
    again = car_task.judge(x0, plans)
    assert torch.equal(judged.rho, again.rho)
    chosen = rank(judged.rho, car_task.cost(judged), judged.safe)
    for index in range(5):
        other = car_task.judge(x0, candidates[:, index])
        assert (chosen >= rank(other.rho, car_task.cost(other), other.safe) - 1e-12).all()


def test_a_batch_equals_its_states_one_by_one(car_task: Task) -> None:
    policy = _policy(car_task, 3)
    x0 = car_task.sample(20, seed=3, dtype=torch.float64)
    together = policy(x0)
    alone = torch.cat([policy(x0[i : i + 1]) for i in range(20)])
    assert torch.allclose(together, alone, atol=1e-5)


def test_inputs_are_normalised(car_task: Task) -> None:
    network = _policy(car_task, 1).network
    observed = (car_task.system.observe(car_task.sample(500, seed=1)) - network.centre) / network.spread
    assert observed.mean(0).abs().max() < 1e-4
    assert (observed.std(0) <= 1.0 + 1e-4).all()


def test_a_copied_network_has_weights_of_its_own(car_task: Task) -> None:
    network = _policy(car_task, 2).network
    copied = deepcopy(network)
    with torch.no_grad():
        for weight in copied.parameters():
            weight += 1.0
    x0 = car_task.sample(5, seed=4)
    assert not torch.equal(network(x0), copied(x0))
    assert torch.equal(network(x0), _policy(car_task, 2).network(x0))
    assert torch.equal(copied.centre, network.centre)
