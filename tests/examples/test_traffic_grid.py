from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.traffic_drivers import Driver, careful, reckless

from stlc.controller.world import world_type
from stlc.dynamics.system import System

pytestmark = pytest.mark.apart  # worlds of the examples: their own programs

CAR = Path(__file__).parents[2] / "examples" / "car.yaml"
STEPS = 150


@pytest.fixture(scope="module")
def system() -> System:
    return System.load(CAR)


@pytest.fixture(scope="module")
def grid(system: System) -> Any:
    """The module of the world, as the loader imports it."""
    return sys.modules[world_type(system.decl).__module__]


def make(system: System, seed: int = 0, agents: int = 20) -> Any:
    return world_type(system.decl)(system, agents, torch.Generator().manual_seed(seed))


def film(world: Any, driver: Driver, steps: int = STEPS) -> Iterator[dict[str, np.ndarray]]:
    """States by column, step by step."""
    x = world.reset()
    for _ in range(steps):
        yield dict(zip(world.system.names, x.T.numpy(), strict=True))
        x = world.advance(x, driver(x))


@pytest.fixture(scope="module")
def drives(system: System) -> list[tuple[Any, dict[str, np.ndarray]]]:
    """Three seeds with the careful driver: the world, and its columns as (steps, cars)."""
    found = []
    for seed in range(3):
        world = make(system, seed)
        frames = list(film(world, careful))
        found.append((world, {name: np.stack([f[name] for f in frames]) for name in frames[0]}))
    return found


# ------------------------------------------------------------------------- driving


def test_careful_cars_never_overlap_and_traffic_flows(drives: list[Any]) -> None:
    progress = [world.progress() for world, _ in drives]
    assert [p["overlapping_pairs"] for p in progress] == [0.0] * 3
    assert min(p["min_gap"] for p in progress) > 0.9
    assert np.mean([p["mean_speed"] for p in progress]) > 2.5
    assert min(p["junctions_passed"] for p in progress) > 30


def test_reckless_cars_are_caught_overlapping(system: System) -> None:
    world = make(system)
    list(film(world, reckless(0)))
    assert world.progress()["overlapping_pairs"] > 3
    assert world.progress()["min_gap"] < 0


def test_no_car_stands_for_ever(drives: list[Any]) -> None:
    moved = np.concatenate([columns["v"].mean(0) for _, columns in drives])
    assert (moved > 0.5).mean() > 0.95
    assert moved.min() > 0.1


def test_yielding_never_begins_close_to_the_line(drives: list[Any]) -> None:
    for _, columns in drives:
        begins = np.diff(columns["yielding"], axis=0) > 0.5
        assert (columns["x"][1:][begins] <= -2.0).all()


def test_one_car_at_a_time_may_enter_a_stop_junction(system: System) -> None:
    world = make(system, 3)
    for _ in film(world, careful, 80):
        inside = [car.here for car in world.cars if car.inside and not world.grid.light[car.here]]
        assert len(inside) == len(set(inside))
        assert all(world.holder[car.here] is car for car in world.cars if car.inside and car.here in inside)


def test_the_states_stay_within_their_ranges(system: System, drives: list[Any]) -> None:
    for _, columns in drives:
        for column in system.signature.columns:
            values = columns[column.name]
            assert values.min() >= column.low - 1e-9
            assert values.max() <= column.high + 1e-9 or column.name == "tau"
        stopped = (columns["sign"] < 0.5) & (columns["x"] < -1.0)
        assert (columns["tau"][stopped] == 0.0).all()


def test_the_same_seed_is_the_same_traffic(system: System) -> None:
    first, second, other = (list(film(make(system, seed), careful, 40))[-1] for seed in (5, 5, 6))
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert not all(np.array_equal(first[name], other[name]) for name in first)


def test_cars_move_as_the_model_says(system: System) -> None:
    world = make(system, 1)
    x = world.reset()
    before = [(car.inside, car.here, car.s) for car in world.cars]
    u = reckless(1)(x)
    expected = system.step(x, u)
    world.advance(x, u)
    for i, (car, (inside, here, s)) in enumerate(zip(world.cars, before, strict=True)):
        assert car.v == pytest.approx(float(expected[i, 1]))
        if (car.inside, car.here) == (inside, here):
            assert car.s - s == pytest.approx(float(expected[i, 0] - x[i, 0]))


