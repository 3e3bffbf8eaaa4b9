"""Many environments at once keep gymnasium's rules of vector environments."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.vector import AutoresetMode  # noqa: E402
from gymnasium.wrappers.vector import RecordEpisodeStatistics  # noqa: E402

import stlc  # noqa: E402
import stlc.gym  # noqa: E402
from stlc.diagnostics import UsageError  # noqa: E402

ROOT = Path(__file__).parents[2]
SPECS = ROOT / "specs"


@pytest.mark.apart
@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("name", stlc.gym.BENCHMARKS)
def test_what_it_gives_is_in_its_spaces(name: str, normalised: bool) -> None:
    env = gymnasium.make_vec(f"stlc/{name}-v0", 5, reward="task", normalised=normalised)
    assert env.num_envs == 5
    assert env.observation_space.shape == (5, *env.single_observation_space.shape)
    env.action_space.seed(0)
    seen, info = env.reset(seed=3)
    ends = 0
    for _ in range(env.unwrapped.steps + 2):
        assert env.observation_space.contains(seen)
        assert env.single_observation_space.contains(seen[0])
        assert info["state"].shape == (5, len(env.unwrapped.task.system.names))
        seen, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert (reward.shape, reward.dtype) == ((5,), np.float64)
        assert terminated.dtype == truncated.dtype == np.bool_
        assert not truncated.any()
        ends += int(terminated.all())
        assert ("final_info" in info) == terminated.all() == terminated.any()
    assert ends == 1


def played(env, actions, **options):
    """Observations, rewards, ends and infos from a reset on."""
    rows = [(*env.reset(**options), None, None)]
    for action in actions:
        seen, reward, terminated, _, info = env.step(action)
        rows.append((seen, info, reward, terminated))
    return rows


def actions_of(env, count: int, seed: int = 0) -> list[np.ndarray]:
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


def test_the_same_seed_gives_the_same_episodes() -> None:
    env = stlc.gym.make_vec(SPECS / "traffic.stl", 3)
    actions = actions_of(env, 60)
    first, again, other = (played(env, actions, seed=seed) for seed in (5, 5, 6))
    for ours, theirs in zip(first, again, strict=True):
        assert np.array_equal(ours[0], theirs[0])
        assert ours[2] is None or np.array_equal(ours[2], theirs[2])
    assert not np.array_equal(first[0][0], other[0][0])
    assert not np.array_equal(env.reset()[0], env.reset()[0])


def test_final_observations_come_with_the_next_ones() -> None:
    same = stlc.gym.make_vec(SPECS / "ship_safe.stl", 4)
    later = stlc.gym.make_vec(SPECS / "ship_safe.stl", 4, autoreset=AutoresetMode.NEXT_STEP)
    assert same.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert later.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    actions = actions_of(same, 21)
    ours, theirs = (played(env, actions[:count], seed=1) for env, count in ((same, 20), (later, 21)))
    end = ours[-1][1]
    final = np.stack(list(end["final_obs"]))
    assert end["final_obs"].dtype == object
    assert end["_final_obs"].all()
    assert np.array_equal(final, theirs[20][0])
    assert final[:, -1].tolist() == [1.0] * 4
    assert np.array_equal(ours[-1][0], theirs[21][0])
    assert ours[-1][0][:, -1].tolist() == [0.0] * 4
    assert theirs[20][3].all()
    assert not theirs[21][3].any()
    assert theirs[21][2].tolist() == [0.0] * 4
    assert np.array_equal(end["final_info"]["rho"], theirs[20][1]["rho"])
    assert np.array_equal(end["state"], theirs[21][1]["state"])


def test_its_infos_have_the_form_of_gymnasiums_own() -> None:
    ours = stlc.gym.make_vec(SPECS / "traffic.stl", 2)
    theirs = gymnasium.vector.SyncVectorEnv(
        [lambda: stlc.gym.make(SPECS / "traffic.stl")] * 2, autoreset_mode=AutoresetMode.SAME_STEP
    )
    actions = actions_of(ours, ours.steps)
    own, other = (played(env, actions, seed=0)[-1] for env in (ours, theirs))

    def form(info):
        if isinstance(info, dict):
            return {key: form(value) for key, value in info.items()}
        return info.dtype, info.shape

    assert form(own[1]) == form(other[1])
    assert own[2].dtype == other[2].dtype


def test_the_reward_is_the_robustness_of_the_trace() -> None:
    env = stlc.gym.make_vec(SPECS / "navigation.stl", 3)
    start = env.task.sample(3, seed=4).numpy()
    rows = played(env, actions_of(env, env.steps), options={"state": start})
    np.testing.assert_allclose(rows[0][1]["state"], start, atol=1e-6)
    end = rows[-1][1]["final_info"]
    states = np.stack([row[1]["state"] for row in rows[:-1]] + [end["state"]])
    monitor = stlc.Monitor(stlc.load(SPECS / "navigation.stl"))
    for i in range(3):
        columns = {name: states[:, i, j] for j, name in enumerate(env.task.system.names)}
        verdict = monitor.check(columns)
        assert rows[-1][2][i] == pytest.approx(float(verdict.robustness), abs=1e-5)
        assert end["rho"][i] == pytest.approx(float(verdict.robustness), abs=1e-9)
        assert end["satisfied"][i] == (float(verdict.robustness) >= -1e-6)
        for name, value in end["robustness"].items():
            assert name.startswith("_") or value.shape == (3,)


def test_gymnasiums_wrapper_records_returns() -> None:
    env = RecordEpisodeStatistics(stlc.gym.make_vec(SPECS / "traffic.stl", 4, reward="accuracy"))
    rows = played(env, actions_of(env, 25), seed=0)
    assert rows[-1][1]["episode"]["r"].tolist() == rows[-1][2].tolist()
    assert set(rows[-1][2].tolist()) <= {0.0, 100.0}


def test_the_time_may_be_hidden_and_plans_lie_above_feedback(tmp_path: Path) -> None:
    plain, timeless = (stlc.gym.make_vec(SPECS / "traffic.stl", 2, time=time) for time in (True, False))
    seen = [env.reset(seed=2)[0] for env in (plain, timeless)]
    assert np.array_equal(seen[0][:, :-1], seen[1])
    (tmp_path / "u.yaml").write_text(
        "stlc: 1\nname: u\ntime: {dt: 0.1 s, horizon: 10 steps}\nstate: {x: {unit: m, range: [-1, 1]}}\n"
        "control: {u: {unit: m/s, range: [-6, 6]}}\nflow: {x: '4 / (1 s) * x + u'}\n"
        "init: {mixture: [{draw: {x: 0.5}}]}\npolicy: {feedback: lqr}\ntrain: {reward: u / (1 m/s)}\n"
    )
    (tmp_path / "u.stl").write_text("state signal x [m]\nrequire r: always[0, T] x < 1 m\n")
    env = stlc.gym.make_vec(tmp_path / "u.stl", 2, tmp_path / "u.yaml", reward="task")
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.array([[-2.0], [9.0]], dtype=np.float32))
    assert info["state"][:, 0] == pytest.approx([0.5, 1.3])
    assert reward.tolist() == pytest.approx([-2.0, 6.0])


def test_what_cannot_be_is_said() -> None:
    path = SPECS / "traffic.stl"
    env = stlc.gym.make_vec(path, 2)
    with pytest.raises(UsageError, match="no episode has begun"):
        env.step(np.zeros((2, 1), dtype=np.float32))
    env.reset()
    with pytest.raises(UsageError, match="shape"):
        env.step(np.zeros(2, dtype=np.float32))
    with pytest.raises(UsageError, match="one stream"):
        env.reset(seed=[1, 2])  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="together"):
        env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(UsageError, match="no reward `dense`"):
        stlc.gym.make_vec(path, 2, reward="dense")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="by themselves"):
        stlc.gym.make_vec(path, 2, autoreset=AutoresetMode.DISABLED)
    with pytest.raises(UsageError, match="0 environments"):
        stlc.gym.make_vec(path, 0)


@pytest.mark.apart
@pytest.mark.filterwarnings("ignore:.*(infinity|render|Box).*:UserWarning")
def test_the_page_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    blocks = (ROOT / "docs" / "gym.md").read_text(encoding="utf-8").split("```python\n")[1:]
    monkeypatch.chdir(ROOT)
    for block in blocks:
        if "stable_baselines3" in block and find_spec("stable_baselines3") is None:
            continue
        exec(compile(block.split("```")[0], "gym.md", "exec"), {})
    assert "in_river" in capsys.readouterr().out
