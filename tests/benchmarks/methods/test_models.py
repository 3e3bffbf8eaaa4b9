"""Learners with a learnt model, MBPO and PETS: imagined episodes, rewards, steps, resuming, policies."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from benchmarks.methods import _imagined as imagined
from benchmarks.methods._ensemble import Predictor
from benchmarks.methods._soft_actor_critic import SacOptions, SoftActorCritic, TransitionBatch
from benchmarks.methods.mbpo import MbpoLearner
from benchmarks.methods.pets import PetsLearner, PetsPolicy
from stlc import Run
from stlc.cli.framework.app import main
from stlc.controller.parallel.ddp import ALONE, Ranks
from stlc.controller.problem.environments import Environments, Reward
from stlc.controller.problem.task import Task
from stlc.controller.run.config import ResolvedConfig
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.diagnostics import UsageError
from stlc.registry import METHODS

pytestmark = pytest.mark.apart

ROOT = Path(__file__).parents[3]
SPEC, CAR = str(ROOT / "specs/traffic.stl"), str(ROOT / "examples/car.yaml")
CPU = torch.device("cpu")
TINY: dict[str, dict[str, float]] = {
    "mbpo": {"networks": 3, "elites": 2, "width": 8, "layers": 1, "first": 6, "environments": 2},
    "pets": {"networks": 3, "elites": 2, "width": 8, "layers": 1, "first": 6, "environments": 2},
}
TINY["mbpo"] |= {"updates": 0.1, "imagined": 1.0, "critic_width": 8, "model_epochs": 1, "growth": 0.0}
TINY["pets"] |= {"population": 10, "rounds": 2, "particles": 4, "model_epochs": 1, "growth": 0.0}


def tiny(task: Task, method: str, **changed: object) -> ResolvedConfig:
    config = resolve_config(task, TrainConfig(method=method, seed=3))
    return replace(config, **TINY[method] | changed)  # type: ignore[arg-type]


def learner_of(task: Task, method: str, **changed: object) -> imagined.ModelLearner:
    config = tiny(task, method, **changed)
    found = METHODS.get(method).learner(task, config, steps=4, device=CPU, ranks=ALONE)
    assert isinstance(found, imagined.ModelLearner)
    return found


@pytest.mark.parametrize("kind", ["robustness", "accuracy", "task"])
def test_rewards_are_those_of_the_environments(car_task: Task, kind: Reward) -> None:
    environments = Environments(car_task, 20, reward=kind, generator=torch.Generator().manual_seed(4))
    environments.reset()
    x0 = environments.states
    plans = imagined.random_controls(car_task, 20, torch.Generator().manual_seed(5))
    earned = torch.stack([environments.step(plans[:, step]).reward for step in range(car_task.horizon)], 1)
    states, actions = imagined.play(car_task, x0, lambda _, step: plans[:, step])
    torch.testing.assert_close(imagined.rewards(car_task, kind, states, actions), earned)


def test_kept_episodes_replace_the_oldest(car_task: Task) -> None:
    kept = imagined.Episodes(car_task, 5)
    for start in (0, 3):
        ones = torch.arange(start, start + 3).float()
        shape = (3, car_task.horizon)
        width = kept.states.shape[2]
        kept.add(
            ones[:, None, None].expand(3, shape[1] + 1, width),
            ones[:, None, None].expand(*shape, 1),
            ones[:, None].expand(shape),
        )
    assert (kept.count, kept.total) == (5, 6)
    assert kept.rewards[:, 0].tolist() == [5.0, 1.0, 2.0, 3.0, 4.0]
    again = imagined.Episodes(car_task, 5)
    again.restore({name.split(".")[1]: value for name, value in kept.tensors().items()})
    assert (again.count, again.total) == (5, 6)
    assert torch.equal(again.states, kept.states)


def _made(learner: imagined.ModelLearner) -> float:
    """Loss of one whole step: `advance`, then `settle`."""
    loss = learner.advance()
    assert learner.settle()
    return loss


def test_networks_are_trained_once_enough_episodes_were_added_and_not_near_the_end(car_task: Task) -> None:
    def fitted(**changed: object) -> list[int]:
        learner = learner_of(car_task, "mbpo", **changed)  # 4 steps of 2 episodes, after 6 random ones
        return [(_made(learner), learner.fitted)[1] for _ in range(4)]

    assert fitted(until=1.0) == [6, 8, 10, 12]
    assert fitted(until=0.5) == [6, 8, 8, 8]
    assert fitted(until=1.0, growth=0.5) == [6, 6, 10, 10]
    assert fitted(until=0.0, growth=0.5) == [6, 6, 6, 6]


def test_rare_trainings_of_the_networks_are_no_part_of_the_pace(car_task: Task) -> None:
    assert learner_of(car_task, "mbpo", growth=0.5).settles_rarely
    assert not learner_of(car_task, "mbpo", growth=0.0).settles_rarely


def test_a_late_training_of_the_networks_that_diverges_ends_the_run(car_task: Task) -> None:
    learner = learner_of(car_task, "mbpo")
    _made(learner)
    learner.advance()
    learner.ensemble.highest.data.fill_(math.nan)
    assert not learner.settle()


@pytest.mark.parametrize("method", ["mbpo", "pets"])
@pytest.mark.parametrize("kind", ["robustness", "task"])
def test_it_resumes_bit_for_bit(car_task: Task, method: str, kind: str) -> None:
    whole, part = (learner_of(car_task, method, reward=kind) for _ in range(2))
    losses = [_made(whole) for _ in range(3)]
    _made(part)
    resumed = learner_of(car_task, method, reward=kind)
    resumed.restore({name: value.clone() for name, value in part.tensors().items()}, part.facts())
    assert [_made(resumed) for _ in range(2)] == losses[1:]
    assert resumed.step == 3
    assert resumed.environment_steps == whole.environment_steps == car_task.horizon * (6 + 2 + 2)
    assert all(torch.equal(value, resumed.tensors()[name]) for name, value in whole.tensors().items())
    x = car_task.sample(3, seed=1, dtype=torch.float64)
    assert torch.equal(whole.policy.plan(x), resumed.policy.plan(x))


@pytest.mark.parametrize("method", ["mbpo", "pets"])
def test_the_command_line_trains_and_opens_it(
    method: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    own = [word for key, value in TINY[method].items() for word in ("--option", f"{key}={value}")]
    options = ["--method", method, "--steps", "2", "--held-out", "20", "--drives", "2", "--no-pictures"]
    code = main(["train", SPEC, "--system", CAR, *options, *own, "--option", "reward=task", "--json"])
    document = json.loads(capsys.readouterr().out)
    assert code == 0, document["diagnostics"]
    assert document["result"]["steps"] == 2
    run = Run.open(document["result"]["run"])
    x = run.task.sample(3, seed=1, dtype=torch.float64)
    plans, judged = run.plan_judged(x)
    assert plans.shape == (3, run.task.horizon, 1)
    assert torch.equal(plans, run.plan_judged(x)[0])
    torch.testing.assert_close(judged.rho, run.task.judge(x, plans).rho)


@pytest.mark.parametrize("method", ["mbpo", "pets"])
def test_what_it_cannot_do_is_refused(car_task: Task, method: str) -> None:
    config = tiny(car_task, method)
    with pytest.raises(UsageError, match="in one process"):
        METHODS.get(method).learner(car_task, config, steps=1, device=CPU, ranks=Ranks(size=2))
    with pytest.raises(UsageError, match="on the processor"):
        METHODS.get(method).learner(car_task, config, steps=1, device=torch.device("meta"), ranks=ALONE)


def test_an_unlearnt_reward_ends_the_training_as_diverged(car_task: Task) -> None:
    learner = learner_of(car_task, "mbpo")
    learner.ensemble.highest.data.fill_(math.nan)
    assert math.isnan(learner.advance())
    assert learner.step == 0


@pytest.mark.parametrize("lr", [1e4, 1e8, 1e12])
def test_weights_of_a_diverged_step_are_not_saved(car_task: Task, lr: float) -> None:
    """The loss shows it at once, or only the weights do, or no imagined transition is finite."""
    learner = learner_of(car_task, "mbpo", lr=lr, updates=0.02)
    for _ in range(8):
        if math.isnan(learner.advance()):
            break
        assert all(bool(weight.isfinite().all()) for weight in learner.policy.network.parameters())
        learner.settle()
    else:
        pytest.fail("it did not diverge")
    error, good = learner.diagnose()
    assert error.diagnostics[0].code == "R401"
    assert not good


# ------------------------------------------------------------------ the exact model instead of a learnt one


class Exact(Predictor):
    """The system itself as the prediction of two elites."""

    def __init__(self, task: Task) -> None:
        self.elites, self._task = 2, task
        self._own = len(task.system.decl.signature.names)

    def __call__(self, inputs: torch.Tensor, generator: torch.Generator) -> torch.Tensor:  # noqa: ARG002
        flat = inputs.flatten(0, 1)
        x, u = flat[:, : self._own], flat[:, self._own :]
        return (self._task.plain.step(x, u) - x).view(*inputs.shape[:2], -1)


def test_imagined_episodes_of_an_exact_model_are_the_real_ones(car_task: Task) -> None:
    model = imagined.LearntModel(car_task, Exact(car_task))
    x = car_task.sample(6, seed=0)
    u = imagined.random_controls(car_task, 6, torch.Generator().manual_seed(0))[:, 0]
    moved = model.step(x.view(2, 3, -1), u.view(2, 3, -1), torch.Generator())
    torch.testing.assert_close(moved.flatten(0, 1), car_task.system.step(x, u))


@pytest.mark.parametrize(
    ("kind", "ahead", "more"), [("robustness", 0, 0.2), ("task", 0, 0.2), ("task", 5, 0.05)]
)
def test_pets_with_an_exact_model_finds_plans(car_task: Task, kind: str, ahead: int, more: float) -> None:
    config = tiny(car_task, "pets", reward=kind, ahead=ahead)
    config = replace(config, population=100, rounds=4, particles=2)  # type: ignore[call-arg]
    x = car_task.sample(40, seed=0)
    idle = car_task.judge(x, torch.zeros(40, car_task.horizon, 1)).rho
    policy = PetsPolicy(car_task, imagined.LearntModel(car_task, Exact(car_task)), config)  # type: ignore[arg-type]
    plans, judged = policy.plan_judged(x)
    assert float((judged.rho >= 0.0).float().mean()) > float((idle >= 0.0).float().mean()) + more
    assert torch.equal(plans, policy.plan(x))
    assert policy.continuation(x).shape == plans.shape


def test_mbpo_imagines_what_happens(car_task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the exact model, imagined rests of episodes end with the robustness of the whole episode."""
    learner = learner_of(car_task, "mbpo", shortest=car_task.horizon, longest=car_task.horizon)
    assert isinstance(learner, MbpoLearner)
    learner.observed(None)
    monkeypatch.setattr(MbpoLearner, "model", imagined.LearntModel(car_task, Exact(car_task)))
    batch = learner._imagined(40)
    assert set(batch.ended.tolist()) == {0.0, 1.0}
    assert bool((batch.rewards[batch.ended == 0.0] == 0.0).all())
    assert bool((batch.seen[:, -1] < 1.0).all())
    torch.testing.assert_close(
        batch.after[:, -1] - batch.seen[:, -1], torch.full((len(batch.ended),), 1 / 25)
    )
    assert bool((batch.actions.abs() <= 1.0).all())
    assert float(batch.rewards[batch.ended == 1.0].abs().min()) > 0.0


