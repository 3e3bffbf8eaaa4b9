"""The shaft against the facts of the benchmark, written out by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from stlc.controller.world import world_type
from stlc.dynamics.system import System

MAZE = Path(__file__).parents[2] / "examples" / "maze.yaml"


@pytest.fixture(scope="module")
def system() -> System:
    return System.load(MAZE)


def make(system: System, balls: int = 3, seed: int = 0) -> Any:
    world = world_type(system.decl)(system, balls, torch.Generator().manual_seed(seed))
    world.reset()
    return world


def rise(world: Any, steps: int, x: float | None = None) -> list[dict[str, np.ndarray]]:
    """Columns step by step, balls held at `x` if given."""
    states, seen = world.state, []
    for _ in range(steps):
        if x is not None:
            states[:, world.at["x"]], states[:, world.at["v"]] = x, 0.0
        states = world.advance(states, torch.zeros(len(states), 1, dtype=torch.float64))
        seen.append(dict(zip(world.system.names, states.T.numpy().copy(), strict=True)))
    return seen


def reference(rng: np.random.Generator, n: int) -> np.ndarray:
    """Levels as the benchmark draws them: left edge, width, goal."""
    length = rng.uniform(2, 4, n)
    edge = 2.5 + rng.uniform(-1, 1, n) * (5 - length) / 2 - length / 2
    edge = np.where(edge < 0.1, 0.0, edge)
    edge = np.where(5 - length - edge < 0.1, 5 - length, edge)
    left = edge * rng.uniform(0.3, 0.7, n)
    right = edge + length + (5 - length - edge) * rng.uniform(0.3, 0.7, n)
    side = rng.integers(0, 3, n)
    fits_left = (left >= 0.4) & (edge - left >= 0.4)
    fits_right = (5 - right >= 0.4) & (right - edge - length >= 0.4)
    goal = np.where((side == 0) & fits_left, left, np.where((side == 1) & fits_right, right, -1.0))
    return np.stack([edge, length, goal], 1)


def test_there_are_two_hundred_levels_as_the_benchmark_draws_them(system: System) -> None:
    world = make(system, 40)
    levels = world.levels[:, 1:].reshape(-1, 3).numpy()
    assert world.levels.shape == (40, 200, 3)
    wanted = reference(np.random.default_rng(0), 200_000)
    for column in range(3):
        share = np.linspace(0.02, 0.98, 25)
        assert np.quantile(levels[:, column], share) == pytest.approx(
            np.quantile(wanted[:, column], share), abs=0.12
        )
    assert (levels[:, 2] < 0).mean() == pytest.approx((wanted[:, 2] < 0).mean(), abs=0.02)
    with_goal = levels[levels[:, 2] > 0]
    beside = np.minimum(
        np.abs(with_goal[:, 2] - with_goal[:, 0]), np.abs(with_goal[:, 2] - with_goal[:, :2].sum(1))
    )
    assert beside.min() >= 0.4 - 1e-9


def test_the_first_obstacle_begins_outside_of_the_left_wall(system: System) -> None:
    world = make(system, 60)
    first = world.levels[:, 0].numpy()
    assert (first[:, 0] == -0.1).all()
    goals = first[first[:, 2] > 0]
    assert 0 < len(goals) < 60
    assert (goals[:, 2] - (goals[:, 0] + goals[:, 1]) >= 0.4).all()
    assert (goals[:, 2] <= 4.6).all()


def test_a_ball_starts_below_the_first_level_and_sees_two(system: System) -> None:
    world = make(system)
    start = dict(zip(system.names, world.state.T.numpy(), strict=True))
    assert (start["x"] == 0.0).all()
    assert (start["v"] == 0.0).all()
    assert (start["dy"] == -2.5).all()
    for offset in (0, 1):
        for column, name in enumerate("xlg"):
            assert np.array_equal(start[f"{name}{offset}"], world.levels[:, offset, column].numpy())


def test_levels_come_every_two_and_a_half_metres(system: System) -> None:
    """500 steps of .2 m are 100 m: the ball is above the edges at 0, 2.5, … 95."""
    world = make(system, 1)
    seen = rise(world, 500)
    height = -2.5 + 0.2 * np.arange(1, 501)
    level = np.ceil(np.round(height / 2.5, 9))
    assert np.array([s["dy"][0] for s in seen]) == pytest.approx(height - 2.5 * np.maximum(level, 0))
    assert world.progress()["levels_passed"] == 39.0
    assert np.array_equal(seen[-1]["x0"], world.levels[:, 39, 0].numpy())


def test_what_is_touched_and_reached_is_counted_once_a_level(system: System) -> None:
    world = make(system, 1)
    world.levels[0, :, 0], world.levels[0, :, 1], world.levels[0, :, 2] = 1.0, 2.0, -1.0
    rise(world, 63, x=2.0)  # beyond the edges at 0, 2.5, 5, 7.5, to 10.1 m
    assert world.progress() == {
        "levels_passed": 5.0,
        "obstacles_touched": 5.0,
        "goals_met": 0.0,
        "goals_reached": 0.0,
    }
    world.levels[0, :, 2] = 4.0
    rise(world, 50, x=4.0)
    assert world.progress() == {
        "levels_passed": 9.0,
        "obstacles_touched": 5.0,
        "goals_met": 4.0,
        "goals_reached": 4.0,
    }
    rise(world, 25, x=3.5)
    assert world.progress()["goals_met"] == 6.0
    assert world.progress()["goals_reached"] == 4.0