# ----------------------------------------------------------------------------- map


def test_the_grid_is_that_of_the_paper(grid: Any) -> None:
    drawn = grid.Grid.drawn(np.random.default_rng(0), 11.0)
    assert len(drawn.places) == 20
    assert sorted(len(near) for near in drawn.neighbours) == [2] * 4 + [3] * 10 + [4] * 6
    corners = [j for j, near in enumerate(drawn.neighbours) if len(near) == 2]
    assert not drawn.light[corners].any()
    assert min(drawn.length.values()) >= 7.0


def test_routes_have_no_u_turns_and_no_left_turns_at_lights(grid: Any) -> None:
    rng = np.random.default_rng(1)
    drawn = grid.Grid.drawn(rng, 11.0)
    for (past, here), _ in product(drawn.length, range(8)):
        onward = drawn.choose(past, here, rng)
        assert onward != past
        assert not (drawn.light[here] and drawn.turn(past, here, onward) == grid.LEFT)


@pytest.mark.parametrize("turn", [1, 0, -1])
@pytest.mark.parametrize("direction", range(4))
def test_turns_are_smooth_and_as_long_as_they_say(grid: Any, direction: int, turn: int) -> None:
    s = np.linspace(-1.0, grid.SPAN[turn] + 1.0, 4001)
    poses = np.array([grid.turn_pose(direction, turn, at) for at in s])
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert steps == pytest.approx(np.diff(s), rel=1e-3)
    driven = np.arctan2(*np.diff(poses[:, :2], axis=0).T[::-1])
    assert np.cos(driven - poses[:-1, 2]) == pytest.approx(1.0, abs=1e-3)
    assert poses[-1, 2] - poses[0, 2] == pytest.approx(turn * np.pi / 2)


@pytest.mark.parametrize(
    ("pose", "hit"),
    [
        ((0.9, 0.0, 0.0), True),
        ((1.1, 0.0, 0.0), False),
        ((0.0, 0.5, 0.0), True),
        ((0.0, 0.7, 0.0), False),
        ((0.75, 0.0, np.pi / 2), True),
        ((0.85, 0.0, np.pi / 2), False),
        ((0.8, 0.6, np.pi / 4), True),
        ((0.95, 0.75, np.pi / 4), False),
    ],
)
def test_overlap_of_rectangles(grid: Any, pose: tuple[float, float, float], hit: bool) -> None:
    origin = np.zeros(3)
    assert bool(grid.overlap(origin, np.array(pose))) is hit
    assert bool(grid.overlap(np.array(pose), origin)) is hit


def test_overlap_equals_a_dense_sample_of_points(grid: Any) -> None:
    rng = np.random.default_rng(2)
    edge = np.linspace(-0.5, 0.5, 61)
    points = np.array(list(product(edge * 1.0, edge * 0.6)))
    for pose in rng.uniform((-1.2, -1.2, 0), (1.2, 1.2, 6.3), (300, 3)):
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        placed = points @ np.array([(cos, sin), (-sin, cos)]) + pose[:2]
        covered = bool(((np.abs(placed[:, 0]) < 0.5) & (np.abs(placed[:, 1]) < 0.3)).any())
        if covered:
            assert grid.overlap(np.zeros(3), pose)
        elif grid.overlap(np.zeros(3), pose):
            assert grid.overlap(np.zeros(3), pose, grow=-0.02) == covered


# -------------------------------------------------------------------------- rules


def test_lights_hold_their_timer_when_red_begins(system: System, grid: Any) -> None:
    world = make(system)
    world.reset()
    junction = int(np.flatnonzero(world.grid.light)[0])
    shown = []
    for world.clock in range(2 * 110):
        shown.append([world._timer(junction, direction) for direction in (0, 1)])
    times = np.array(shown)
    green = times > 4.0
    assert not green.all(1).any()
    assert green.sum(0) == pytest.approx([80, 80], abs=2)
    clear = ~green.any(1)
    assert clear.sum() == pytest.approx(4 * grid.ALL_RED / 0.1, abs=4)
    held = (times == 0.0).sum(0)
    assert held == pytest.approx([2 * 2 * grid.ALL_RED / 0.1] * 2, abs=4)
    rising = np.diff(times, axis=0)
    assert rising.max() < 0.1 + 1e-9


