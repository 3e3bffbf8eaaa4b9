"""`reach_n_avoid.stl` and `maze.yaml` against the facts of the benchmark, written out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import paper
from helpers.paper import Array

pytestmark = pytest.mark.apart

DT, WIDTH, V_MAX, H, LEVEL, R = 0.2, 5.0, 5.0, 0.5, 2.5, 0.4


def states(rng: np.random.Generator, n: int) -> Array:
    def level() -> list[Array]:
        width = rng.uniform(2, 4, n)
        left = rng.uniform(0, 5 - width)
        goal = np.where(rng.random(n) < 0.3, -1.0, rng.uniform(0.4, 4.6, n))
        return [left, width, goal]

    return np.stack(
        [rng.uniform(0.1, 4.9, n), rng.uniform(-5, 5, n), rng.uniform(-2.5, 0, n), *level(), *level()], 1
    )


def step(s: Array, u: Array) -> Array:
    x, v, dy = s[:, 0], s[:, 1], s[:, 2]
    moved = s.copy()
    moved[:, 0] = np.clip(x + v * DT, 0.1, 4.9)
    moved[:, 1] = np.clip(v + u[:, 0] * DT, -5, 5)
    moved[:, 2] = dy + 1.0 * DT
    return moved


def rules(x: Array) -> dict[str, Array]:
    found = {}
    for level in (0, 1):
        left, width, goal = (x[:, 0, 3 + 3 * level + i] for i in range(3))
        clear, reached = np.full(len(x), np.inf), np.full(len(x), -np.inf)
        for t in range(x.shape[1]):
            at, dy = x[:, t, 0], x[:, t, 2] - 2.5 * level
            beside = np.maximum(-np.minimum(dy + 0.5, -dy), (left + width - at) * (left - at))
            clear = np.minimum(clear, beside)
            reached = np.maximum(reached, 0.16 - (at - goal) ** 2 - (dy + 0.25) ** 2)
        found[f"goal_{level}"] = np.maximum(-goal, reached)
        found[f"level_{level}"] = clear
    return found


def level(rng: np.random.Generator, n: int) -> tuple[Array, Array, Array]:
    width = rng.uniform(2, 4, n)
    left = 2.5 + rng.uniform(-1, 1, n) * (5 - width) / 2 * 1.0 - width / 2
    left = np.where(left < 0.1, 0.0, left)
    left = np.where(5 - width - left < 0.1, 5 - width, left)
    west = left * rng.uniform(0.3, 0.7, n)
    west = np.where((west < 0.4) | (left - west < 0.4), -1.0, west)
    east = left + width + (5 - width - left) * rng.uniform(0.3, 0.7, n)
    east = np.where((5 - east < 0.4) | (east - (left + width) < 0.4), -1.0, east)
    side = rng.integers(0, 3, n)
    return left, width, np.select([side == 0, side == 1], [west, east], -1.0)


def starts(rng: np.random.Generator, count: int) -> Array:
    def draw(n: int) -> Array:
        v, dy = rng.uniform(-5, 5, n), rng.uniform(-2.5, 0, n)
        (x0, l0, g0), (x1, l1, g1) = level(rng, n), level(rng, n)
        share = rng.random(n)
        rest = np.floor((-dy - 0.5) / 0.2) - 1
        lm, rm = -v * 0.2 + rest * (-5) * 0.2, -v * 0.2 + rest * 5 * 0.2
        p0, p1 = np.clip(lm, 0, 5), np.clip(x0 + rm, 0, 5)
        p2, p3 = np.clip(x0 + l0 + lm, 0, 5), np.clip(5 + rm, 0, 5)
        side = rng.integers(0, 2, n)
        side = np.where(((p0 == 0) & (p1 == 0)) | (x0 == 0), 1, side)
        side = np.where(((p2 == 5) & (p3 == 5)) | (x0 == 5 - l0), 0, side)
        x = np.where(side == 0, share * p0 + (1 - share) * p1, share * p2 + (1 - share) * p3)
        near = share * np.clip(g0 - 0.4 + lm, 0, 5) + (1 - share) * np.clip(g0 + 0.4 + rm, 0, 5)
        x = np.where(g0 > 0, near, x)
        return np.stack([x, v, dy, x0, l0, g0, x1, l1, g1], 1)

    def good(s: Array) -> Array:
        x, v, dy, left, width = s[:, :5].T
        now = (dy >= -0.5) & (left <= x) & (x <= left + width)
        later = (dy + 0.2 >= -0.5) & (left <= x + v * 0.2) & (x + v * 0.2 <= left + width)
        return ~now & ~later

    return paper.kept(draw, good, count)


def features(s: Array) -> dict[str, Array]:
    return {
        "from the goal": (s[:, 0] - s[:, 5])[s[:, 5] > 0],
        "into the gap": s[:, 0] - s[:, 3],
        "right gap": 5 - s[:, 3] - s[:, 4],
        "speed where low": s[s[:, 2] < -1.5, 1],
        "goal of the second": s[:, 8] - s[:, 6],
        "side": np.sign(s[:, 0] - s[:, 3] - s[:, 4] / 2) * (s[:, 2] + 3),
    }


MAZE = paper.Benchmark(
    spec="reach_n_avoid",
    system="maze",
    columns=("x", "v", "dy", "x0", "l0", "g0", "x1", "l1", "g1"),
    low=(-40.0,),
    high=(40.0,),
    steps=25,
    states=states,
    step=step,
    rules=rules,
    safe=frozenset({"level_0", "level_1"}),
    starts=starts,
    features=features,
)


def test_rollouts_and_verdicts_are_the_benchmarks() -> None:
    assert max(paper.apart(MAZE, MAZE.task())) <= 1e-9


def test_the_kernel_gives_the_same() -> None:
    assert max(paper.kernel_apart(MAZE, MAZE.task())) <= 1e-9


@pytest.mark.parametrize(
    ("old", "new"),
    [("dt: 0.2 s", "dt: 0.21 s"), ("vy:    1 m/s", "vy:    1.01 m/s"), ("[0.1, 4.9]", "[0.1, 4.95]"),
     ("vmax:  5", "vmax:  5.1"), ("v:  a", "v:  0.99 * a")],
)  # fmt: skip
def test_a_changed_constant_of_the_system_is_noticed(old: str, new: str) -> None:
    assert paper.apart(MAZE, MAZE.task(system=((old, new),)), 200)[0] > 1e-3


@pytest.mark.parametrize(("name", "value"), [("h", "0.5"), ("d", "2.5"), ("r", "0.4")])
def test_a_changed_constant_of_the_specification_is_noticed(name: str, value: str) -> None:
    changed = (f"const {name} [m] = {value}", f"const {name} [m] = {value}1")
    yaml = next(old for old in (f"{name}:     {value} m", f"{name}: {value} m") if old in text())
    task = MAZE.task(spec=(changed,), system=((yaml, yaml.replace(value, f"{value}1")),))
    assert paper.apart(MAZE, task, 200)[1] > 1e-3


def text() -> str:
    return (paper.ROOT / "examples" / "maze.yaml").read_text()


def test_initial_states_have_the_benchmarks_distribution() -> None:
    assert paper.unlike(MAZE, MAZE.task()) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new"),
    [("uniform(0.3, 0.7)", "uniform(0.3, 0.8)"), ("- 1        # steps", "- 2        # steps"),
     ("coin: randint(0, 1)", "coin: 0"), ("sliver: 0.1", "sliver: 0.3")],
)  # fmt: skip
def test_another_distribution_is_noticed(old: str, new: str) -> None:
    assert paper.unlike(MAZE, MAZE.task(system=((old, new),)))
