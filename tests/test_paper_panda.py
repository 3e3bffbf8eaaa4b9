"""`manipulation.stl` and `panda.yaml` against the facts of the benchmark, written out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers import paper
from helpers.paper import Array

pytestmark = pytest.mark.apart

LOW = np.radians([-166, -101, -166, -176, -166, -1, -166])
HIGH = np.radians([166, 101, 166, -4, 166, 215, 166])
POST = np.array([0.3, 0.3, 0.5])
ORIGINS = (
    (0, 0, 0.333),
    (0, 0, 0),
    (0, -0.316, 0),
    (0.0825, 0, 0),
    (-0.0825, 0.384, 0),
    (0, 0, 0),
    (0.088, 0, 0),
)
ROLLS = (0, -90, 90, 90, -90, 90, 90)  # degrees about x, joint by joint
FLANGE = np.array([0, 0, 0.107, 1.0])


def flange(q: Array) -> Array:
    """Product of homogeneous transforms, (…, 7) -> (…, 3)."""
    shape = q.shape[:-1]
    pose = np.broadcast_to(np.eye(4), (*shape, 4, 4))
    for joint, (origin, roll) in enumerate(zip(ORIGINS, ROLLS, strict=True)):
        a = math.radians(roll)
        fixed = np.eye(4)
        fixed[1:3, 1:3] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]
        fixed[:3, 3] = origin
        turn = np.zeros((*shape, 4, 4))
        turn[..., 0, 0] = turn[..., 1, 1] = np.cos(q[..., joint])
        turn[..., 1, 0] = np.sin(q[..., joint])
        turn[..., 0, 1] = -turn[..., 1, 0]
        turn[..., 2, 2] = turn[..., 3, 3] = 1
        pose = pose @ fixed @ turn
    return (pose @ FLANGE)[..., :3]


def states(rng: np.random.Generator, n: int) -> Array:
    q = rng.uniform(LOW, HIGH, (n, 7))
    q = np.where(rng.random((n, 1)) < 0.5, LOW + (HIGH - LOW) * (0.5 + 0.2 * (q - LOW) / (HIGH - LOW)), q)
    goal = np.where(rng.random((n, 1)) < 0.5, flange(q) + rng.normal(0, 0.1, (n, 3)), box(rng, n))
    return np.column_stack([q, goal])


def box(rng: np.random.Generator, n: int) -> Array:
    return rng.uniform((-0.5, -0.5, 0.2), (0.5, 0.5, 0.8), (n, 3))


def step(s: Array, u: Array) -> Array:
    moved = s.copy()
    moved[:, :7] += 0.1 * u
    return moved


def rules(x: Array) -> dict[str, Array]:
    reach = np.full(len(x), -np.inf)
    clear, joints = np.full(len(x), np.inf), np.full(len(x), np.inf)
    for t in range(x.shape[1]):
        q, goal = x[:, t, :7], x[:, t, 7:]
        place = flange(q)
        reach = np.maximum(reach, 0.1 - np.sqrt(((place - goal) ** 2).sum(1)))
        clear = np.minimum(clear, np.sqrt(((place - POST) ** 2).sum(1)) - 0.2)
        joints = np.minimum(joints, np.minimum(q - LOW, HIGH - q).min(1))
    return {"reach": reach, "clear": clear, "joints": joints}


def starts(rng: np.random.Generator, count: int) -> Array:
    def draw(n: int) -> Array:
        return np.column_stack([rng.uniform(LOW, HIGH, (n, 7)), box(rng, n)])

    def good(s: Array) -> Array:
        return (np.linalg.norm(flange(s[:, :7]) - POST, axis=1) > 0.2) & (
            np.linalg.norm(s[:, 7:] - POST, axis=1) > 0.2
        )

    return paper.kept(draw, good, count)


def features(s: Array) -> dict[str, Array]:
    place = flange(s[:, :7])
    return {
        "from the post": np.linalg.norm(place - POST, axis=1),
        "goal from the post": np.linalg.norm(s[:, 7:] - POST, axis=1),
        "from the goal": np.linalg.norm(place - s[:, 7:], axis=1),
        "height": place[:, 2],
    }


PANDA = paper.Benchmark(
    spec="manipulation",
    system="panda",
    columns=(*(f"q[{i}]" for i in range(7)), *(f"goal[{i}]" for i in range(3))),
    low=(-4.0,) * 7,
    high=(4.0,) * 7,
    steps=10,
    states=states,
    step=step,
    rules=rules,
    safe=frozenset({"clear", "joints"}),
    starts=starts,
    features=features,
)


def test_rollouts_and_verdicts_are_the_benchmarks() -> None:
    assert max(paper.apart(PANDA, PANDA.task())) <= 1e-9


def test_the_kernel_gives_the_same() -> None:
    assert max(paper.kernel_apart(PANDA, PANDA.task())) <= 1e-9


@pytest.mark.parametrize(
    ("old", "new"), [("dt: 0.1 s", "dt: 0.11 s"), ("q: dq", "q: 1.01 * dq"), ("panda_link8", "panda_link7")]
)
def test_a_changed_constant_of_the_system_is_noticed(old: str, new: str) -> None:
    assert max(paper.apart(PANDA, PANDA.task(system=((old, new),)), 300)[:2]) > 1e-3


@pytest.mark.parametrize(
    ("spec", "system"),
    [((("r_g   [m] = 0.1", "r_g   [m] = 0.11"),), (("r_g:   0.1 m", "r_g:   0.11 m"),)),
     ((("r_o   [m] = 0.2", "r_o   [m] = 0.21"),), (("r_o:   0.2 m", "r_o:   0.21 m"),)),
     ((("215 deg", "214 deg"),), (("215 deg", "214 deg"),)), ((("0.3, 0.3, 0.5", "0.3, 0.31, 0.5"),), ())],
)  # fmt: skip
def test_a_changed_constant_of_the_specification_is_noticed(
    spec: paper.Changes, system: paper.Changes
) -> None:
    assert paper.apart(PANDA, PANDA.task(spec, system))[1] > 1e-3


def test_initial_states_have_the_benchmarks_distribution() -> None:
    assert paper.unlike(PANDA, PANDA.task()) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new"),
    [("norm(ee(q) - post) > r_o", "q[0] < 9"), ("- norm(goal - post) > r_o", ""),
     ("q: uniform(q_min", "q: uniform(0.9 * q_min"), ("goal: uniform([-0.5", "goal: uniform([-0.45")],
)  # fmt: skip
def test_another_distribution_is_noticed(old: str, new: str) -> None:
    assert paper.unlike(PANDA, PANDA.task(system=((old, new),)))
