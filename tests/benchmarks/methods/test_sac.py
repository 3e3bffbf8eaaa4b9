"""SAC of stable-baselines3: the episodes that it sees, resuming, and what happens without the package."""

from __future__ import annotations

import json
import math
import random
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.methods._sac import SacConfig
from stlc import Run
from stlc.cli.framework.app import main
from stlc.controller.parallel.ddp import ALONE, Ranks
from stlc.controller.problem.task import Task
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.diagnostics import MissingError, UsageError
from stlc.extras import installation
from stlc.registry import METHODS

pytestmark = pytest.mark.apart

ROOT = Path(__file__).parents[3]
SPEC, CAR = str(ROOT / "specs/traffic.stl"), str(ROOT / "examples/car.yaml")
SMALL = {"environments": "8", "updates": "1", "capacity": "400"}
OPTIONS = [word for name, value in SMALL.items() for word in ("--option", f"{name}={value}")]
CPU = torch.device("cpu")


def learner(task: Task, *, ranks: Ranks = ALONE, **options: str) -> Any:
    pytest.importorskip("stable_baselines3")
    config = resolve_config(task, TrainConfig(method="sac", seed=1, options=SMALL | options, batch=32))
    return METHODS.get("sac").learner(task, config, steps=20, device=CPU, ranks=ranks)


def trained(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    code = main(["train", *words, "--no-pictures", "--json"])
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert code == 0, document["diagnostics"]
    result: dict[str, Any] = document["result"]
    return result


def test_episodes_as_the_library_sees_them(car_task: Task) -> None:
    sac = learner(car_task)
    env = sac.model.env
    assert env.action_space.low.tolist() == [-1.0]
    seen = env.reset()
    before = sac.environments.states
    assert seen.shape == (8, car_task.system.observed_count + 1)
    assert abs(float(seen[:, 1].mean())) < 1.5
    results = []
    for _ in range(car_task.horizon):
        env.step_async(np.full((8, 1), -1.0, np.float32))
        results.append(env.step_wait())
    plans = torch.full((8, car_task.horizon, 1), -10.0)
    rho = car_task.judge(before, plans, states=False).rho.clamp(-10.0, 10.0)
    observed, rewards, done, records = results[-1]
    assert not any(result[2].any() or result[1].any() for result in results[:-1])
    np.testing.assert_allclose(rewards, rho.float().numpy(), rtol=1e-5)
    assert done.all()
    assert not np.array_equal(records[0]["terminal_observation"], observed[0])
    assert env.get_attr("num_envs") == [8] * 8
    assert env.env_is_wrapped(object) == [False] * 8


def test_the_policy_is_the_library_s_deterministic_actor(car_task: Task) -> None:
    """Its weights alone give the same controls: deploying a policy needs no package."""
    sac = learner(car_task)
    sac.advance()
    observation = sac.environments.observe(sac.environments.states, 0).float()
    seen = sac.model.env.observed()
    theirs, _ = sac.model.predict(seen, deterministic=True)
    ours = sac.policy.network.actor(observation)
    np.testing.assert_allclose(ours.detach().numpy(), 10.0 * theirs, rtol=1e-4, atol=1e-4)


def test_a_step_is_an_episode_and_leaves_other_random_numbers_alone(car_task: Task) -> None:
    sac = learner(car_task)
    states = torch.get_rng_state(), np.random.get_state()[1].copy(), random.getstate()  # noqa: NPY002
    losses = [sac.advance() for _ in range(2)]
    assert all(math.isfinite(loss) and loss > 0.0 for loss in losses)
    assert sac.model.num_timesteps == 2 * 8 * car_task.horizon
    assert sac.model._n_updates == 2 * car_task.horizon - 12
    assert torch.equal(states[0], torch.get_rng_state())
    assert np.array_equal(states[1], np.random.get_state()[1])  # noqa: NPY002
    assert states[2] == random.getstate()


@pytest.mark.parametrize("reward", ["task", pytest.param("accuracy", marks=pytest.mark.slow)])
def test_it_goes_on_bit_for_bit(
    reward: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Replay buffer included, which is full by then."""
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    options = [
        SPEC,
        "--system",
        CAR,
        "--method",
        "sac",
        "--option",
        f"reward={reward}",
        *OPTIONS,
        "--batch",
        "32",
    ]
    options += ["--held-out", "40"]
    whole = Run.open(trained(capsys, *options, "--steps", "4", "--drives", "2")["run"])
    part = trained(capsys, *options, "--steps", "3", "--drives", "0")
    resumed = Run.open(trained(capsys, "--resume", part["run"], "--steps", "4")["run"])
    x = whole.task.sample(5, seed=0, dtype=torch.float64)
    assert torch.equal(whole.policy(x), resumed.policy(x))
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.delitem(sys.modules, "benchmarks.methods._sb3", raising=False)
    assert torch.equal(Run.open(part["run"]).policy(x), whole.policy(x))


def test_it_goes_on_bit_for_bit_while_actions_are_drawn_at_random(car_task: Task) -> None:
    whole = learner(car_task, environments="4", warmup_transitions="150")
    whole.advance()
    kept = {name: value.clone() for name, value in whole.tensors().items()}
    resumed = learner(car_task, environments="4", warmup_transitions="150")
    resumed.restore(kept, whole.facts())
    assert whole.advance() == resumed.advance()
    assert all(torch.equal(value, resumed.tensors()[name]) for name, value in whole.tensors().items())


def test_a_divergence_is_a_finding(car_task: Task) -> None:
    """The library itself raises an error for a distribution with NaN."""
    sac = learner(car_task, updates="2")
    with torch.no_grad():
        sac.model.actor.mu.weight.fill_(math.nan)
    assert math.isnan(sac.advance())
    assert sac.step == 0
    error, good = sac.diagnose()
    assert (error.diagnostics[0].code, good) == ("R401", False)


def test_without_the_package(car_task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.delitem(sys.modules, "benchmarks.methods._sb3", raising=False)
    config = resolve_config(car_task, TrainConfig(method="sac"))
    assert isinstance(config, SacConfig)
    with pytest.raises(MissingError) as caught:
        METHODS.get("sac").learner(car_task, config, steps=1, device=CPU, ranks=ALONE)
    assert caught.value.diagnostics[0].help == (installation("bench"),)


def test_it_trains_in_one_process(car_task: Task) -> None:
    with pytest.raises(UsageError, match="trains in one process"):
        learner(car_task, ranks=Ranks(0, 2))
