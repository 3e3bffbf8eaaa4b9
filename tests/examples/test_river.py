"""The rivers against the facts of the benchmarks, written out by hand."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from stlc.controller.world import world_type
from stlc.dynamics.system import System

pytestmark = pytest.mark.apart  # worlds of the examples: their own programs

EXAMPLES = Path(__file__).parents[2] / "examples"


def river(name: str, seed: int = 0, ships: int = 20) -> tuple[Any, dict[str, np.ndarray]]:
    """A world that has begun, and the columns of its first states."""
    file, _, scenario = name.partition(" ")
    system = System.load(EXAMPLES / f"{file}.yaml", scenario=scenario or None)
    world = world_type(system.decl)(system, ships, torch.Generator().manual_seed(seed))
    x = world.reset()
    return world, dict(zip(system.names, x.T.numpy(), strict=True))


def put(world: Any, **columns: float) -> torch.Tensor:
    """The states of the world with some columns changed for everybody."""
    x = world.state.clone()
    for name, value in columns.items():
        x[:, world.at[name]] = value
    return x


def move(world: Any, x: torch.Tensor) -> dict[str, np.ndarray]:
    """One step straight on."""
    after = world.advance(x, torch.zeros(len(x), 2, dtype=torch.float64))
    return dict(zip(world.system.names, after.T.numpy(), strict=True))


@pytest.mark.parametrize("file", ["ship_safe", "ship_track"])
def test_starts_are_drawn_until_one_fits_for_every_ship(file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    world, _ = river(file)
    module = sys.modules[type(world).__module__]
    monkeypatch.setattr(module, "PROPOSED", 8)
    monkeypatch.setattr(module, "ATTEMPTS", 20)
    assert world.system.initial.holds(world.reset()).all()
    assert world.system.initial.holds(world.redraw(torch.tensor([3, 7]))).all()
    monkeypatch.setattr(module, "PROPOSED", 0)
    monkeypatch.setattr(module, "ATTEMPTS", 2)
    with pytest.raises(ValueError, match="no start of a ship fits"):
        world.redraw(torch.tensor([3, 7]))
    with pytest.raises(ValueError, match="first ship"):
        world.reset()


@pytest.mark.parametrize("seed", [232, 819, 1121])
def test_a_river_in_which_the_first_starts_of_a_ship_do_not_fit_begins(seed: int) -> None:
    world, _ = river("ship_track", seed)
    assert world.system.initial.holds(world.state).all()


# -------------------------------------------------------------------------- ship-safe


@pytest.mark.parametrize("seed", range(5))
def test_the_obstacles_of_ship_safe(seed: int) -> None:
    world, start = river("ship_safe", seed)
    assert np.allclose(world.chain.x, np.arange(1, 101) * 7.5)
    assert (world.chain.r == 1.0).all()
    assert float(world.chain.y.abs().max()) <= 2.0
    assert float(world.chain.y.std()) == pytest.approx(4 / np.sqrt(12), rel=0.2)
    for name, value in {"x": 0.0, "x1": 7.5, "r1": 1.0, "x2": 15.0, "r2": 1.0}.items():
        assert (start[name] == value).all()
    assert (start["y1"] == float(world.chain.y[0])).all()
    assert (start["y2"] == float(world.chain.y[1])).all()
    assert len(set(start["y"])) == 20


def test_the_window_of_ship_safe_moves_when_a_ship_is_beside_the_centre() -> None:
    world, _ = river("ship_safe")
    still = {"y": 0.0, "psi": 0.0, "u": 4.0, "v": 0.0, "r": 0.0}
    before = move(world, put(world, x=7.5 - 0.6001, **still))
    assert (before["x1"] == 7.5).all()
    after = move(world, put(world, x=7.5 - 0.5999, **still))
    assert (after["x1"] == 15.0).all()
    assert (after["x2"] == 22.5).all()
    assert (after["y1"] == float(world.chain.y[1])).all()


@pytest.mark.parametrize(("y", "aground"), [(1.99, False), (2.01, True), (-2.01, True)])
def test_a_bank_counts_as_aground(y: float, aground: bool) -> None:
    world, _ = river("ship_safe")
    world.hit[:] = False
    move(world, put(world, y=y, psi=0.0, u=3.0, v=0.0, r=0.0))
    assert world.progress()["ships_aground"] == 20.0 * aground


def test_an_obstacle_that_was_passed_still_counts() -> None:
    world, _ = river("ship_safe")
    x = put(world, x=7.5 + 0.5, y=float(world.chain.y[0]), psi=0.0, u=3.0, v=0.0, r=0.0)
    move(world, x)
    assert world.progress()["ships_aground"] == 20.0


# -------------------------------------------------------------------------- ship-track


@pytest.mark.parametrize("seed", range(5))
def test_the_obstacles_of_ship_track(seed: int) -> None:
    world, start = river("ship_track", seed)
    gaps = world.chain.x.diff()
    assert 15.0 <= float(gaps.min()) < 15.5
    assert 24.5 < float(gaps.max()) <= 25.0
    assert (world.chain.y == 0.0).all()
    assert 0.6 <= float(world.chain.r.min()) < float(world.chain.r.max()) <= 1.2
    for r, allowance in zip(world.chain.r.tolist(), world.chain.allowance.tolist(), strict=True):
        assert allowance == pytest.approx(2.25 if r < 0.8 else 3.0 if r < 1.0 else 3.75)
    assert (start["psi"] == 0.0).all()
    assert start["tau"] == pytest.approx(np.full(20, 2.25))
    assert (np.abs(start["y"]) <= 1.0).all()
    assert (start["x1"] == float(world.chain.x[0])).all()
    apart = np.hypot(start["x1"] - start["x"], start["y"])
    assert (apart > start["r1"]).all()


def test_the_next_obstacle_of_ship_track_comes_one_metre_behind_the_last() -> None:
    world, _ = river("ship_track")
    first, second = world.chain.x[:2].tolist()
    still = {"y": 1.5, "psi": 0.0, "u": 4.0, "v": 0.0, "r": 0.0}
    before = move(world, put(world, x=first + 1 - 0.6001, **still))
    assert (before["x1"] == first).all()
    after = move(world, put(world, x=first + 1 - 0.5999, **still))
    assert after["x1"] == pytest.approx(after["x"] - 5.0)  # not in view yet: none is known
    far = move(world, put(world, x=second - 8.6001, **still))
    assert far["x1"] == pytest.approx(far["x"] - 5.0)
    near = move(world, put(world, x=second - 8.5999, **still))
    assert (near["x1"] == second).all()


def test_ships_know_of_no_obstacle_that_training_never_showed_them() -> None:
    for name in ("ship_track", "ship_track shifted"):
        for seed in range(3):
            world, start = river(name, seed)
            x = torch.from_numpy(np.stack([start[column] for column in world.system.names], 1))
            for _ in range(60):
                ahead = x[:, world.at["x1"]] - x[:, world.at["x"]]
                assert bool(((ahead >= -5.0 - 1e-9) & (ahead <= 8.0)).all())
                x = world.advance(x, torch.zeros(len(x), 2, dtype=torch.float64))


def test_an_obstacle_in_view_renews_the_allowance_once() -> None:
    world, _ = river("ship_track")
    world.next[:] = 1
    world.state = world._facing(world.state)
    there, allowance = float(world.chain.x[1]), float(world.chain.allowance[1])
    still = {"y": 1.5, "psi": 0.0, "u": 4.0, "v": 0.0, "r": 0.0, "tau": -1.0}
    far = move(world, put(world, x=there - 8.6001, **still))
    assert far["tau"] == pytest.approx(np.full(20, -1.15))
    near = move(world, put(world, x=there - 8.5999, **still))
    assert near["tau"] == pytest.approx(np.full(20, allowance))
    seen = move(world, put(world, x=there - 7.5, **still))
    assert seen["tau"] == pytest.approx(np.full(20, -1.15))
    assert world.progress()["ships_late"] == 20.0


# --------------------------------------------------------------------------- shifted


@pytest.mark.parametrize("seed", range(5))
def test_the_shifted_river_is_that_of_the_backup_experiment(seed: int) -> None:
    world, start = river("ship_track shifted", seed)
    assert world.chain.x.tolist() == [4.0 + 12.0 * k for k in range(20)]
    assert world.chain.y.tolist() == [0.25] + [0.2] * 19
    plain = world.chain.r / torch.tensor([1.0, 1.5] + [1.0] * 18)
    assert 0.6 <= float(plain.min()) < float(plain.max()) <= 1.2
    assert {round(a / 0.15) for a in world.chain.allowance.tolist()} == {20, 25}
    for name, value in {"x": 0.0, "psi": 0.0, "u": 5.0, "v": 0.0, "r": 0.0, "tau": -0.75, "x1": 4.0}.items():
        assert start[name] == pytest.approx(np.full(20, value))
    off = np.abs(start["y"])
    assert 0.3 <= off.min() < off.max() <= 1.8
    assert {-1.0, 1.0} == set(np.sign(start["y"]))


def test_the_first_obstacle_in_view_renews_nothing_by_itself() -> None:
    world, _ = river("ship_track shifted")
    after = move(world, put(world, y=1.8))
    assert after["tau"] == pytest.approx(np.full(20, -0.9))
    switched = move(world, put(world, x=5.0, y=1.8, tau=-0.75))
    assert switched["tau"] == pytest.approx(np.full(20, -0.9))  # the second is still 9.5 m ahead
    seen = move(world, put(world, x=7.5, y=1.8))
    assert seen["tau"] == pytest.approx(np.full(20, float(world.chain.allowance[1])))
