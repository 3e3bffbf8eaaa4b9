"""Plans stay within their bounds; the choice is the best of the candidates, or of changed copies of it."""

from __future__ import annotations

from copy import deepcopy

import torch

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.policies.policy import VARIATIONS, BestOfKPolicy, PlanNetwork, variations
from stlc.controller.problem.task import Task


def _policy(task: Task, plans: int, *, varied: bool = False) -> BestOfKPolicy:
    torch.manual_seed(0)
    network = PlanNetwork(task, hidden=(16, 16), plans=plans, varied=varied)
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
    chosen = car_task.rank(judged)
    for index in range(5):
        other = car_task.judge(x0, candidates[:, index])
        assert (chosen >= car_task.rank(other) - 1e-12).all()


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


def test_a_variation_changes_one_control_by_a_small_amount(car_task: Task) -> None:
    changes = variations(car_task)
    half = 0.5 * (car_task.system.control_high - car_task.system.control_low).double()
    assert changes.shape == (8 * len(half), car_task.horizon, len(half))
    assert ((changes != 0).any(1).sum(1) == 1).all()
    assert (changes.abs() <= max(VARIATIONS) * half + 1e-12).all()
    assert changes.sum(0).abs().max() < 1e-12  # each with its negative


def test_the_best_variation_is_selected_where_every_plan_fails(car_task: Task) -> None:
    plain, varied = _policy(car_task, 3), _policy(car_task, 3, varied=True)
    x0 = car_task.sample(4000, seed=6, dtype=torch.float64)
    before, judged_before = plain.plan_judged(x0)
    after, judged = varied.plan_judged(x0)
    good = TOLERANCE.satisfied(judged_before.rho)
    assert torch.equal(after[good], before[good])
    assert (TOLERANCE.satisfied(judged.rho) & ~good).any()
    again = car_task.judge(x0, after)
    assert torch.equal(judged.rho, again.rho)
    assert torch.equal(judged.plans, after)
    assert all(torch.equal(column, again.columns[name]) for name, column in judged.columns.items())
    low, high = car_task.system.control_low.double(), car_task.system.control_high.double()
    some = (~good).nonzero()[:200, 0]
    chosen = car_task.rank(judged)[some]
    for change in varied.network.changes:
        other = car_task.judge(x0[some], (before[some] + change).clamp(low, high))
        assert (chosen >= car_task.rank(other) - 1e-12).all()
    assert torch.equal(varied(x0), after)


def test_a_continuation_is_not_varied_and_weights_are_stored_without_changes(car_task: Task) -> None:
    plain, varied = _policy(car_task, 3), _policy(car_task, 3, varied=True)
    x0 = car_task.sample(200, seed=7, dtype=torch.float64)
    assert torch.equal(varied.continuation(x0), plain(x0))
    assert not torch.equal(varied(x0), plain(x0))
    assert varied.network.state_dict().keys() == plain.network.state_dict().keys()
