"""Missions: memory in training states, in deployment and in verdicts; what pulls towards far deadlines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.mission_strategies import augmented
from torch import Tensor

from stlc.compile.backends.torch.ops import TORCH
from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, simulate
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.guard.guard import Guard
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import ROUNDS, PlanVerdicts, Task
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.controller.training.learner import Trainer
from stlc.controller.training.samplers import GLIMPSES, POOL, Draws, Missions
from stlc.controller.world import ModelWorld
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.monitor.verdict import Monitor
from stlc.source import Source

CPU = torch.device("cpu")

LINE = """
stlc: 1
name: line
time: {dt: 0.1 s, horizon: 8 steps}
state: {x: {unit: m, range: [-4, 4]}, y: {unit: m, role: env}}
control: {u: {unit: m/s, range: [-5, 5]}}
flow: {x: u}
init: {mixture: [{draw: {x: "uniform(-1, 1)", y: 3}}]}
policy: {hidden: [16]}
backup: {bins: 3, T0: [1, 2]}
"""

MISSION = """
spec line
state signal x [m]
env signal y [m]
@safety
require near: always[0, T] x < 4 m
require there: eventually@[1 s, 2 s] x > 2 m
require back: always@[2.6 s, 3 s] x < 0 m
require rest: always[0, T] (x > 3 m -> once[0, 0.3 s] x < 2.9 m)
"""


@pytest.fixture
def system(tmp_path: Path) -> System:
    path = tmp_path / "line.yaml"
    path.write_text(LINE)
    return System.load(path)


def task_of(text: str, system: System) -> Task:
    return Task.of(Spec.parse(Source("line.stl", text)), system)


@pytest.fixture
def task(system: System) -> Task:
    return task_of(MISSION, system)


def test_missions_without_end_are_driven_for_several_rounds(system: System) -> None:
    ending = task_of("state signal x [m]\nrequire a: always@[2 s, 4 s] once[0, 2 s] x > 1 m", system)
    assert ending.mission_steps == 40 + ending.horizon
    task = task_of("state signal x [m]\nrequire a: always@[2 s, end] once[0, 2 s] x > 1 m", system)
    assert task.mission_steps == 20 + ROUNDS * 21


def steered(task: Task, x: Tensor) -> Tensor:
    """Plans that go right until the first goal is met, then left."""
    gone = x[:, task.system.names.index("there")] > 0.5
    speed = torch.where(gone, -5.0, 2.0).to(x.dtype)
    room = torch.where(gone, x[:, 0] > -1.0, x[:, 0] < 2.2)
    step = torch.arange(task.horizon)[None] < torch.where(room, 4, 0)[:, None]
    return (speed[:, None] * step)[..., None]


class Steered(Policy):
    """A policy that knows the mission."""

    def candidates(self, x: Tensor) -> Tensor:
        return steered(self.task, x)[:, None]

    def judged(self, x: Tensor) -> PlanVerdicts:
        return self.task.judge(x, self.plan(x))


def missions(task: Task, seed: int = 0) -> Missions:
    return Missions(task, torch.Generator().manual_seed(seed), CPU, Steered(task).judged)


# ------------------------------------------------------------------- training states


def test_states_come_from_missions_that_got_there(task: Task) -> None:
    supply = missions(task)
    states = torch.cat([supply.take(4096) for _ in range(24)])
    named = dict(zip(task.system.names, states.unbind(1), strict=True))
    assert bool(task.alive(states).all())
    assert states.dtype == torch.float32
    assert set(named["there"].tolist()) == {0.0, 1.0}, "no lost mission is handed out"
    assert bool((named["clock"][named["there"] == 1] > 10).all())
    assert bool((named["x"][named["clock"] == 0].abs() <= 1).all())
    assert float((named["clock"] > 20).double().mean()) > 0.2
    late = (named["clock"] > 12) & (named["there"] == 0)
    assert float(named["x"][late].mean()) > 1.5, "the memory fits the position"


def test_missions_end_and_begin_anew(task: Task) -> None:
    supply = missions(task)
    for _ in range(60):
        supply.take(1024)
    assert supply.pool.shape == (POOL, len(task.system.names))
    clock = supply.pool[:, task.system.names.index("clock")]
    assert float(clock.max()) <= (task.compiled.mission or 0) + task.horizon + 1
    assert torch.equal(clock, supply.age.clamp(max=float(clock.max())))


def test_a_supply_goes_on_where_it_was(task: Task) -> None:
    one, other = missions(task), missions(task)
    one.take(1000)
    one.follow(one.take(10), steered(task, one.take(10)))
    generator = one.generator.get_state()
    other.restore({name: value.clone() for name, value in one.tensors().items()})
    other.generator.set_state(generator)
    for _ in range(5):
        assert torch.equal(one.take(GLIMPSES * POOL), other.take(GLIMPSES * POOL))


def test_followed_plans_carry_missions_on(task: Task) -> None:
    supply = missions(task)
    supply.take(1)
    state = torch.tensor([[1.5, 3.0, *(timer.initial for timer in task.compiled.timers)]])
    before = supply.pool.clone()
    supply.follow(state, torch.full((1, 8, 1), 5.0))
    (row,) = (supply.pool != before).any(1).nonzero()[:, 0].tolist()
    assert float(supply.pool[row, 0]) > 1.9
    assert float(supply.pool[row, task.system.names.index("clock")]) in (1, 2, 3, 4)


@pytest.mark.apart
def test_training_with_memory_resumes_bit_for_bit(task: Task) -> None:
    engine = resolve_config(task, TrainConfig(batch=32))

    def trained(trainer: Trainer, until: int) -> None:
        while trainer.step < until:
            if trainer.step % 4 == 0:
                trainer.validate()
            trainer.advance()

    whole = Trainer(task, engine, steps=12, device=CPU)
    trained(whole, 6)
    tensors = {name: value.clone() for name, value in whole.tensors().items()}
    facts = whole.facts()
    trained(whole, 12)
    again = Trainer(task, engine, steps=12, device=CPU)
    again.restore(tensors, facts)
    trained(again, 12)
    for name, value in whole.tensors().items():
        assert torch.equal(value, again.tensors()[name]), name


def test_only_memory_needs_missions(system: System) -> None:
    plain = task_of("spec p\nstate signal x [m]\nrequire a: always[0, T] x < 4 m", system)
    trainer = Trainer(plain, resolve_config(plain, TrainConfig(batch=8)), steps=2, device=CPU)
    assert isinstance(trainer.supply, Draws)


def test_kernel_and_torch_agree_on_memory(task: Task) -> None:
    generator = torch.Generator().manual_seed(7)
    states = missions(task).take(2000).double()
    plans = 10.0 * torch.rand(2000, task.horizon, 1, generator=generator, dtype=torch.float64) - 5.0
    judged = task.judge(states, plans)
    columns = task.system.rollout_columns(states, plans)
    for name in task.system.names:
        torch.testing.assert_close(judged.columns[name], columns[name], msg=name)
    torch.testing.assert_close(judged.requirements, task.graph.per_requirement_columns(columns, ops=TORCH))


# ----------------------------------------------------------------- deployment, verdicts


def deployed(task: Task, seeds: int = 6) -> DeploymentRecording:
    recorder = Recorder(4)
    guard = Guard(task, Steered(task), "none")
    simulate(guard, ModelWorld, Setting(tuple(range(seeds)), 4, 32), recorder)  # type: ignore[arg-type]
    recording = recorder.recording()
    assert recording is not None
    return recording


def test_deployment_carries_memory_from_the_true_states(task: Task) -> None:
    recording = deployed(task)
    columns = {name: recording.states[..., i].T for i, name in enumerate(task.system.names)}
    true = {name: columns[name] for name in ("x", "y")}
    again = augmented(task.compiled.timers, true)
    for name in task.system.names:
        np.testing.assert_array_equal(columns[name], again[name], err_msg=name)
        assert not (np.signbit(columns[name]) & (columns[name] == 0)).any(), "0 is written without a sign"


def test_what_was_driven_is_judged_as_it_was_written(task: Task) -> None:
    recording = deployed(task)
    executed = judge_executed(task, recording)
    monitor = Monitor(Spec.parse(Source("line.stl", MISSION)), dt=0.1, horizon=0.8)
    signals = {name: recording.states[..., i] for i, name in enumerate(task.system.names)}
    verdict = monitor.check(signals)
    for judgement in verdict.requirements:
        held = executed.rules[judgement.name].all(0)
        np.testing.assert_array_equal(held, judgement.holds.all(0), err_msg=judgement.name)
    assert executed.rules["there"].shape == (1, 24)
    assert bool(executed.rules["there"].all())


# ---------------------------------------------------------------------------- the pull


def row(task: Task, **values: float) -> Tensor:
    """One state, everything else as at the start."""
    start = {"x": 0.0, "y": 3.0, **{timer.name: timer.initial for timer in task.compiled.timers}}
    return torch.tensor([[{**start, **values}[name] for name in task.system.names]], dtype=torch.float64)


def test_the_goal_that_is_due_first_pulls(task: Task) -> None:
    plans = torch.stack([torch.full((8, 1), speed) for speed in (-2.0, 0.0, 2.0)]).double()

    def order(**values: float) -> list[int]:
        judged = task.judge(row(task, **values).expand(3, -1), plans)
        return task.cost(judged).argsort().tolist()

    assert order(clock=0) == [2, 1, 0], "right, to the first goal"
    assert order(clock=15, there=1, x=2.5) == [0, 1, 2], "left, to the second"
    assert float(task.cost(task.judge(row(task, clock=32, there=1, back=1), plans[:1]))) == 0.0


def test_of_two_ways_the_nearer_one_pulls(system: System) -> None:
    either = task_of(
        "spec e\nstate signal x [m]\n"
        "require e: eventually@[0 s, 3 s] x > 2 m or eventually@[0 s, 2 s] x < -1 m",
        system,
    )
    plans = torch.stack([torch.full((8, 1), speed) for speed in (-1.0, 1.0)]).double()
    names = [timer.name for timer in either.compiled.timers if timer.kind == "status"]

    def cheaper(**values: float) -> int:
        judged = either.judge(row(either, **values).expand(2, -1), plans)
        return int(either.cost(judged).argmin())

    assert cheaper(x=0.0) == 0
    assert cheaper(x=1.2) == 1
    assert cheaper(x=0.0, **{names[1]: -1.0}) == 1, "what is lost does not pull"
    done = either.judge(row(either, **{names[0]: 1.0}), plans[:1])
    assert float(either.cost(done)) == 0.0


def test_a_lost_mission_is_known(task: Task) -> None:
    assert bool(task.alive(row(task)))
    assert not bool(task.alive(row(task, clock=25, there=-1)))
    assert bool(task.alive(row(task, clock=25, there=1)))
