from __future__ import annotations

from pathlib import Path

import pytest
import torch

from stlc.controller.problem.environments import SATISFIED, Environments, reward_at_end
from stlc.controller.problem.native import NativeStep
from stlc.controller.problem.task import Task
from stlc.diagnostics import UsageError
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.source import Source

ROOT = Path(__file__).parents[3]


def episode(task: Task, reward: str) -> tuple[Environments, torch.Tensor, list]:
    made = Environments(task, 64, reward=reward, generator=torch.Generator().manual_seed(1))  # type: ignore[arg-type]
    start = made.states
    made.reset()
    first = made.states
    assert not torch.equal(start, first)
    action = torch.full((64, 1), -10.0)
    return made, first, [made.step(action) for _ in range(made.steps)]


def test_the_reward_is_the_robustness_of_the_episode(car_task: Task) -> None:
    made, first, steps = episode(car_task, "robustness")
    plans = torch.full((64, made.steps, 1), -10.0)
    rho = car_task.judge(first, plans, states=False).rho
    assert all(float(step.reward.abs().sum()) == 0.0 and not bool(step.done.any()) for step in steps[:-1])
    assert torch.equal(steps[-1].reward, rho.clamp(-10.0, 10.0).float())
    assert bool(steps[-1].done.all())
    assert steps[-1].final.shape == steps[-1].observation.shape == (64, made.width)
    assert steps[-1].final[:, -1].tolist() == [1.0] * 64
    assert steps[-1].observation[:, -1].tolist() == [0.0] * 64


def test_accuracy_rewards_satisfied_episodes_alone(car_task: Task) -> None:
    _, _, steps = episode(car_task, "accuracy")
    last = steps[-1]
    assert torch.equal(last.reward, SATISFIED * last.satisfied.float())
    assert 0 < int(last.satisfied.sum()) < 64


def test_what_is_not_a_number_is_violated() -> None:
    rho = torch.tensor([torch.nan, -torch.inf, -0.5, torch.inf])
    assert reward_at_end("robustness", rho).tolist() == [-10.0, -10.0, -0.5, 10.0]
    assert reward_at_end("accuracy", rho).tolist() == [0.0, 0.0, 0.0, SATISFIED]


def test_episodes_move_as_the_model_says(car_task: Task) -> None:
    made = Environments(car_task, 4, generator=torch.Generator().manual_seed(2))
    made.reset()
    before = made.states
    made.step(torch.full((4, 1), 99.0))
    torch.testing.assert_close(made.states, car_task.system.step(before, torch.full((4, 1), 10.0)))


RULE = "state signal x [m]\nrequire r: always[0, T] x < 9 m\n"
DRIFT = (
    "stlc: 1\nname: drift\ntime: {dt: 0.1 s, horizon: 3 steps}\nstate: {x: {unit: m, range: [-9, 9]}}\n"
    "control: {u: {unit: m/s, range: [-6, 6]}}\nflow: {x: 'u'}\ninit: {mixture: [{draw: {x: 0.5}}]}\n"
)


def drift(folder: Path, more: str) -> Task:
    (folder / "drift.yaml").write_text(DRIFT + more)
    return Task.of(Spec.parse(Source("r.stl", RULE)), System.load(folder / "drift.yaml"))


def test_the_declared_reward_is_that_of_the_state_after_each_step(tmp_path: Path) -> None:
    task = drift(tmp_path, "train: {reward: '10 * ind(x > 0.7 m) + x / (1 m) - abs(u) / (1 m/s)'}\n")
    made = Environments(task, 2, reward="task", generator=torch.Generator())
    made.reset()
    steps = [made.step(torch.tensor([[u], [-9.0]])) for u in (1.0, 9.0, 0.0)]
    assert torch.stack([step.reward for step in steps], 1).tolist() == [
        pytest.approx([0.6 - 1.0, 11.2 - 6.0, 11.2]),
        pytest.approx([-0.1 - 6.0, -0.7 - 6.0, -1.3 - 6.0]),
    ]
    assert steps[-1].satisfied.tolist() == [True, True]


def test_a_reward_of_controls_reads_what_actuators_get(tmp_path: Path) -> None:
    task = drift(tmp_path, "policy: {feedback: {gain: {u: {x: 2}}}}\ntrain: {reward: u / (1 m/s)}\n")
    made = Environments(task, 1, reward="task", generator=torch.Generator())
    made.reset()
    assert made.step(torch.zeros(1, 1)).reward.item() == pytest.approx(-1.0)


