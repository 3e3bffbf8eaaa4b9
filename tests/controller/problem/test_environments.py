from __future__ import annotations

import torch

from stlc.controller.problem.environments import SATISFIED, Environments
from stlc.controller.problem.task import Task


def episode(task: Task, reward: str) -> tuple[Environments, torch.Tensor, list]:
    made = Environments(task, 64, reward=reward, generator=torch.Generator().manual_seed(1))  # type: ignore[arg-type]
    start = made.states
    made.reset()
    first = made.states
    assert not torch.equal(start, first)
    action = torch.full((64, 1), -10.0)
    return made, first, [made.step(action) for _ in range(made.steps)]


def test_the_reward_is_the_robustness_of_the_episode(car_task: Task) -> None:
    made, first, steps = episode(car_task, "robustness")
    plans = torch.full((64, made.steps, 1), -10.0)
    rho = car_task.judge(first, plans, states=False).rho
    assert all(float(step.reward.abs().sum()) == 0.0 and not bool(step.done.any()) for step in steps[:-1])
    assert torch.equal(steps[-1].reward, rho.clamp(-10.0, 10.0))
    assert bool(steps[-1].done.all())
    assert steps[-1].final.shape == steps[-1].observation.shape == (64, made.width)
    assert steps[-1].final[:, -1].tolist() == [1.0] * 64
    assert steps[-1].observation[:, -1].tolist() == [0.0] * 64


def test_accuracy_rewards_satisfied_episodes_alone(car_task: Task) -> None:
    _, _, steps = episode(car_task, "accuracy")
    last = steps[-1]
    assert torch.equal(last.reward, SATISFIED * last.satisfied.float())
    assert 0 < int(last.satisfied.sum()) < 64


def test_episodes_move_as_the_model_says(car_task: Task) -> None:
    made = Environments(car_task, 4, generator=torch.Generator().manual_seed(2))
    made.reset()
    before = made.states
    made.step(torch.full((4, 1), 99.0))
    assert torch.equal(made.states, car_task.system.step(before, torch.full((4, 1), 10.0)))