def test_the_leader_is_seen_through_the_junction(system: System, grid: Any) -> None:
    world = make(system, 0, agents=2)
    world.reset()
    behind, ahead = world.cars
    ahead.past, ahead.here, ahead.onward, ahead.inside = behind.past, behind.here, behind.onward, True
    ahead.s, ahead.v, ahead.beyond = 2.0, 3.0, behind.beyond
    behind.s = world.grid.length[behind.past, behind.here] - 1.5
    row = dict(zip(system.names, world._observe()[0].tolist(), strict=True))
    assert (row["dx"], row["v_lead"]) == pytest.approx((2.5, grid.counted_on(5.0, 3.0, 0.1)))
    ahead.past, ahead.here, ahead.onward, ahead.inside = behind.here, behind.onward, behind.beyond, False
    ahead.s = 1.0
    row = dict(zip(system.names, world._observe()[0].tolist(), strict=True))
    span = grid.SPAN[world.grid.turn(*behind.way)]
    assert row["dx"] == pytest.approx(1.5 + span + 1.0 - 1.0)


def test_a_crossing_car_in_the_junction_counts_as_a_leader_at_rest(system: System) -> None:
    world = make(system, 0, agents=2)
    world.reset()
    mine, crossing = world.cars
    here = next(j for j, near in enumerate(world.grid.neighbours) if len(near) == 4 and world.grid.light[j])
    east, north, west, south = (world.grid.neighbours[here][d] for d in range(4))
    mine.past, mine.here, mine.onward, mine.inside = south, here, north, False
    mine.s, mine.v = world.grid.length[south, here] - 0.5, 0.0
    crossing.past, crossing.here, crossing.onward, crossing.inside = west, here, east, True
    crossing.s, crossing.order = 1.0, 0.0
    row = dict(zip(system.names, world._observe()[0].tolist(), strict=True))
    assert row["v_lead"] == 0.0
    assert 1.0 < row["dx"] < 1.5
    crossing.s = 5.9
    row = dict(zip(system.names, world._observe()[0].tolist(), strict=True))
    assert row["dx"] == -1.0


@pytest.mark.parametrize(("v", "v_lead"), [(5.0, 5.0), (8.0, 3.0), (3.0, 9.0), (4.0, 0.5), (0.0, 0.0)])
def test_the_speed_to_count_on_asks_for_room_to_brake(grid: Any, v: float, v_lead: float) -> None:
    counted, worst = grid.counted_on(v, v_lead, 0.1), max(v_lead - 1.0, 0.0)
    assert 0.0 <= counted <= v_lead
    needed_if_constant = max(v - counted, 0.0) ** 2 / 20
    needed_if_braking = max(v**2 - worst**2, 0.0) / 20
    assert needed_if_constant == pytest.approx(needed_if_braking)


def test_too_many_cars_are_refused(system: System) -> None:
    with pytest.raises(ValueError, match="62 lanes"):
        make(system, agents=63)


# ------------------------------------------------------------------------- pictures


def test_a_frame_shows_every_car(system: System) -> None:
    figures = pytest.importorskip("matplotlib.figure")
    world = make(system, 2, agents=7)
    frames = [world.snapshot() for _ in film(world, careful, 3)]
    scene = {name: np.stack([frame[name] for frame in frames]) for name in frames[0]}
    scene["decision"] = np.tile(np.arange(7) % 3, (3, 1))
    axes = figures.Figure().add_subplot()
    world.draw(axes, scene, 2)
    (drawn,) = [collection for collection in axes.collections if collection.get_zorder() == 3]
    cars = [path.vertices for path in drawn.get_paths()]
    assert len(cars) == 7
    assert len(np.unique(drawn.get_facecolor(), axis=0)) == 3
    (low, high), places = axes.get_xlim(), scene["junctions"][0]
    assert low < places[:, 1].min() - 3  # north is to the right
    assert high > places[:, 1].max() + 3
    for car, (x, y, angle) in zip(cars, scene["pose"][2], strict=True):
        corners = car[:4]
        np.testing.assert_allclose(corners.mean(0), (y, -x), atol=1e-9)
        ahead = corners[0] - corners[1]
        np.testing.assert_allclose(
            ahead / np.linalg.norm(ahead), (math.sin(angle), -math.cos(angle)), atol=1e-9
        )