def test_a_reward_that_is_not_declared_is_an_error(tmp_path: Path) -> None:
    task = drift(tmp_path, "")
    with pytest.raises(UsageError, match="`drift` declares no reward"):
        Environments(task, 2, reward="task", generator=torch.Generator())
    with pytest.raises(UsageError, match="no reward `rho`"):
        Environments(task, 2, reward="rho", generator=torch.Generator())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "state", "reward"),
    [
        ("car", {"sign": 0, "x": 0.5, "tau": 0.5, "v": 4, "dx": -1}, -1000 + 2),
        ("car", {"sign": 0, "x": -0.4, "yielding": 1, "tau": 1, "v": 4, "dx": 5}, -100 + 2 + 2),
        ("car", {"sign": 1, "x": -0.4, "tau": 3, "v": 4, "dx": 0.5}, -100 - 50),
        ("car", {"sign": 1, "x": -4, "tau": 5, "v": 4, "dx": -1}, 2),
        ("maze", {"dy": -0.25, "x": 2, "x0": 1, "l0": 2, "g0": 2.1, "x1": 1, "l1": 3, "g1": -1}, 0),
        ("maze", {"dy": 2.25, "x": 2, "x0": 1, "l0": 2, "g0": 2, "x1": 3, "l1": 1, "g1": 2}, 100),
        ("ship_safe", {"y": 2.1, "x1": 0.5, "y1": 2, "r1": 1, "x2": 9, "r2": 1}, 10 - 200),
        ("ship_track", {"y": 0.4, "tau": -1, "x1": -5, "r1": 1}, 10 - 100),
        ("rover", {"x": 4, "y": 4, "xc": 4, "yc": 4.5, "tau_b": 3, "tau_s": -1}, 20),
        ("rover", {"x": 1, "y": -0.1, "xd": 1, "xc": 9, "yc": 9, "tau_b": -1, "tau_s": 0}, -200 + 10),
        ("panda", {"q[3]": -1, "q[5]": -1}, -100),
    ],
)
def test_rewards_of_the_paper(name: str, state: dict[str, float], reward: float) -> None:
    system = System.load(ROOT / "examples" / f"{name}.yaml")
    x = torch.tensor([[state.get(column, 0.0) for column in system.names]])
    assert system.reward(x, system.control_low[None]).item() == pytest.approx(reward)


def of_benchmark(name: str) -> Task:
    path = ROOT / "specs" / f"{name}.stl"
    spec = Spec.parse(File(path).read())
    assert spec.system is not None
    return Task.of(spec, System.load(File(spec.system).system(path)))


BENCHMARKS = ("traffic", "reach_n_avoid", "ship_safe", "ship_track", "navigation", "manipulation")


@pytest.mark.parametrize("name", BENCHMARKS)
def test_steps_in_c_are_those_of_torch(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    task, made = of_benchmark(name), []
    for native in (True, False):
        if not native:
            monkeypatch.setattr(NativeStep, "of", lambda *_, **__: None)
        generator = torch.Generator().manual_seed(5)
        made.append(Environments(task, 37, reward="task", generator=generator))
    assert made[0]._native is not None
    torch.testing.assert_close(made[0].reset(), made[1].reset())
    generator = torch.Generator().manual_seed(6)
    for _ in range(made[0].steps + 3):
        shape = (37, len(task.system.control_names))
        low, high = task.system.control_low, task.system.control_high
        action = low + (high - low) * torch.rand(shape, generator=generator)
        ours, theirs = (each.step(action) for each in made)
        for field in ("states", "final", "observation", "reward", "rho", "done"):
            torch.testing.assert_close(getattr(ours, field), getattr(theirs, field), equal_nan=True)


def test_a_mission_observes_its_timers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "drift.yaml").write_text(DRIFT + "policy: {observe: [2 * x]}\n")
    rule = "state signal x [m]\nrequire r: eventually@[0 s, 1 s] x > 0.7 m\n"
    task = Task.of(Spec.parse(Source("r.stl", rule)), System.load(tmp_path / "drift.yaml"))
    made = [Environments(task, 3, generator=torch.Generator())]
    assert made[0]._native is not None
    monkeypatch.setattr(NativeStep, "of", lambda *_, **__: None)
    made.append(Environments(task, 3, generator=torch.Generator()))
    for each in made:
        each.reset()
    for _ in range(3):
        ours, theirs = (each.step(torch.tensor([[1.0], [2.0], [3.0]])) for each in made)
        torch.testing.assert_close(ours.final, theirs.final)
        assert ours.final.shape[1] == 2 + len(task.system.timers) > 2


def test_episodes_begin_where_they_are_told_and_repeat_with_their_seed(car_task: Task) -> None:
    made = Environments(car_task, 4, generator=torch.Generator(), ahead=64)
    given = car_task.sample(4, seed=9, dtype=torch.float64)
    made.reset(given)
    assert torch.equal(made.states, given)
    starts = []
    for _ in range(2):
        made.seed(7)
        starts.append((made.reset(), made.reset()))
    assert torch.equal(starts[0][0], starts[1][0])
    assert torch.equal(starts[0][1], starts[1][1])
    assert not torch.equal(*starts[0])
