"""The arms against the facts of the benchmark, written out by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_paper_panda import flange

from stlc.controller.world import world_type
from stlc.dynamics.system import System

PANDA = Path(__file__).parents[2] / "examples" / "panda.yaml"


@pytest.fixture(scope="module")
def system() -> System:
    return System.load(PANDA)


def make(system: System, arms: int = 4, seed: int = 0) -> Any:
    world = world_type(system.decl)(system, arms, torch.Generator().manual_seed(seed))
    world.reset()
    return world


def still(world: Any, x: torch.Tensor) -> torch.Tensor:
    moved: torch.Tensor = world.advance(x, torch.zeros(len(x), 7, dtype=torch.float64))
    return moved


def test_links_end_at_the_flange(system: System) -> None:
    world = make(system, 50)
    q = world.state[:, world.joints].numpy()
    arms = world.snapshot()["arms"]
    assert arms.shape == (50, 9, 3)
    assert arms[:, -1] == pytest.approx(flange(q), abs=1e-12)
    assert np.linalg.norm(np.diff(arms, axis=1), axis=2) == pytest.approx(
        np.tile([0.333, 0.0, 0.316, 0.0825, np.hypot(0.0825, 0.384), 0.0, 0.088, 0.107], (50, 1)), abs=1e-12
    )


def test_goals_lie_in_their_box_outside_of_the_post(system: System) -> None:
    goals = make(system, 10).goals.numpy().reshape(-1, 3)
    low, high = goals.min(0), goals.max(0)
    assert (low >= (-0.5, -0.5, 0.2)).all()
    assert (high <= (0.5, 0.5, 0.8)).all()
    assert high - low == pytest.approx((1.0, 1.0, 0.6), abs=0.01)
    assert np.linalg.norm(goals - (0.3, 0.3, 0.5), axis=1).min() > 0.2


@pytest.mark.parametrize(("apart", "reached"), [(0.099, 1.0), (0.101, 0.0)])
def test_the_next_goal_comes_one_step_after_a_goal_was_reached(
    system: System, apart: float, reached: float
) -> None:
    world = make(system, 1)
    end = torch.from_numpy(flange(world.state[:, world.joints].numpy()))
    world.goals[:, 0] = end + apart * torch.tensor([0.6, 0.0, 0.8])
    world.state[:, world.goal] = world.goals[:, 0]
    moved = still(world, world.state)
    assert world.progress()["goals_reached"] == reached
    assert torch.equal(moved[:, world.goal], world.goals[:, int(reached)])
    again = still(world, moved)
    assert torch.equal(again[:, world.goal], world.goals[:, int(reached)])


def test_an_arm_in_the_post_stands_still(system: System) -> None:
    world = make(system, 200, seed=1)
    q = torch.rand(200, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2 - 1
    x = world.state.clone()
    x[:, world.joints] += q
    inside = np.linalg.norm(flange(x[:, world.joints].numpy()) - (0.3, 0.3, 0.5), axis=1) < 0.2
    assert 0 < inside.sum() < 100
    moved = world.advance(x, torch.full((200, 7), 0.01, dtype=torch.float64))
    went = (moved[:, world.joints] - x[:, world.joints]).numpy()
    assert (went[inside] == 0.0).all()
    assert went[~inside] == pytest.approx(0.001)
    assert world.progress()["arms_struck"] >= inside.sum()


def test_arms_are_drawn_side_by_side_within_the_picture(system: System) -> None:
    axes = pytest.importorskip("matplotlib.figure").Figure().add_subplot()
    world = make(system, 3)
    scene = {name: np.stack([value, value]) for name, value in world.snapshot().items()}
    world.draw(axes, scene | {"decision": np.array([[0, 1, 3]] * 2)}, 1)
    assert [text.get_text() for text in axes.texts][:3] == ["arm 0", "arm 1", "arm 2"]
    thick = [np.asarray(line.get_data()) for line in axes.lines if line.get_linewidth() > 2]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    assert len(thick) == 6  # each from the side, and from above
    for across, up in thick:
        assert left <= across.min() <= across.max() <= right
        assert low <= up.min() <= up.max() <= high
    bases = sorted(across[0] for across, _ in thick)
    assert np.diff(bases)[[1, 3]] == pytest.approx(2.0)