def test_imagined_episodes_grow(car_task: Task) -> None:
    learner = learner_of(car_task, "mbpo", shortest=1, longest=15, growing_from=20, growing_to=150)
    assert isinstance(learner, MbpoLearner)
    lengths = []
    for step in (0, 20, 85, 150, 500):
        learner.step = step
        lengths.append(learner.length)
    assert lengths == [1, 1, 8, 15, 15]


def test_soft_actor_critic_prefers_the_rewarded_action() -> None:
    options = SacOptions(lr=3e-3, discount=0.9, average=0.01, temperature=0.0)
    generator = torch.Generator().manual_seed(0)
    learner = SoftActorCritic(2, 1, width=16, options=options, generator=generator)
    for _ in range(300):
        seen = torch.rand(64, 2, generator=generator)
        actions = 2.0 * torch.rand(64, 1, generator=generator) - 1.0
        earned = -(actions[:, 0] - 0.5).abs()
        learner.learn(TransitionBatch(seen, actions, earned, seen, torch.ones(64)), generator)
    assert abs(float(learner(torch.rand(50, 2, generator=generator)).detach().mean()) - 0.5) < 0.2


def test_densities_are_those_of_squashed_gaussians() -> None:
    options = SacOptions(lr=1e-3, discount=0.9, average=0.01, temperature=0.2)
    generator = torch.Generator().manual_seed(0)
    learner = SoftActorCritic(1, 1, width=4, options=options, generator=generator)
    seen = torch.full((200_000, 1), 0.3)
    with torch.no_grad():
        actions, density = learner._sampled(seen, generator)
    inside = (actions[:, 0].abs() < 0.1).float().mean() / 0.2
    middle = density[actions[:, 0].abs() < 0.01].exp().mean()
    torch.testing.assert_close(inside, middle, rtol=0.05, atol=0.0)


@pytest.mark.parametrize(
    ("method", "option"),
    [("mbpo", "networks=0"), ("mbpo", "discount=2"), ("pets", "elites=0"), ("pets", "piece=0")],
)
def test_options_out_of_bounds_are_a_finding(car_task: Task, method: str, option: str) -> None:
    name, value = option.split("=")
    with pytest.raises(UsageError, match=name):
        resolve_config(car_task, TrainConfig(method=method, options={name: value}))


def test_options_are_numbers_with_defaults(car_task: Task) -> None:
    for method in ("mbpo", "pets"):
        config = resolve_config(car_task, TrainConfig(method=method))
        assert isinstance(config, imagined.ModelConfig)
        assert all(
            isinstance(getattr(config, each.name), int | float | str | tuple) for each in fields(config)
        )
    assert isinstance(learner_of(car_task, "pets"), PetsLearner)
