"""Stable-Baselines3 trains on the environments."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from gymnasium.vector import AutoresetMode

from stlc.diagnostics import UsageError
from stlc.gym import make_vec
from stlc.gym.sb3 import SB3VecEnv


def test_the_end_of_an_episode_is_told() -> None:
    env = SB3VecEnv(make_vec("specs/traffic.stl", 3, reward="task", normalised=True))
    env.seed(4)
    first = env.reset()
    env.seed(4)
    assert np.array_equal(first, env.reset())
    assert env.reset_infos[0]["state"].shape == (7,)
    action, earned = np.full((3, 1), 0.5, dtype=np.float32), np.zeros(3)
    for k in range(25):
        seen, reward, done, infos = env.step(action)
        earned += reward
        assert done.tolist() == [k == 24] * 3
        assert len(infos) == 3
        assert infos[0] == {} or k == 24
    assert [info["episode"]["r"] for info in infos] == pytest.approx(earned.tolist(), rel=1e-5)
    assert infos[1]["terminal_observation"][-1] == 1.0
    assert infos[1]["is_success"] == (infos[1]["rho"] >= -1e-6)
    assert seen[0, -1] == -1.0
    assert env.get_attr("steps") == [25] * 3
    assert env.env_is_wrapped(object) == [False] * 3
    env.close()


def test_another_mode_is_refused() -> None:
    with pytest.raises(UsageError, match="terminal_observation"):
        SB3VecEnv(make_vec("specs/traffic.stl", 2, autoreset=AutoresetMode.NEXT_STEP))
