"""`ship_safe` and `ship_track` against the facts of the benchmarks, written out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import paper
from helpers.paper import Array

pytestmark = pytest.mark.apart

LIMITS = ((2, 0.5), (4, 0.3), (5, 0.5))  # column and bound: heading, sway, turn rate


def hull(s: Array, u: Array, seconds: float) -> Array:
    """The six states of a ship after one Euler step."""
    y, psi, surge, sway, turn = s[:, 1], s[:, 2], s[:, 3], s[:, 4], s[:, 5]
    moved = s.copy()
    moved[:, 0] += seconds * (surge * np.cos(psi) - sway * np.sin(psi))
    moved[:, 1] = y + seconds * (surge * np.sin(psi) + sway * np.cos(psi))
    moved[:, 2] = np.clip(psi + seconds * turn, -0.5, 0.5)
    moved[:, 3] = np.clip(surge + seconds * u[:, 0], 3, 5)
    moved[:, 4] = np.clip(sway + seconds * 0.01 * u[:, 1], -0.3, 0.3)
    moved[:, 5] = np.clip(turn + seconds * 0.5 * u[:, 1], -0.5, 0.5)
    return moved


def any_hull(rng: np.random.Generator, n: int) -> list[Array]:
    low, high = (0, -2, -0.5, 3, -0.3, -0.5), (0, 2, 0.5, 5, 0.3, 0.5)
    return list(rng.uniform(low, high, (n, 6)).T)


# ----------------------------------------------------------------------------- ship-safe


def safe_states(rng: np.random.Generator, n: int) -> Array:
    other = [rng.uniform(low, high, n) for low, high in ((-1, 10), (-2, 2), (0.6, 1.2), (5, 15), (-2, 2))]
    return np.stack([*any_hull(rng, n), *other, rng.uniform(0.6, 1.2, n)], 1)


def safe_step(s: Array, u: Array) -> Array:
    return hull(hull(s, u, 0.075), u, 0.075)


def safe_rules(x: Array) -> dict[str, Array]:
    found = {name: np.full(len(x), np.inf) for name in ("in_river", "avoid_1", "avoid_2")}
    for t in range(x.shape[1]):
        s = x[:, t]
        found["in_river"] = np.minimum(found["in_river"], 2 - np.abs(s[:, 1]))
        for name, at in (("avoid_1", 6), ("avoid_2", 9)):
            apart = paper.ball_distance(s[:, 0], s[:, 1], s[:, at], s[:, at + 1])
            found[name] = np.minimum(found[name], apart - s[:, at + 2])
    return found


def safe_starts(rng: np.random.Generator, count: int) -> Array:
    def draw(n: int) -> Array:
        first = rng.uniform(0, 7.5, n)
        sides = rng.uniform(-2, 2, (2, n))
        ones = np.ones(n)
        return np.stack([*any_hull(rng, n), first, sides[0], ones, first + 7.5, sides[1], ones], 1)

    def good(s: Array) -> Array:
        x, y, psi, ox, oy, r = (s[:, i] for i in (0, 1, 2, 6, 7, 8))
        fine = paper.ball_distance(x, y, ox, oy) > r + 1.5
        for i in range(100):
            ahead = 5 * i / 100
            px, py = x + ahead * np.cos(psi), y + ahead * np.sin(psi)
            fine &= paper.ball_distance(px, py, ox, oy) > r
        return fine & (np.abs(py) < 2)

    return paper.kept(draw, good, count)


def safe_features(s: Array) -> dict[str, Array]:
    abeam = -(s[:, 7] - s[:, 1]) * np.cos(s[:, 2]) + s[:, 6] * np.sin(s[:, 2])
    return {
        "distance": paper.ball_distance(s[:, 0], s[:, 1], s[:, 6], s[:, 7]),
        "passes at": abeam,
        "passes at, near": abeam[s[:, 6] < 4.8],
        "drift": s[:, 1] * np.sign(s[:, 2]),
    }


SAFE = paper.Benchmark(
    spec="ship_safe",
    system="ship_safe",
    columns=("x", "y", "psi", "u", "v", "r", "x1", "y1", "r1", "x2", "y2", "r2"),
    low=(-0.5, -3.0),
    high=(0.5, 3.0),
    steps=20,
    states=safe_states,
    step=safe_step,
    rules=safe_rules,
    safe=frozenset({"in_river", "avoid_1", "avoid_2"}),
    starts=safe_starts,
    features=safe_features,
)


# ---------------------------------------------------------------------------- ship-track


def track_states(rng: np.random.Generator, n: int) -> Array:
    first = [rng.uniform(low, high, n) for low, high in ((-5, 8), (-1, 1), (0.6, 1.2))]
    hulls = any_hull(rng, n)
    calm = rng.random(n) < 0.5
    hulls[1] = np.where(calm, 0.2 * hulls[1], hulls[1])
    hulls[2] = np.where(calm, 0.05 * hulls[2], hulls[2])
    hulls[5] = np.where(calm, 0.02 * hulls[5], hulls[5])
    first[0] = np.where(calm, -5.0, first[0])
    return np.stack([*hulls, *first, rng.uniform(-1, 3.75, n)], 1)


def track_step(s: Array, u: Array) -> Array:
    for _ in range(2):
        off = s[:, 1] ** 2 - 0.09 > 0
        moved = hull(s, u, 0.075)
        moved[:, 9] = s[:, 9] - 0.075 * off
        s = moved
    return s


def track_rules(x: Array) -> dict[str, Array]:
    count, samples = x.shape[:2]
    river, avoid = np.full(count, np.inf), np.full(count, np.inf)
    for t in range(samples):
        river = np.minimum(river, 2 - np.abs(x[:, t, 1]))
        apart = paper.ball_distance(x[:, t, 0], x[:, t, 1], x[:, t, 6], x[:, t, 7])
        avoid = np.minimum(avoid, apart - x[:, t, 8])
    track = np.full(count, -np.inf)
    for t in range(samples):
        back = (0.3 - np.abs(x[:, t:, 1])).min(1)
        allowed = x[:, : t + 1, 9].min(1)
        track = np.maximum(track, np.minimum(back, allowed))
    return {"in_river": river, "avoid": avoid, "track": track}


def track_starts(rng: np.random.Generator, count: int) -> Array:
    def draw(n: int) -> Array:
        scenario = rng.integers(0, 4, n)
        far = [np.full(n, -5.0), rng.uniform(5, 8, n), rng.uniform(0, 5, n), rng.uniform(-1, 0, n)]
        steps = [rng.integers(low, high + 1, n) for low, high in ((1, 9), (10, 25), (8, 14), (5, 11))]
        pick = [scenario == i for i in range(4)]
        tau = np.select(pick, steps) * 0.15
        return np.stack(
            [*any_hull(rng, n), np.select(pick, far), np.zeros(n), rng.uniform(0.6, 1.2, n), tau], 1
        )

    def good(s: Array) -> Array:
        x, y, psi, ox, oy, r, tau = (s[:, i] for i in (0, 1, 2, 6, 7, 8, 9))
        bad = paper.ball_distance(x, y, ox, oy) <= r
        bad |= (y > 1.5) & (psi > 0)
        bad |= (y < -1.5) & (psi < 0)
        bad |= (ox > 0) & (ox < r + 0.5) & (np.abs(y - oy) < r)
        bad |= (ox > 0) & (ox < r + 1.5) & (np.abs(y - oy) < 0.3)
        bad |= (tau < 0.75 - 1e-9) & (np.abs(y) > 1.5)
        bad |= (y > 1.5) & (psi > 0.25)
        bad |= (y < -1.5) & (psi < -0.25)
        return ~bad

    return paper.kept(draw, good, count)


def track_features(s: Array) -> dict[str, Array]:
    return {
        "distance": paper.ball_distance(s[:, 0], s[:, 1], s[:, 6], s[:, 7]) - s[:, 8],
        "beside, close": np.abs(s[(s[:, 6] > 0) & (s[:, 6] < 2.7), 1]),
        "beside, short of time": np.abs(s[s[:, 9] < 0.7, 1]),
        "drift": s[:, 1] * np.sign(s[:, 2]),
        "allowance without obstacle": s[s[:, 6] == -5, 9],
        "allowance far": s[s[:, 6] > 5, 9],
        "allowance near": s[(s[:, 6] > 0) & (s[:, 6] < 5), 9],
    }


TRACK = paper.Benchmark(
    spec="ship_track",
    system="ship_track",
    columns=("x", "y", "psi", "u", "v", "r", "x1", "y1", "r1", "tau"),
    low=(-0.5, -3.0),
    high=(0.5, 3.0),
    steps=20,
    states=track_states,
    step=track_step,
    rules=track_rules,
    safe=frozenset({"in_river", "avoid"}),
    starts=track_starts,
    features=track_features,
)
BOTH = pytest.mark.parametrize("ship", [SAFE, TRACK], ids=["safe", "track"])


@BOTH
def test_rollouts_and_verdicts_are_the_benchmarks(ship: paper.Benchmark) -> None:
    assert max(paper.apart(ship, ship.task())) <= 1e-9


@BOTH
def test_the_kernel_gives_the_same(ship: paper.Benchmark) -> None:
    assert max(paper.kernel_apart(ship, ship.task())) <= 1e-9


@BOTH
@pytest.mark.parametrize(
    ("old", "new"),
    [("dt: 0.15 s", "dt: 0.151 s"), ("substeps: 2", "substeps: 1"), ("0.01 m/rad", "0.02 m/rad"),
     ("0.5 * rudder", "0.51 * rudder"), ("[3, 5], ", "[3, 5.1], "), ("[-0.3, 0.3]", "[-0.31, 0.31]"),
     ("psi: {unit: rad,   range: [-0.5, 0.5]", "psi: {unit: rad,   range: [-0.51, 0.5]")],
)  # fmt: skip
def test_a_changed_constant_of_the_system_is_noticed(ship: paper.Benchmark, old: str, new: str) -> None:
    assert paper.apart(ship, ship.task(system=((old, new),)), 200)[0] > 1e-4


def test_another_width_of_the_line_is_noticed_twice() -> None:
    changed = TRACK.task(spec=(("= 0.3", "= 0.31"),), system=(("gamma: 0.3 m", "gamma: 0.31 m"),))
    assert min(paper.apart(TRACK, changed, 200)[:2]) > 1e-3


@BOTH
def test_another_width_of_the_river_is_noticed(ship: paper.Benchmark) -> None:
    changed = ship.task(spec=(("= 4.0", "= 4.1"),), system=((" 4 m ", " 4.1 m "),))
    assert min(paper.apart(ship, changed, 200)[1:]) > 1e-3


@BOTH
def test_initial_states_have_the_benchmarks_distribution(ship: paper.Benchmark) -> None:
    assert paper.unlike(ship, ship.task()) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ship", "old", "new"),
    [(SAFE, "r1 + 1.5 m", "r1 + 1.7 m"), (SAFE, "0, 99)", "0, 70)"), (SAFE, "99 * step", "70 * step"),
     (TRACK, "randint(1, 9)", "randint(1, 10)"), (TRACK, "tau < 5 * dt", "tau < dt"),
     (TRACK, "r1 + 0.5 m", "r1 + 1.5 m"), (TRACK, "weight: 1", "weight: 2"),
     (TRACK, "not (y > 1.5 and psi > 0) ", "not (y > 1.9 and psi > 0) ")],
)  # fmt: skip
def test_another_distribution_is_noticed(ship: paper.Benchmark, old: str, new: str) -> None:
    if new == "weight: 2":  # of one scenario alone
        old, new = (
            "    - {<<: *base, name: obstacle_far, ",
            "    - {<<: *base, name: obstacle_far, weight: 2, ",
        )
    assert paper.unlike(ship, ship.task(system=((old, new),)))


def test_allowances_are_whole_steps_and_short_ones_stay_off_the_banks() -> None:
    states = TRACK.task().sample(20_000, seed=3, dtype=torch.float64).numpy()
    steps, wide = states[:, 9] / 0.15, np.abs(states[:, 1]) > 1.5
    assert np.abs(steps - np.rint(steps)).max() < 1e-9
    assert not wide[np.rint(steps) < 5].any()
    assert wide[np.rint(steps) == 5].any()
