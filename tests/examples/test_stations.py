"""The rovers' map against the facts of the benchmark, written out by hand."""

from __future__ import annotations

import sys
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from stlc.controller.world import Choosing, world_type
from stlc.dynamics.system import System

ROVER = Path(__file__).parents[2] / "examples" / "rover.yaml"
BOXES = ((0.0, 0.0, 3.0), (3.5, 7.0, 3.0), (7.0, 0.0, 3.0), (4.25, 4.25, 1.5))  # corner and size


@pytest.fixture(scope="module")
def system() -> System:
    return System.load(ROVER)


def make(system: System, rovers: int = 5, seed: int = 0) -> Any:
    world = world_type(system.decl)(system, rovers, torch.Generator().manual_seed(seed))
    world.reset()
    return world


def named(world: Any, states: torch.Tensor) -> dict[str, np.ndarray]:
    return dict(zip(world.system.names, states.T.numpy(), strict=True))


def put(world: Any, **columns: float) -> torch.Tensor:
    x = world.state.clone()
    for name, value in columns.items():
        x[:, world.at[name]] = value
    world.state = x
    return x


def drive(world: Any, x: torch.Tensor, speed: float = 0.0, heading: float = 0.0) -> dict[str, np.ndarray]:
    action = torch.tensor([[speed, heading]], dtype=torch.float64).expand(len(x), 2)
    return named(world, world.advance(x, action))


# ------------------------------------------------------------------------------- map


def test_the_walls_are_those_of_the_benchmark(system: System) -> None:
    wanted = [(x, y, x + size, y + size) for x, y, size in BOXES]
    assert make(system).walls.tolist() == [list(box) for box in wanted]


def test_stations_are_far_apart_and_on_free_ground(system: System) -> None:
    def mean_distance(places: np.ndarray) -> float:
        return float(np.mean([np.linalg.norm(a - b) for a, b in combinations(places, 2)]))

    spreads = []
    for seed in range(5):
        places = make(system, seed=seed).places.numpy()
        assert places.shape == (5, 2)
        assert (places >= 0).all()
        assert (places <= 10).all()
        for x, y, size in BOXES:
            assert not ((places > (x, y)) & (places < (x + size, y + size))).all(1).any()
        spreads.append(mean_distance(places))
    random = np.random.default_rng(0).uniform(0, 10, (1000, 5, 2))
    assert min(spreads) > np.quantile([mean_distance(five) for five in random], 0.9)


def test_the_best_of_the_drawn_fives_is_taken(system: System) -> None:
    module = sys.modules[world_type(system.decl).__module__]
    places = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5], [9.0, 9.0]])
    found = module.farthest(places.double(), torch.Generator().manual_seed(0))
    assert sorted(map(tuple, found.tolist())).count((9.0, 9.0)) in (2, 3)


def test_rovers_start_with_a_battery_that_lasts_to_a_station(system: System) -> None:
    for seed in range(5):
        world = make(system, seed=seed)
        start = named(world, world.state)
        at = np.stack([start["x"], start["y"]], 1)
        apart = np.linalg.norm(at[:, None] - world.places.numpy(), axis=2)
        assert (apart.min(1) <= 0.8 + 10 * start["tau_b"] + 1e-9).all()
        assert np.stack([start["xc"], start["yc"]], 1) == pytest.approx(world.places.numpy()[apart.argmin(1)])
        assert (start["tau_s"] == 0.6).all()
        assert len({tuple(place) for place in at.tolist()}) == 5


# --------------------------------------------------------------------------- stations


def test_a_rover_on_its_way_may_choose_among_five_stations(system: System) -> None:
    world = make(system)
    assert isinstance(world, Choosing)
    put(world, x=5.0, y=3.4)
    options = world.options()
    assert options.shape == (5, 5, 8)
    assert torch.equal(options[:, 0], world._told(world.state))
    stations = options[0, :, [world.at["xc"], world.at["yc"]]]
    assert {tuple(place) for place in stations.tolist()} == {tuple(p) for p in world.places.tolist()}
    chosen = world.choose(torch.tensor([0, 1, 2, 3, 4]))
    assert torch.equal(chosen, options[torch.arange(5), torch.arange(5)])
    assert torch.equal(world.options()[:, 0], chosen)


def test_a_rover_at_its_station_stays_with_it(system: System) -> None:
    world = make(system, 1)
    x, y = world.places[int(world.mine[0])].tolist()
    put(world, x=x + 0.8, y=y)
    before = world.state.clone()
    assert torch.equal(world.options(), before[:, None].expand(1, 5, 8))
    assert torch.equal(world.choose(torch.tensor([3])), before)
    put(world, x=x + 0.81, y=y)
    assert len(world.options()[0].unique(dim=0)) == 5


def test_the_time_to_stay_runs_at_the_station_and_is_renewed_outside(system: System) -> None:
    world = make(system, 1)
    x, y = world.places[int(world.mine[0])].tolist()
    there = drive(world, put(world, x=x, y=y, tau_s=0.4, tau_b=1.0))
    assert there["tau_s"][0] == pytest.approx(0.2)
    assert there["tau_b"][0] == 5.0
    away = drive(world, put(world, x=x + 0.7, y=y, tau_s=0.2), speed=5.0)
    assert away["tau_s"][0] == 0.6


def test_the_battery_runs_down_below_zero(system: System) -> None:
    world = make(system, 1)
    left = drive(world, put(world, x=5.0, y=3.4, tau_b=0.1))["tau_b"]
    assert left[0] == pytest.approx(-0.1)
    assert world.progress()["share_with_charge"] == 0.0
    drive(world, put(world, tau_b=3.0))
    assert world.progress()["share_with_charge"] == 0.5


# ------------------------------------------------------------------------ destinations


@pytest.mark.parametrize(("apart", "count"), [(0.8, 1), (0.81, 0)])
def test_the_next_destination_comes_one_step_after_one_was_reached(
    system: System, apart: float, count: int
) -> None:
    world = make(system, 1)
    x, y = world.list[0, 0].tolist()
    moved = drive(world, put(world, x=x + apart, y=y))
    assert world.progress()["destinations_reached"] == count
    assert (moved["xd"][0], moved["yd"][0]) == tuple(world.list[0, count].tolist())


@pytest.mark.parametrize(
    ("start", "heading", "crashed"),
    [((3.1, 1.0), 0.0, 0.0), ((3.1, 1.0), np.pi, 1.0), ((4.0, 5.0), 0.0, 1.0), ((9.0, 9.0), 0.0, 1.0)],
)
def test_walls_between_samples_and_the_edge_of_the_map_count(
    system: System, start: tuple[float, float], heading: float, crashed: float
) -> None:
    world = make(system, 1)
    drive(world, put(world, x=start[0], y=start[1]), speed=10.0, heading=heading)
    assert world.progress()["rovers_crashed"] == crashed
    assert world.progress()["distance"] == pytest.approx(2.0)
