"""Exports of actors, networks that choose one control a step: their plans are those of the run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers.exported import CART, MISSION, ROOT, build

from benchmarks.methods._actor import ActorPolicy
from benchmarks.methods._sac import SacActor
from benchmarks.methods.mbpo import Acting, MbpoConfig, actor_critic_of
from benchmarks.methods.ppo import PpoConfig, network_of
from stlc import native
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import ActorNetwork
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.launch import Launch, open_folder
from stlc.dynamics.system import System
from stlc.export.programs import Deciding, Guarding
from stlc.export.verify import answers
from stlc.export.write import export
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.runtime import Controller

pytestmark = pytest.mark.apart

compiled = pytest.mark.skipif(native.compiler() is None, reason="needs a C compiler")


def ppo_actor(task: Task) -> ActorNetwork:
    config = resolve_config(task, TrainConfig(method="ppo", seed=3))
    assert isinstance(config, PpoConfig)
    made = network_of(task, config)
    seen = task.system.observe(task.sample(200, seed=1))
    made.observations.mean[:-1], made.observations.spread[:-1] = seen.mean(0), 0.1 + seen.std(0)
    return stirred(made)


def sac_actor(task: Task) -> ActorNetwork:
    return stirred(SacActor(task, (16, 16)))


def mbpo_actor(task: Task) -> ActorNetwork:
    config = resolve_config(task, TrainConfig(method="mbpo", seed=3, options={"critic_width": "16"}))
    assert isinstance(config, MbpoConfig)
    return stirred(Acting(task, actor_critic_of(task, config)))


def stirred(actor: ActorNetwork) -> ActorNetwork:
    """The actor with larger random weights, so that controls differ between states and steps."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for each in actor.layers.weights:
            each.copy_(1.5 / each.shape[1] ** 0.5 * torch.randn(each.shape, generator=generator))
    return actor.eval()


ACTORS: dict[str, Callable[[Task], ActorNetwork]] = {"ppo": ppo_actor, "sac": sac_actor, "mbpo": mbpo_actor}
SOME = ("ppo", *(pytest.param(method, marks=pytest.mark.slow) for method in ("sac", "mbpo")))


def run_of(files: tuple[Path, Path], folder: Path, method: str) -> Run:
    task = Task.of(Spec.parse(File(files[0]).read()), System.load(files[1]))
    opened = open_folder(task, TrainConfig(steps=1), Launch(root=folder, name="test"))
    return Run(opened, task, ActorPolicy(task, ACTORS[method](task)))


def benchmark(spec: str, system: str, folder: Path, method: str) -> Run:
    return run_of((ROOT / "specs" / f"{spec}.stl", ROOT / "examples" / f"{system}.yaml"), folder, method)


def test_plans_differ_between_states_and_steps(tmp_path: Path) -> None:
    for method in ACTORS:
        run = benchmark("traffic", "car", tmp_path, method)
        plans = run.policy.plan(run.task.sample(20, seed=2, dtype=torch.float64))
        assert float(plans.std(0).mean()) > 0.01
        assert float(plans.std(1).mean()) > 0.01


@compiled
@pytest.mark.parametrize(
    ("method", "spec", "system"), [("ppo", "traffic", "car"), ("mbpo", "ship_safe", "ship_safe")]
)
def test_the_c_controller_of_an_actor_decides_as_the_guard(
    method: str, spec: str, system: str, tmp_path: Path
) -> None:
    run = benchmark(spec, system, tmp_path, method)
    done = export(run, "c", tmp_path / "out")
    assert done.agreement is not None
    assert done.agreement.rho <= 1e-9
    x = run.task.sample(4, seed=5, dtype=torch.float64)
    wanted = Guard(run.task, run.policy, "paper").decide(x)
    assert bool((wanted.source > 0).any()), "no state asks for the backup policy"
    got = torch.tensor(answers([str(build(done.folder))], x.tolist()), dtype=torch.float64)
    rules = len(run.task.rules)
    assert got[:, 0].tolist() == wanted.source.tolist()
    assert got[:, 1].tolist() == wanted.t0.tolist()
    torch.testing.assert_close(got[:, 4 + rules :].view_as(wanted.plan), wanted.plan, rtol=0.0, atol=1e-3)


@pytest.mark.parametrize("method", SOME)
def test_the_runtime_decides_as_the_guard(method: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    run = benchmark("traffic", "car", tmp_path, method)
    done = export(run, "onnx", tmp_path / "out")
    assert "continue.onnx" not in done.files
    assert done.agreement is not None
    x = run.task.sample(6, seed=5, dtype=torch.float64)
    decision = Controller.load(done.folder, guard="paper").decide(x.numpy())
    wanted = Guard(run.task, run.policy, "paper").decide(x)
    torch.testing.assert_close(torch.from_numpy(decision.plan), wanted.plan, rtol=0.0, atol=1e-3)


def test_an_actor_sees_the_clock_of_a_mission(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    (tmp_path / "cart.yaml").write_text(CART)
    (tmp_path / "cart.stl").write_text(MISSION)
    run = run_of((tmp_path / "cart.stl", tmp_path / "cart.yaml"), tmp_path / "runs", "sac")
    targets = ("onnx", "c") if native.compiler() is not None else ("onnx",)
    for target in targets:
        done = export(run, target, tmp_path / target)  # type: ignore[arg-type]
        assert done.agreement is not None
        assert done.agreement.plan <= 1e-4


def test_the_torch_modules_decide_as_the_policy(tmp_path: Path) -> None:
    run = benchmark("traffic", "car", tmp_path, "sac")
    x = run.task.sample(8, seed=4, dtype=torch.float64)
    plan, rho, _, _ = Deciding(run.task, run.network)(x)
    wanted, judged = run.policy.plan_judged(x)
    torch.testing.assert_close(plan, wanted, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(rho, judged.rho, rtol=0.0, atol=1e-4)
    guarded = Guarding(run.task, run.network)(x[:1], wanted[:1])
    assert guarded[0].shape == (1, run.task.horizon, 1)


@pytest.mark.slow
@pytest.mark.parametrize("method", SOME)
def test_the_torch_program_of_an_actor(method: str, tmp_path: Path) -> None:
    run = benchmark("traffic", "car", tmp_path, method)
    done = export(run, "torch", tmp_path / "out")
    assert done.agreement is not None
    assert done.agreement.plan <= 1e-4
