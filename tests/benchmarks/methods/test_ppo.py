"""PPO: what it optimises, that it learns, goes on bit for bit, and is deployed as any policy."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.methods._actor import ActorPolicy
from benchmarks.methods.ppo import Moments, PpoConfig, PpoLearner
from stlc import Run, native
from stlc.cli.framework.app import main
from stlc.controller.parallel.ddp import ALONE
from stlc.controller.problem.environments import Environments, observe
from stlc.controller.problem.task import Task
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.diagnostics import UsageError

pytestmark = pytest.mark.apart

ROOT = Path(__file__).parents[3]
SPEC, CAR = str(ROOT / "specs/traffic.stl"), str(ROOT / "examples/car.yaml")
SMALL = {"environments": "32", "epochs": "2", "minibatches": "2"}
OPTIONS = [word for name, value in SMALL.items() for word in ("--option", f"{name}={value}")]


def learner(task: Task, **options: str) -> PpoLearner:
    config = resolve_config(task, TrainConfig(method="ppo", seed=1, options=SMALL | options))
    assert isinstance(config, PpoConfig)
    return PpoLearner(task, config, steps=20, device=torch.device("cpu"))


def trained(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    code = main(["train", *words, "--no-pictures", "--json"])
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert code == 0, document["diagnostics"]
    result: dict[str, Any] = document["result"]
    return result


def test_advantages_are_those_of_the_definition(car_task: Task) -> None:
    """Eq. 16 of Schulman et al. 2016, as a sum over the rest of the episode."""
    ppo = learner(car_task, discount="0.9", trace="0.8")
    seen = torch.randn(5, 3, ppo.environments.width)
    rewards = torch.randn(5, 3)
    with torch.no_grad():
        found, targets = ppo._estimated(seen, rewards)
        values = ppo.network.critic(seen)[..., 0]
    errors = rewards + 0.9 * torch.cat((values[1:], torch.zeros(1, 3))) - values
    wanted = torch.stack([sum(0.72**k * errors[t + k] for k in range(5 - t)) for t in range(5)])
    torch.testing.assert_close(targets, wanted + values)
    torch.testing.assert_close(found, (wanted - wanted.mean()) / wanted.std())


def test_moments_are_those_of_all_vectors() -> None:
    moments, parts = Moments(3), [torch.randn(7, 3) * 4 + 2, torch.randn(50, 3), torch.zeros(1, 3)]
    assert (moments.mean.tolist(), moments.spread.tolist()) == ([0.0] * 3, [1.0] * 3)
    for part in parts:
        moments.add(part, ALONE)
    both = torch.cat(parts).double()
    torch.testing.assert_close(moments.mean.double(), both.mean(0), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(moments.spread.double(), both.std(0, unbiased=False), rtol=1e-5, atol=1e-6)
    constant = Moments(1)
    constant.add(torch.full((9, 1), 3.0), ALONE)
    assert constant.spread.item() == 1.0


def test_the_density_is_that_of_the_drawn_controls(car_task: Task) -> None:
    ppo = learner(car_task)
    episodes = ppo._played()
    seen = ppo.network.normalised(episodes.seen)
    with torch.no_grad():
        now, _ = ppo.network.judged(*(part.flatten(0, 1) for part in (seen, episodes.noise, episodes.raw)))
    torch.testing.assert_close(now, episodes.density.flatten())


def test_the_policy_plays_what_the_environments_play(car_task: Task) -> None:
    """A plan of the policy is an episode without noise, elapsed share included."""
    network = learner(car_task).network
    made = Environments(car_task, 8, generator=torch.Generator().manual_seed(3))
    seen, actions = made.reset(), []
    first = made.states.float()
    with torch.no_grad():
        for _ in range(made.steps):
            actions.append(network(seen))
            seen = made.step(actions[-1]).observation
    policy, wanted = ActorPolicy(car_task, network), torch.stack(actions, 1).double()
    torch.testing.assert_close(policy.plan(first).double(), wanted, rtol=1e-5, atol=1e-5)
    policy._native = lambda _system: None  # type: ignore[method-assign, assignment]
    torch.testing.assert_close(policy.plan(first).double(), wanted, rtol=1e-4, atol=1e-4)
    assert observe(car_task, first, made.steps)[:, -1].tolist() == [1.0] * 8


def test_it_learns(car_task: Task) -> None:
    """The accuracy on fresh states rises within a dozen steps."""
    ppo = learner(car_task, environments="256", epochs="5", minibatches="4")
    before = ppo.validate().accuracy
    losses = [ppo.advance() for _ in range(12)]
    assert all(math.isfinite(loss) for loss in losses)
    assert ppo.step == 12
    assert ppo.validate().accuracy > before + 0.1
    assert ppo.rate < ppo.config.lr


def test_a_broken_step_changes_nothing(car_task: Task) -> None:
    ppo = learner(car_task)
    ppo.advance()
    kept = {name: value.clone() for name, value in ppo.network.named_parameters()}
    bad = replace(ppo._played(), rewards=torch.full((car_task.horizon, 32), math.nan))
    ppo._played = lambda: bad  # type: ignore[method-assign]
    assert math.isnan(ppo.advance())
    assert ppo.step == 1
    assert all(torch.equal(value, kept[name]) for name, value in ppo.network.named_parameters())
    error, good = ppo.diagnose()
    assert error.diagnostics[0].code == "R401"
    assert not good  # a later minibatch may be the broken one


@pytest.mark.parametrize(
    "reward", ["task", *(pytest.param(each, marks=pytest.mark.slow) for each in ("robustness", "accuracy"))]
)
def test_it_goes_on_bit_for_bit(
    reward: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    options = [
        SPEC,
        "--system",
        CAR,
        "--method",
        "ppo",
        "--option",
        f"reward={reward}",
        *OPTIONS,
        "--held-out",
        "40",
    ]
    whole = Run.open(trained(capsys, *options, "--steps", "6", "--drives", "2")["run"])
    part = trained(capsys, *options, "--steps", "6,3@3", "--drives", "0")
    resumed = Run.open(trained(capsys, "--resume", part["run"], "--steps", "6")["run"])
    x = whole.task.sample(5, seed=0, dtype=torch.float64)
    assert torch.equal(whole.policy(x), resumed.policy(x))


def test_options_of_the_method(car_task: Task) -> None:
    config = resolve_config(
        car_task, TrainConfig(method="ppo", options={"reward": "accuracy", "epochs": "3"})
    )
    assert isinstance(config, PpoConfig)
    assert (config.reward, config.epochs, config.plans, config.environments) == ("accuracy", 3, 1, 512)
    wanted = "of method `ppo` is a whole number"
    for options, message in (
        ({"epoch": "3"}, "method `ppo` has no option `epoch`"),
        ({"epochs": "3.5"}, f"option `epochs` {wanted}, not `3.5`"),
        ({"trace": "much"}, "option `trace` of method `ppo` is a number, not `much`"),
        ({"environments": "0"}, f"option `environments` {wanted} from 1 to 65,536, not `0`"),
        ({"epochs": "0"}, f"option `epochs` {wanted} from 1 to 1,000,000, not `0`"),
        ({"minibatches": "0"}, f"option `minibatches` {wanted} from 1 to 1,000,000, not `0`"),
        ({"correlation": "2"}, "option `correlation` of method `ppo` is a number from 0 to 1, not `2.0`"),
        ({"entropy": "-1"}, "method `ppo`: `entropy` is -1.0, not at least 0"),
        ({"reward": "money"}, "method `ppo`: `reward` is 'money', none of task, robustness, accuracy"),
    ):
        with pytest.raises(UsageError) as caught:
            resolve_config(car_task, TrainConfig(method="ppo", options=options))
        assert caught.value.diagnostics[0].message == message
    with pytest.raises(UsageError, match="method `guided` has no option `reward`"):
        resolve_config(car_task, TrainConfig(method="guided", options={"reward": "task"}))


def test_a_run_is_reported_and_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    small = ["--steps", "2", "--drives", "0", "--held-out", "40"]
    made = trained(capsys, SPEC, "--system", CAR, "--method", "ppo", *OPTIONS, *small)
    run = Run.open(made["run"])
    assert json.loads((run.dir.path / "config.resolved.yaml").read_text())["environments"] == 32
    if native.compiler() is not None:
        assert main(["export", made["run"], "--to", "c"]) == 0
        assert "stlc_controller.h" in capsys.readouterr().out
