"""`param`: values that every trajectory has for itself, from the specification to the trace."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stlc import native
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.deployment.batched import Setting
from stlc.controller.evaluation.archive import save_trace_of
from stlc.controller.evaluation.deployment import deploy
from stlc.controller.problem.native import NativeJudge
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.controller.training.loop import train
from stlc.diagnostics import StlcError, TraceError
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor
from stlc.source import Source

SYSTEM = """\
stlc: 1
name: walker
time: {dt: 0.2 s, horizon: 10 steps}
state:
  x: {unit: m, range: [-4, 4]}
  y: {unit: m, range: [-4, 4]}
control:
  vx: {unit: m/s, range: [-3, 3]}
  vy: {unit: m/s, range: [-3, 3]}
flow: {x: vx, y: vy}
init:
  mixture: [{draw: {x: "uniform(-4, -3)", y: "uniform(-1, 1)"}}]
objective: {terms: [{weight: 0.01, expr: vx^2 + vy^2}]}
policy: {hidden: [64, 64], observe: [x, y]}
train: {steps: 200, seed: 7}
test: {steps: 20, agents: 8}
"""
SPEC = """\
spec around
state signal x, y [m]
## how large the obstacle is, and where
param r [m] in [0.5, 1.5]
param c: real[2] [m] ~ truncnorm([-1, 0], [0.2, 0.5], [-1.5, -1], [-0.5, 1])
param far [km] in {0.001, 0.002}
@safety require clear: always[0, T] [x, y] not in circle(c, r)
require reach: eventually[0, T] x >= far
"""


def system(text: str = SYSTEM, **overrides: str) -> System:
    return System(parse_system(Source("walker.yaml", text), Path("walker.yaml"), overrides))


def task_of(text: str = SPEC, **overrides: str) -> Task:
    return Task.of(Spec.parse(Source("around.stl", text)), system(**overrides), overrides=overrides)


@pytest.fixture(scope="module")
def task() -> Task:
    return task_of()


def test_every_trajectory_draws_its_own(task: Task) -> None:
    assert task.system.names == ("x", "y", "r", "c[0]", "c[1]", "far")
    _, _, r, c0, c1, far = task.sample(3000, seed=0, dtype=torch.float64).unbind(1)
    assert 0.5 <= float(r.min()) < 0.51
    assert 1.49 < float(r.max()) <= 1.5
    assert abs(float(c0.mean()) + 1.0) < 0.02
    assert float(c0.min()) >= -1.5
    assert float(c0.max()) <= -0.5
    assert float(c1.std()) > 2 * float(c0.std())
    assert set(far.tolist()) == {0.001, 0.002}
    assert torch.equal(task.sample(50, seed=1), task.sample(50, seed=1))
    assert task.system.signature["r"].low == 0.5


def test_nothing_moves_them_and_the_policy_sees_them(task: Task) -> None:
    x0 = task.sample(20, seed=0)
    assert torch.equal(task.system.observe(x0), x0)
    x = task.rollout(x0, torch.ones(20, 10, 2))
    assert torch.equal(x[:, :, 2:], x0[:, None, 2:].expand(-1, 11, -1))
    assert torch.equal(task.system.step(x0, torch.ones(20, 2))[:, 2:], x0[:, 2:])


def test_they_decide_what_is_asked(task: Task) -> None:
    still = torch.zeros(2, 10, 2, dtype=torch.float64)
    x0 = torch.tensor([[-3.0, 0, 0.5, -1, 0, 0.001], [-3.0, 0, 1.5, -1, 0, 0.002]], dtype=torch.float64)
    each = task.requirement_robustness(task.rollout(x0, still))
    torch.testing.assert_close(each, torch.tensor([[1.5, -4.0], [0.5, -5.0]], dtype=torch.float64))


@pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")
@given(seed=st.integers(0, 10_000))
def test_kernel_and_torch_agree(task: Task, seed: int) -> None:
    assert NativeJudge.of(task.system, task.rules) is not None
    generator = torch.Generator().manual_seed(seed)
    x0 = task.sample(64, generator=generator, dtype=torch.float64)
    u = 6 * torch.rand(64, 10, 2, generator=generator, dtype=torch.float64) - 3
    judged = task.judge(x0, u)
    torch.testing.assert_close(
        judged.requirements, task.requirement_robustness(task.rollout(x0, u)), rtol=1e-9, atol=1e-9
    )


def test_a_value_given_at_compile_time_is_a_constant() -> None:
    task = task_of(r="0.8")
    assert "r" not in task.system.names
    x0 = torch.tensor([[-3.0, 0, -1, 0, 0.001]], dtype=torch.float64)
    each = task.requirement_robustness(task.rollout(x0, torch.zeros(1, 10, 2, dtype=torch.float64)))
    assert float(each[0, 0]) == pytest.approx(1.2)


def test_a_parameter_that_the_system_carries_is_the_systems() -> None:
    carried = SYSTEM.replace("control:", "param: {r: {unit: m, range: [0.5, 1.5]}}\ncontrol:")
    spec = Spec.parse(Source("around.stl", SPEC))
    task = Task.of(spec, system(carried))
    assert task.system.names == ("x", "y", "r", "c[0]", "c[1]", "far")
    assert task.plain.names == ("x", "y", "r")
    assert [each.column.name for each in task.compiled.parameters] == ["c[0]", "c[1]", "far"]
    fixed = Task.of(spec, system(carried, r="0.7"), overrides={"r": "0.7"})
    assert set(fixed.sample(10, seed=0, dtype=torch.float64)[:, 2].tolist()) == {0.7}


@pytest.mark.parametrize(
    ("param", "code"),
    [
        ("param r [m] in [0.5, 2]", "E104"),
        ("param r [m] ~ uniform(0.5, 1.5)", "E104"),
        ("param r [s] in [0.5, 1.5]", "E203"),
        ("param r: bool in {0, 1}", "E104"),
    ],
)
def test_it_must_agree_with_the_system(param: str, code: str) -> None:
    carried = SYSTEM.replace("control:", "param: {r: {unit: m, range: [0.5, 1.5]}}\ncontrol:")
    text = SPEC.replace("param r [m] in [0.5, 1.5]", param)
    with pytest.raises(StlcError) as caught:
        Task.of(Spec.parse(Source("around.stl", text)), system(carried))
    assert code in {finding.code for finding in caught.value.diagnostics}


@pytest.mark.parametrize(
    ("param", "code"),
    [
        ("param r [m] in [0.5, inf]", "E205"),
        ("param r [m] in [1.5, 0.5]", "E205"),
        ("param r [m] ~ uniform(0 s, 1 s)", "E203"),
        ("param r [m] ~ uniform(0, x)", "E205"),
        ("param r [m] ~ uniform([0, 0], [1, 1])", "E205"),
        ("param r [m] ~ circle([0, 0], 1)", "E205"),
    ],
)
def test_what_cannot_be_drawn_is_said(param: str, code: str) -> None:
    with pytest.raises(StlcError) as caught:
        task_of(SPEC.replace("param r [m] in [0.5, 1.5]", param))
    assert code in {finding.code for finding in caught.value.diagnostics}


def test_an_interval_takes_constants_alone_unless_the_value_is_given() -> None:
    text = "state signal x [m]\nparam c [s] in [1, 2]\nrequire near: eventually[0, c] x > 0\n"
    with pytest.raises(StlcError) as caught:
        task_of(text)
    assert [finding.code for finding in caught.value.diagnostics] == ["E303"]
    assert task_of(text, c="1s").compiled.reach == 5


def test_bare_numbers_of_a_distribution_are_in_the_unit_that_is_declared() -> None:
    compiled = compile_spec(
        Spec.parse(Source("a.stl", "param w [ms] ~ normal(200, 1 ms)\nrequire a: w > 0\n")),
        grid=Grid(system().decl.dt, 10),
    )
    (each,) = compiled.parameters
    assert (each.column.low, each.column.high) == (197.0, 203.0)


def test_a_trace_holds_them_or_they_are_given() -> None:
    text = "signal x [m]\nparam r [m] in [0.5, 1.5]\nrequire far: always x > r\n"
    signals = {"x": [1.0, 2.0], "r": [0.7, 0.7]}
    assert Monitor(text, dt=1).check(signals).satisfied
    assert not Monitor(text, dt=1, overrides={"r": "1.2"}).check({"x": [1.0, 2.0]}).satisfied
    assert not Monitor(text, dt=1, overrides={"r": "1200 mm"}).check(signals).satisfied
    with pytest.raises(TraceError) as caught:
        Monitor(text, dt=1).check({"x": [1.0, 2.0]})
    (finding,) = caught.value.diagnostics
    assert finding.code == "E601"
    assert any("--set r=" in line for line in finding.help)


@pytest.mark.apart
def test_trains_deploys_and_checks_a_family(tmp_path: Path) -> None:
    task = task_of()
    run_dir = open_folder(task, TrainConfig(), Launch(root=tmp_path, name="family"))
    run = train(task, TrainConfig(steps=120, batch=128, held_out=100), run_dir).run
    x0 = run.task.sample(300, seed=3, dtype=torch.float64)
    good = TOLERANCE.satisfied(run.plan_judged(x0)[1].rho)
    assert float(good.double().mean()) > 0.7

    setting = Setting(seeds=(0, 1), agents=8, steps=20)
    driven = deploy(run.task, run.policy, setting, "none")
    states = torch.from_numpy(driven.recording.states)
    assert torch.equal(states[:, :, 2:], states[:, :1, 2:].expand(-1, 21, -1))
    assert len(set(states[:, 0, 2].tolist())) == 16
    (path,) = save_trace_of(run, driven.recording, setting)
    assert Monitor(SPEC, dt=0.2, horizon=2.0).check(path).satisfied is not None

    outside = Run.open(run_dir.path, overrides={"r": "1.7"})
    x1 = outside.task.sample(50, seed=3, dtype=torch.float64)
    assert set(x1[:, 2].tolist()) == {1.7}
    assert outside.policy.plan(x1).shape == (50, 10, 2)
