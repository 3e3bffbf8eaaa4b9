"""Environments can be copied and pickled in the middle of an episode, refuse NaN, and give pictures."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

import stlc.gym  # noqa: E402
from stlc.diagnostics import UsageError  # noqa: E402

SPECS = Path(__file__).parents[2] / "specs"


def played(env: Any, steps: int) -> list[tuple[Any, float]]:
    """Observations and rewards under drawn actions, over the end of an episode."""
    found = []
    for _ in range(steps):
        seen, reward, over, cut, _ = env.step(env.action_space.sample())
        found.append((seen, reward))
        if not isinstance(over, np.ndarray) and (over or cut):
            found.append((env.reset()[0], 0.0))
    return found


def agree(one: Any, other: Any, steps: int) -> None:
    for a, b in zip(played(one, steps), played(other, steps), strict=True):
        np.testing.assert_array_equal(a[0], b[0])
        np.testing.assert_array_equal(a[1], b[1])


@pytest.mark.apart
@pytest.mark.parametrize(("name", "world"), [("ship_safe", False), ("ship_safe", True), ("traffic", True)])
def test_copies_and_pickles_continue_the_episode(name: str, world: bool) -> None:
    env = stlc.gym.make(SPECS / f"{name}.stl", world=world)
    env.reset(seed=0)
    env.action_space.seed(0)
    played(env, 3)
    pickled = pickle.dumps(env)
    copied, third = copy.deepcopy(env), pickle.loads(pickled)
    assert copied.task is env.task
    agree(env, copied, 40)
    stlc.gym.make(SPECS / f"{name}.stl", world=world)
    agree(copy.deepcopy(env), pickle.loads(pickle.dumps(env)), 5)
    fresh = pickle.loads(pickled)
    agree(fresh, third, 40)


def test_copies_of_many_environments_continue_their_episodes() -> None:
    env = stlc.gym.make_vec(SPECS / "ship_safe.stl", 3)
    env.reset(seed=0)
    env.action_space.seed(0)
    played(env, 3)
    pickled = pickle.dumps(env)
    agree(env, copy.deepcopy(env), 0)
    copied = copy.deepcopy(env)
    agree(env, copied, 40)
    agree(pickle.loads(pickled), pickle.loads(pickled), 40)


@pytest.mark.apart
@pytest.mark.parametrize("world", [False, True])
def test_a_pickle_opens_in_another_process(world: bool, tmp_path: Path) -> None:
    env = stlc.gym.make(SPECS / "traffic.stl", world=world)
    env.reset(seed=0)
    env.action_space.seed(0)
    (tmp_path / "env.pickle").write_bytes(pickle.dumps(env))
    program = "import pickle, sys; e = pickle.load(open(sys.argv[1], 'rb'))\n"
    program += "print(e.step(e.action_space.sample())[0].tolist())"
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "env.pickle")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == str(env.step(env.action_space.sample())[0].tolist())


def test_nan_actions_are_refused() -> None:
    env = stlc.gym.make(SPECS / "ship_safe.stl")
    env.reset(seed=0)
    with pytest.raises(UsageError, match="NaN at index 1"):
        env.step(np.array([0.0, np.nan], dtype=np.float32))
    many = stlc.gym.make_vec(SPECS / "ship_safe.stl", 3)
    many.reset(seed=0)
    with pytest.raises(UsageError, match="NaN at index 2, 0"):
        many.step(np.array([[0.0, 0.0], [0.0, 0.0], [np.nan, 0.0]], dtype=np.float32))
    assert np.isfinite(env.step(np.array([0.0, np.inf], dtype=np.float32))[0]).all()


@pytest.mark.parametrize("world", [False, True])
def test_pictures_show_the_present_instant(world: bool) -> None:
    env = gymnasium.make("stlc/traffic-v0", render_mode="rgb_array", world=world)
    env.reset(seed=0)
    first = env.render()
    assert first.dtype == np.uint8
    for _ in range(8):
        env.step(env.action_space.sample())
    last = env.render()
    assert last.shape == first.shape == (*first.shape[:2], 3)
    assert (last != first).any()
    assert env.metadata["render_fps"] >= 1


def test_pictures_of_many_environments_are_one_each() -> None:
    env = gymnasium.make_vec("stlc/ship_safe-v0", 2, render_mode="rgb_array")
    env.reset(seed=0)
    one, other = env.render()
    assert one.shape[2] == other.shape[2] == 3


def test_where_there_are_no_pictures_it_is_said() -> None:
    env = stlc.gym.make(SPECS / "traffic.stl")
    env.reset(seed=0)
    with pytest.raises(UsageError, match="render_mode"):
        env.render()
    with pytest.raises(UsageError, match="human"):
        stlc.gym.make(SPECS / "traffic.stl", render_mode="human")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="no episode"):
        stlc.gym.make(SPECS / "traffic.stl", render_mode="rgb_array").render()
