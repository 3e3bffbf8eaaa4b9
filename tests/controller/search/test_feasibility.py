from __future__ import annotations

import torch

from stlc.controller.problem.task import Task
from stlc.controller.search.feasibility import viable
from stlc.controller.search.starts import MOST, extremes


def states(task: Task, **columns: list[float]) -> torch.Tensor:
    known = {"x": -9.0, "v": 5.0, "sign": 1.0, "tau": 4.5, "dx": -1.0, "v_lead": 0.0, "yielding": 0.0}
    count = len(next(iter(columns.values())))
    table = {name: [value] * count for name, value in known.items()} | columns
    return torch.tensor([table[name] for name in task.system.names], dtype=torch.float64).T.contiguous()


def test_who_can_still_brake_is_savable(car_task: Task) -> None:
    """Behind a leader at rest the gap must stay above 1 m, and braking from v takes about v^2 / 20."""
    x = states(car_task, dx=[1.2, 2.0, 3.0, 6.0], v=[5.0, 5.0, 5.0, 10.0], x=[-9.0] * 4)
    assert viable(car_task, x).tolist() == [False, False, True, False]


def test_liveness_does_not_count(car_task: Task) -> None:
    """A second at the stop sign is owed, but nobody is in danger."""
    x = states(car_task, sign=[0.0], tau=[0.0], x=[-0.01], v=[9.0])
    rho = car_task.judge(x, torch.full((1, 25, 1), -10.0, dtype=torch.float64)).rho
    assert float(rho) < 0.0
    assert viable(car_task, x).tolist() == [True]


def test_the_verdicts_repeat(car_task: Task) -> None:
    x = car_task.sample(100, seed=1).double()
    first = viable(car_task, x)
    assert torch.equal(first, viable(car_task, x))
    assert 0.9 < float(first.double().mean()) <= 1.0


def test_extreme_plans_hold_each_control(car_task: Task) -> None:
    plans = extremes(car_task, torch.Generator().manual_seed(0))
    assert plans.shape == (27, 25, 1)
    assert len(plans) <= MOST
    assert set(plans.unique().tolist()) == {-10.0, 0.0, 10.0}
    assert (plans[:, 0] == plans[:, 8]).all()
    assert (plans[:, 9] == plans[:, 17]).all()
    assert len({tuple(plan.flatten().tolist()) for plan in plans}) == 27
