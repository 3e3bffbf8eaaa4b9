"""`navigation.stl` and `rover.yaml` against the facts of the benchmark, written out by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import paper
from helpers.paper import Array

from stlc.dynamics.system import System

pytestmark = pytest.mark.apart

ROOT = Path(__file__).parents[1]

DT, NEAR = 0.2, 0.8
BOXES = ((0.0, 0.0, 3.0), (3.5, 7.0, 3.0), (7.0, 0.0, 3.0), (4.25, 4.25, 1.5))  # corner and side


def states(rng: np.random.Generator, n: int) -> Array:
    place = rng.uniform(-0.5, 10.5, (n, 2))
    station = np.where(rng.random((n, 1)) < 0.4, place + rng.normal(0, 1, (n, 2)), rng.uniform(0, 10, (n, 2)))
    goal = np.where(rng.random((n, 1)) < 0.4, place + rng.normal(0, 1, (n, 2)), rng.uniform(0, 10, (n, 2)))
    charge = np.where(rng.random(n) < 0.5, 0.2 * rng.integers(0, 26, n), rng.uniform(0, 5, n))
    return np.column_stack([place, goal, station, charge, rng.uniform(-0.2, 0.6, n)])


def step(s: Array, u: Array) -> Array:
    near = paper.ball_distance(s[:, 0], s[:, 1], s[:, 4], s[:, 5]) <= NEAR
    moved = s.copy()
    moved[:, 0] += u[:, 0] * np.cos(u[:, 1]) * DT
    moved[:, 1] += u[:, 0] * np.sin(u[:, 1]) * DT
    moved[:, 6] = (s[:, 6] - DT) * (1 - near) + 5 * near
    moved[:, 7] = s[:, 7] - DT * near
    return moved


def to_box(x: Array, y: Array, box: tuple[float, float, float]) -> Array:
    """Euclidean distance to a square, negative inside."""
    left, low, side = box
    dx = np.maximum(left - x, x - left - side)
    dy = np.maximum(low - y, y - low - side)
    outside = np.sqrt(np.maximum(dx, 0) ** 2 + np.maximum(dy, 0) ** 2)
    return np.where((dx <= 0) & (dy <= 0), np.maximum(dx, dy), outside)


def closest(a: Array, b: Array, box: tuple[float, float, float]) -> Array:
    """Least distance to a square on the way from `a` to `b`: it is convex, so thirds close in on it."""
    low, high = np.zeros(len(a)), np.ones(len(a))

    def at(share: Array) -> Array:
        place = a + share[:, None] * (b - a)
        return to_box(place[:, 0], place[:, 1], box)

    for _ in range(60):
        left, right = low + (high - low) / 3, high - (high - low) / 3
        lower = at(left) < at(right)
        low, high = np.where(lower, low, left), np.where(lower, right, high)
    return np.minimum(np.minimum(at(np.zeros(len(a))), at(np.ones(len(a)))), at((low + high) / 2))


def rules(x: Array) -> dict[str, Array]:
    count, samples = x.shape[:2]
    on_map, crash, battery = (np.full(count, np.inf) for _ in range(3))
    goal, station, dwell = np.full(count, -np.inf), np.full(count, -np.inf), np.full(count, np.inf)
    for t in range(samples):
        s, after = x[:, t], x[:, min(t + 1, samples - 1)]
        # the map is a region: outside of a corner the Euclidean distance to it counts
        on_map = np.minimum(on_map, -to_box(s[:, 0], s[:, 1], (0.0, 0.0, 10.0)))
        for box in BOXES:
            crash = np.minimum(crash, closest(s[:, :2], after[:, :2], box))
        at_goal = NEAR - paper.ball_distance(s[:, 0], s[:, 1], s[:, 2], s[:, 3])
        at_station = NEAR - paper.ball_distance(s[:, 0], s[:, 1], s[:, 4], s[:, 5])
        goal, station = np.maximum(goal, at_goal), np.maximum(station, at_station)
        battery = np.minimum(battery, s[:, 6])
        if t <= 3:  # 0.6 s
            dwell = np.minimum(dwell, np.maximum(at_station, -s[:, 7]))
    first = x[:, 0]
    away = paper.ball_distance(first[:, 0], first[:, 1], first[:, 4], first[:, 5]) - NEAR
    return {
        "stay_on_map": on_map,
        "no_crash": crash,
        "deliver": np.maximum(2.0 - first[:, 6], goal),
        "recharge": np.maximum(first[:, 6] - 2.0, station),
        "battery": battery,
        "dwell": np.maximum(away, dwell),
    }


def free(x: Array, y: Array) -> Array:
    inside = np.zeros(len(x), dtype=bool)
    for left, low, side in BOXES:
        inside |= (left <= x) & (x <= left + side) & (low <= y) & (y <= low + side)
    return ~inside & (x >= 0) & (x <= 10) & (y >= 0) & (y <= 10)


def starts(rng: np.random.Generator, count: int) -> Array:
    def draw(n: int) -> Array:
        station, goal = rng.uniform(0, 10, (n, 2)), rng.uniform(0, 10, (n, 2))
        charge = 0.2 * rng.integers(0, 26, n)
        radius = np.clip(rng.random(n) * 10 * charge, 0.8, 14.14)
        angle = rng.uniform(-math.pi, math.pi, n)
        hold = np.full(n, 0.6)
        staying = rng.random(n) < 0.25
        radius = np.where(staying, rng.uniform(0, 0.8, n), radius)
        charge = np.where(staying, 5.0, charge)
        hold = np.where(staying, 0.2 * rng.integers(0, 4, n), hold)
        place = station + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return np.column_stack([place, goal, station, charge, hold])

    def good(s: Array) -> Array:
        return free(s[:, 0], s[:, 1]) & free(s[:, 2], s[:, 3]) & free(s[:, 4], s[:, 5])

    return paper.kept(draw, good, count)


def features(s: Array) -> dict[str, Array]:
    apart = paper.ball_distance(s[:, 0], s[:, 1], s[:, 4], s[:, 5])
    return {
        "from the station": apart,
        "from the goal": paper.ball_distance(s[:, 0], s[:, 1], s[:, 2], s[:, 3]),
        "bearing": np.arctan2(s[:, 1] - s[:, 5], s[:, 0] - s[:, 4]),
        "from the station, by charge": (apart / np.maximum(s[:, 6], 0.2))[apart > 0.81],
        "hold at the station": s[apart < 0.79, 7],
    }


ROVER = paper.Benchmark(
    spec="navigation",
    system="rover",
    columns=("x", "y", "xd", "yd", "xc", "yc", "tau_b", "tau_s"),
    low=(0.0, -math.pi),
    high=(10.0, math.pi),
    steps=10,
    states=states,
    step=step,
    rules=rules,
    safe=frozenset({"stay_on_map", "no_crash", "battery"}),
    starts=starts,
    features=features,
)


def test_rollouts_and_verdicts_are_the_benchmarks() -> None:
    states_apart, rho_apart, safe_apart = paper.apart(ROVER, ROVER.task())
    assert states_apart <= 1e-9
    assert max(rho_apart, safe_apart) <= 1e-6  # the way past an obstacle is found by closing in on it


def test_the_kernel_gives_the_same() -> None:
    assert max(paper.kernel_apart(ROVER, ROVER.task())) <= 1e-9


@pytest.mark.parametrize(
    ("old", "new"),
    [("dt: 0.2 s", "dt: 0.21 s"), ("r_near:  0.8", "r_near:  0.81"), ("charge:  5 s", "charge:  5.1 s"),
     ("tau_b: -1", "tau_b: -1.1"), ("speed * cos", "1.01 * speed * cos")],
)  # fmt: skip
def test_a_changed_constant_of_the_system_is_noticed(old: str, new: str) -> None:
    spec = ((old.replace(":  ", " [m] = "), new.replace(":  ", " [m] = ")),) if "r_near" in old else ()
    assert paper.apart(ROVER, ROVER.task(spec, ((old, new),)), 200)[0] > 1e-3


@pytest.mark.parametrize(
    ("spec", "system"),
    [(("w      [m] = 3.0", "w      [m] = 3.1"), ("w:       3 m", "w:       3.1 m")),
     (("low    = 2 s", "low    = 2.1 s"), ("low:     2 s", "low:     2.1 s")),
     (("c      = 0.6 s", "c      = 0.4 s"), ("c:       0.6 s", "c:       0.4 s"))],
)  # fmt: skip
def test_a_changed_constant_of_the_specification_is_noticed(
    spec: tuple[str, str], system: tuple[str, str]
) -> None:
    assert paper.apart(ROVER, ROVER.task((spec,), (system,)), 300)[1] > 1e-3


def test_initial_states_have_the_benchmarks_distribution() -> None:
    assert paper.unlike(ROVER, ROVER.task()) == {}


def test_starts_on_the_grid_are_there_and_count_as_near() -> None:
    """14-15 % start exactly on the circle of their station, 5.6 % with an empty battery, which it fills."""
    task = ROVER.task()
    x0 = task.sample(20_000, seed=5, dtype=torch.float64)
    s = x0.numpy()
    circle = np.abs(paper.ball_distance(s[:, 0], s[:, 1], s[:, 4], s[:, 5]) - NEAR) < 1e-9
    assert 0.13 < circle.mean() < 0.16
    assert 0.045 < (s[:, 6] == 0).mean() < 0.065
    assert circle[s[:, 6] == 0].all()
    for dtype in (torch.float32, torch.float64):
        still = torch.zeros(len(x0), 10, 2, dtype=dtype)
        assert (task.rollout(x0.to(dtype), still)[circle, 1, 6] == 5).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new"),
    [("weight: 3", "weight: 4"), ("randint(0, 25)", "randint(1, 25)"), ("r_near, 14.14 m)", "0, 14.14 m)"),
     ("randint(0, 3)", "randint(1, 3)"), ("[xd, yd] not in obstacles", "xd > 0"),
     ("uniform(0, r_near)", "r_near * sqrt(uniform(0, 1))")],
)  # fmt: skip
def test_another_distribution_is_noticed(old: str, new: str) -> None:
    assert paper.unlike(ROVER, ROVER.task(system=((old, new),)))


def test_the_performance_term_is_the_papers() -> None:
    system = System.load(ROOT / "examples" / "rover.yaml")
    x0 = system.sample(400, seed=3, dtype=torch.float64)
    u = torch.rand(400, 10, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    columns = system.rollout_columns(x0, u)
    far = {
        end: torch.hypot(columns["x"] - columns[f"x{end}"], columns["y"] - columns[f"y{end}"]).mean(0)
        for end in "cd"
    }
    low = x0[:, system.names.index("tau_b")] <= 2.0
    wanted = 0.01 * torch.where(low, far["c"], far["d"])
    assert 0.2 < float(low.double().mean()) < 0.8
    assert torch.allclose(system.performance(columns, torch.ones(400)), wanted, atol=1e-6)
