"""The single environment passes gymnasium's checker, and is rewarded by the specification."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

import stlc  # noqa: E402
import stlc.gym  # noqa: E402
from stlc.diagnostics import UsageError  # noqa: E402

ROOT = Path(__file__).parents[2]
SPECS = ("traffic", "reach_n_avoid", "ship_safe", "ship_track", "navigation", "manipulation")


@pytest.mark.apart
@pytest.mark.parametrize("world", [False, True])
@pytest.mark.parametrize(("name", "normalised"), [*((name, False) for name in SPECS), (SPECS[0], True)])
@pytest.mark.filterwarnings("ignore:.*(render|symmetric).*:UserWarning")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_it_passes_the_checker(name: str, normalised: bool, world: bool) -> None:
    env = stlc.gym.make(ROOT / "specs" / f"{name}.stl", normalised=normalised, world=world)
    for space in (env.action_space, env.observation_space):
        assert np.isfinite(space.low).all()
        assert np.isfinite(space.high).all()
        assert not normalised or (space.low == -1.0).all()
    check_env(env, skip_render_check=True)


def test_normalised_actions_and_observations_are_the_others_scaled() -> None:
    path = ROOT / "specs" / "ship_safe.stl"
    plain, unit = stlc.gym.make(path), stlc.gym.make(path, normalised=True)
    seen = [env.reset(seed=3)[0] for env in (plain, unit)]
    low, high = plain.observation_space.low, plain.observation_space.high
    for _ in range(5):
        np.testing.assert_allclose(seen[1], 2.0 * (seen[0] - low) / (high - low) - 1.0, atol=1e-5)
        plain_step = plain.step(np.array([0.25, -1.5], dtype=np.float32))
        unit_step = unit.step(np.array([0.5, -0.5], dtype=np.float32))
        assert plain_step[4]["state"].tolist() == unit_step[4]["state"].tolist()
        seen = [plain_step[0], unit_step[0]]


def test_what_is_left_of_an_episode_is_observed_where_it_ends() -> None:
    path = ROOT / "specs" / "ship_safe.stl"
    env, longer = stlc.gym.make(path), stlc.gym.make(path, steps=100)
    width = env.task.system.observed_count
    assert env.observation_space.shape == (width + 1,)
    assert longer.observation_space.shape == (width,)
    assert stlc.gym.make(path, time=False).observation_space.shape == (width,)
    first, _ = env.reset(seed=0)
    times = [first[-1], *(env.step(np.zeros(2, dtype=np.float32))[0][-1] for _ in range(20))]
    np.testing.assert_allclose(times, np.arange(21) / 20, atol=1e-6)


def test_actuators_get_the_action_where_a_feedback_lies_beneath_plans(tmp_path: Path) -> None:
    (tmp_path / "u.yaml").write_text(
        "stlc: 1\nname: u\ntime: {dt: 0.1 s, horizon: 10 steps}\nstate: {x: {unit: m, range: [-1, 1]}}\n"
        "control: {u: {unit: m/s, range: [-6, 6]}}\nflow: {x: '4 / (1 s) * x + u'}\n"
        "init: {mixture: [{draw: {x: 0.5}}]}\npolicy: {feedback: lqr}\n"
    )
    (tmp_path / "u.stl").write_text("state signal x [m]\nrequire r: always[0, T] x < 1 m\n")
    env = stlc.gym.make(tmp_path / "u.stl", tmp_path / "u.yaml")
    assert env.action_space.high.tolist() == [6.0]
    env.reset(seed=0)
    *_, info = env.step(np.array([-2.0], dtype=np.float32))
    assert info["state"].tolist() == pytest.approx([0.5])


def test_a_large_value_that_stays_has_a_normalised_one(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text(
        "stlc: 1\nname: p\ntime: {dt: 0.1 s, horizon: 5 steps}\nstate: {x: {}, p: {unit: Pa}}\n"
        "control: {u: {range: [-1, 1]}}\nflow: {x: u}\n"
        "init: {mixture: [{draw: {x: 0.5, p: 101325 Pa}}]}\n"
    )
    (tmp_path / "p.stl").write_text("state signal x\nrequire r: always[0, T] x < 1\n")
    files = tmp_path / "p.stl", tmp_path / "p.yaml"
    plain, unit = stlc.gym.make(*files), stlc.gym.make(*files, normalised=True)
    assert (plain.observation_space.low < plain.observation_space.high).all()
    assert abs(plain.reset(seed=0)[0][1] - 101325) < 0.01
    assert abs(unit.reset(seed=0)[0][1]) < 0.2


@pytest.mark.parametrize("world", [False, True])
def test_dense_rewards_sum_to_the_robustness_of_the_episode(world: bool) -> None:
    env = stlc.gym.make(ROOT / "specs" / "ship_safe.stl", reward="dense", world=world)
    _, first = env.reset(seed=4)
    earned, states, actions, over = 0.0, [first["state"]], [], False
    while not over:
        action = env.action_space.sample()
        _, reward, over, truncated, info = env.step(action)
        assert not truncated
        earned += reward
        states.append(info["state"])
        actions.append(action)
    assert len(actions) == env.task.horizon
    verdict = stlc.Monitor(stlc.load(ROOT / "specs" / "ship_safe.stl")).check(
        {name: np.array(states)[:, i] for i, name in enumerate(env.task.system.names)}
    )
    rho = float(verdict.robustness)
    assert info["rho"] == pytest.approx(rho, abs=1e-9)
    assert earned == pytest.approx(rho - first["rho"], abs=1e-9)
    assert info["satisfied"] == (rho >= -1e-6)


@pytest.mark.parametrize("world", [False, True])
def test_robustness_comes_last_and_seeds_repeat(world: bool) -> None:
    env = stlc.gym.make(ROOT / "specs" / "reach_n_avoid.stl", world=world)
    action = np.zeros(1, dtype=np.float32)
    runs = []
    for _ in range(2):
        env.reset(seed=11)
        steps = [env.step(action) for _ in range(env.task.horizon)]
        runs.append(np.array([step[0] for step in steps]))
        assert [step[1] for step in steps[:-1]] == [0.0] * (len(steps) - 1)
        assert steps[-1][1] == steps[-1][4]["rho"] != 0.0
        with pytest.raises(UsageError, match="over"):
            env.step(action)
    assert np.array_equal(*runs)


def test_a_long_episode_goes_on_in_the_world_and_is_truncated() -> None:
    env = stlc.gym.make(ROOT / "specs" / "ship_track.stl", steps=60)
    env.reset(seed=0)
    for k in range(60):
        _, _, terminated, truncated, _ = env.step(np.zeros(2, dtype=np.float32))
        assert not terminated
        assert truncated == (k == 59)


def test_it_can_begin_anywhere() -> None:
    env = stlc.gym.make(ROOT / "specs" / "ship_track.stl")
    state = env.task.sample(1, seed=3)[0].numpy()
    _, info = env.reset(seed=1, options={"state": state})
    assert info["state"] == pytest.approx(state)


def test_what_cannot_be_made_is_said() -> None:
    with pytest.raises(UsageError, match="dens"):
        stlc.gym.make(ROOT / "specs" / "traffic.stl", reward="dens")  # type: ignore[arg-type]
    with pytest.raises(UsageError):
        stlc.gym.make(ROOT / "specs" / "nothing.stl")


def test_the_rest_of_stlc_does_without_gymnasium() -> None:
    code = "import sys, stlc, stlc.cli.framework.app; sys.exit('gymnasium' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=ROOT).returncode == 0


@pytest.mark.parametrize("reward", ["task", "accuracy"])
def test_rewards_are_those_of_many_environments(reward: str) -> None:
    path = ROOT / "specs" / "traffic.stl"
    single = stlc.gym.make(path, reward=reward)  # type: ignore[arg-type]
    many = stlc.gym.make_vec(path, 3, reward=reward)  # type: ignore[arg-type]
    state = single.task.sample(1, seed=8)[0].numpy()
    ours, _ = single.reset(seed=0, options={"state": state})
    theirs, _ = many.reset(seed=0, options={"state": state})
    action = np.array([2.0], dtype=np.float32)
    for k in range(single.steps):
        np.testing.assert_allclose(ours, theirs[1], atol=1e-5)
        ours, reward_here, over, _, info = single.step(action)
        theirs, rewards, done, _, infos = many.step(np.tile(action, (3, 1)))
        assert reward_here == pytest.approx(rewards[1], abs=1e-4)
        assert over == done.all() == (k == single.steps - 1)
    end = infos["final_info"]
    assert info["rho"] == pytest.approx(end["rho"][1], abs=1e-9)
    assert info["robustness"] == pytest.approx(
        {name: end["robustness"][name][1] for name in info["robustness"]}, abs=1e-9
    )


def test_the_world_goes_beyond_the_model() -> None:
    path = ROOT / "specs" / "traffic.stl"
    with pytest.raises(UsageError, match="at most 25 steps"):
        stlc.gym.make(path, steps=26, world=False)
    with pytest.raises(UsageError, match="shape"):
        stlc.gym.make(path).reset(options={"state": [1.0, 2.0]})


def test_registered_environments_are_made_by_name() -> None:
    env = gymnasium.make("stlc/traffic-v0", reward="accuracy", normalised=True)
    assert env.unwrapped.reward == "accuracy"
    env.reset(seed=1)
    env.step(env.action_space.sample())
    assert {f"stlc/{name}-v0" for name in SPECS} == {key for key in gymnasium.registry if "stlc/" in key}
