from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.traffic_drivers import careful
from torch import Tensor

from stlc.controller.deployment.batched import Setting
from stlc.controller.deployment.simulator import DeploymentRecording, Recorder, simulate
from stlc.controller.evaluation.archive import save_scene, save_trace_of
from stlc.controller.evaluation.deployment import (
    InterruptedDeploymentError,
    decided,
    deploy,
    feasible_states,
)
from stlc.controller.evaluation.executed import judge_executed
from stlc.controller.evaluation.metrics import METRICS, measure
from stlc.controller.evaluation.stats import MeanInterval, student
from stlc.controller.guard.guard import Guard, GuardDecision
from stlc.controller.policies.policy import BestOfKPolicy, Policy
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.search.feasibility import solvable
from stlc.diagnostics import MissingError, RunError, SystemFileError
from stlc.monitor.verdict import Monitor
from stlc.rundir import RunDir
from stlc.trace import Trace

SETTING = Setting(seeds=(0, 1), agents=6, steps=40)


class Careful(Policy):
    """The rule-based driver as a policy: its first action, then coasting to a halt."""

    def candidates(self, x0: Tensor) -> Tensor:
        plan = torch.full((len(x0), 1, self.task.horizon, 1), -2.0, dtype=x0.dtype)
        plan[:, 0, 0] = careful(x0.double())
        return plan


@pytest.fixture(scope="module")
def recorded(car_task: Task) -> DeploymentRecording:
    from stlc.controller.world import world_type

    recorder = Recorder(SETTING.agents)
    simulate(Guard(car_task, Careful(car_task)), world_type(car_task.system.decl), SETTING, recorder)
    found = recorder.recording()
    assert found is not None
    return found


# ---------------------------------------------------------------------- closed loop


def test_shapes_of_a_recording(recorded: DeploymentRecording) -> None:
    assert recorded.states.shape == (12, 41, 7)
    assert recorded.actions.shape == (12, 40, 1)
    assert {recorded.source.shape, recorded.t0.shape, recorded.rho.shape, recorded.safe.shape} == {(12, 40)}
    assert len(recorded.progress) == 2
    assert recorded.scene["pose"].shape == (41, 6, 3)
    assert np.array_equal(recorded.scene["decision"][:-1].T, recorded.source[:6])


def test_seeds_are_independent_of_each_other(car_task: Task, recorded: DeploymentRecording) -> None:
    alone = deploy(car_task, Careful(car_task), Setting((1,), 6, 40), "paper").recording
    assert np.array_equal(alone.states, recorded.states[6:])


def test_actions_are_held_between_plans(car_task: Task) -> None:
    found = deploy(car_task, Careful(car_task), Setting((0,), 3, 12, replan=4), "none").recording
    assert np.array_equal(found.rho[:, 0], found.rho[:, 3])
    assert (found.actions[:, 1:4] == -2.0).all()


class Signals:
    """Cars that nobody moves, one of which is told at every fifth step that the light has changed."""

    def __init__(self, system: Any, agents: int, generator: torch.Generator) -> None:
        self.x = system.sample(agents, generator=generator, dtype=torch.float64)
        self.sign, self.step = system.names.index("sign"), 0

    def reset(self) -> Tensor:
        return self.x

    def advance(self, x: Tensor, action: Tensor) -> Tensor:
        self.step, moved = self.step + 1, x + 0.0 * action[:, :1]
        if self.step % 5 == 0:
            moved[1, self.sign] = 1.0 - moved[1, self.sign]
        return moved

    def options(self) -> Tensor:
        """A second option that nobody takes for long: the car stands far before the line."""
        return torch.stack((self.x, self.x), 1)

    def choose(self, pick: Tensor) -> Tensor:
        self.picks = [*getattr(self, "picks", []), pick.tolist()]
        return self.x

    def progress(self) -> Mapping[str, float]:
        return {}

    units = progress

    def snapshot(self) -> Mapping[str, Any]:
        return {"x": np.zeros(1)}

    def draw(self, axes: Any, scene: Any, index: int) -> None: ...


def test_who_is_told_something_plans_at_once(car_task: Task) -> None:
    asked: list[int] = []

    class Counting(Guard):
        def decide(self, x: Tensor, begun: GuardDecision | None = None) -> GuardDecision:
            asked.append(len(x))
            return super().decide(x, begun)

    class Silent(Signals):
        options = choose = None  # type: ignore[assignment]

    guard, recorder = Counting(car_task, Careful(car_task), "none"), Recorder(3)
    simulate(guard, Silent, Setting((0,), 3, 12, replan=4), recorder)
    assert asked == [3, 3, 1, 3, 1]  # steps 0, 4, 5, 8, 10
    found = recorder.recording()
    assert found is not None
    assert (found.actions[0, 1:4] == -2.0).all()
    assert found.options is None


def test_agents_choose_when_they_plan(car_task: Task) -> None:
    worlds: list[Signals] = []

    def make(*arguments: Any) -> Signals:
        worlds.append(Signals(*arguments))
        return worlds[-1]

    recorder = Recorder(3)
    simulate(Guard(car_task, Careful(car_task), "none"), make, Setting((0,), 3, 4, replan=2), recorder)  # type: ignore[arg-type]
    assert worlds[0].picks == [[0, 0, 0]] * 4
    found = recorder.recording()
    assert found is not None
    assert found.options is not None
    assert found.options.shape == (3, 4, 2, 7)


class Failing:
    """A world that goes wrong at some step."""

    def __init__(self, how: str, at: int, task: Task) -> None:
        self.how, self.at, self.task, self.step = how, at, task, 0

    def __call__(self, system: Any, agents: int, generator: torch.Generator) -> Failing:
        self.x = system.sample(agents, generator=generator, dtype=torch.float64)
        return self

    def reset(self) -> Tensor:
        return self.x

    def advance(self, x: Tensor, action: Tensor) -> Tensor:
        self.step += 1
        moved = self.task.system.step(x, action)
        if self.step < self.at:
            return moved
        if self.how == "raise":
            raise ZeroDivisionError("no road")
        return moved * torch.nan if self.how == "nan" else moved[:, :3]

    def progress(self) -> Mapping[str, float]:
        return {}

    units = progress

    def snapshot(self) -> Mapping[str, Any]:
        return {"x": np.zeros(1)}

    def draw(self, axes: Any, scene: Any, index: int) -> None: ...


@pytest.mark.parametrize(("how", "code"), [("raise", "S207"), ("nan", "S302"), ("shape", "S207")])
def test_a_world_that_fails_leaves_what_happened_until_then(
    car_task: Task, monkeypatch: pytest.MonkeyPatch, how: str, code: str
) -> None:
    monkeypatch.setattr(
        "stlc.controller.evaluation.deployment.world_type", lambda _decl: Failing(how, 5, car_task)
    )
    with pytest.raises(InterruptedDeploymentError) as caught:
        deploy(car_task, Careful(car_task), Setting((0,), 4, 10), "none")
    cause = caught.value.__cause__
    assert isinstance(cause, SystemFileError)
    assert cause.diagnostics[0].code == code
    assert caught.value.recording is not None
    assert caught.value.recording.steps == 4


def test_a_policy_that_gives_no_number_is_told(car_task: Task) -> None:
    class Broken(Policy):
        def candidates(self, x0: Tensor) -> Tensor:
            return torch.full((len(x0), 1, car_task.horizon, 1), torch.nan)

    with pytest.raises(InterruptedDeploymentError) as caught:
        deploy(car_task, Broken(car_task), Setting((0,), 2, 5), "none")
    assert isinstance(caught.value.__cause__, RunError)
    assert caught.value.__cause__.diagnostics[0].code == "R402"
    assert caught.value.recording is None
    guarded = deploy(car_task, Broken(car_task), Setting((0,), 2, 5), "paper")
    assert guarded.decisions["policy"] == 0.0


# ------------------------------------------------------------------------- verdicts


def test_executed_verdicts_are_those_of_the_monitor(car_task: Task, recorded: DeploymentRecording) -> None:
    executed = judge_executed(car_task, recorded)
    signals = {name: recorded.states[..., i] for i, name in enumerate(car_task.system.names)}
    monitor = Monitor(
        car_task.compiled.spec, dt=car_task.system.dt, horizon=car_task.horizon * car_task.system.dt
    )
    verdict = monitor.check(signals)
    assert {judgement.name for judgement in verdict} == set(executed.rules)
    for judgement in verdict:
        assert np.array_equal(judgement.holds, executed.rules[judgement.name])
    everything = tuple(executed.rules)
    assert int(executed.agents(everything).sum()) == verdict.satisfied_traces
    assert float(executed.starts(everything).mean()) == pytest.approx(verdict.share)


def test_what_was_foreseen_went_as_the_model_says(car_task: Task, recorded: DeploymentRecording) -> None:
    executed = judge_executed(car_task, recorded)
    assert 0 < executed.consistent.mean() < 1
    for start, row in np.argwhere(executed.consistent)[::17]:
        window = slice(start, start + car_task.horizon)  # one step each: rounding decides who stops
        x, u = (torch.from_numpy(each[row, window]) for each in (recorded.states, recorded.actions))
        predicted = car_task.rollout(x, u[:, None])[:, 1]
        happened = recorded.states[row, start + 1 : start + car_task.horizon + 1]
        assert predicted.numpy() == pytest.approx(happened, abs=1e-4)


def test_metrics_are_means_over_seeds(car_task: Task, recorded: DeploymentRecording) -> None:
    metrics = measure(recorded, judge_executed(car_task, recorded))
    assert set(METRICS) - set(metrics) == {"feasible", "feasible_followed"}
    assert len(metrics["plan_accuracy"].values) == 2
    accuracy = [(recorded.rho[rows] >= -1e-6).mean() for rows in (slice(0, 6), slice(6, 12))]
    assert metrics["plan_accuracy"].values == pytest.approx(tuple(accuracy))
    assert metrics["mean_speed"].mean == pytest.approx(np.mean([p["mean_speed"] for p in recorded.progress]))
    shares = decided(recorded)
    assert sum(shares[name] for name in ("policy", "backup", "safest")) == pytest.approx(1.0)


def test_the_ceiling_is_searched_for_in_visited_states(car_task: Task, recorded: DeploymentRecording) -> None:
    assert np.isnan(feasible_states(car_task, recorded, 0)).all()
    some = feasible_states(car_task, recorded, 60)
    validated, good = np.isfinite(some), recorded.rho >= -1e-6
    assert validated.sum() == 60
    assert (some[validated & good] == 1.0).all()
    open_ = validated & ~good
    found = solvable(car_task, torch.from_numpy(recorded.states[:, :-1][open_])).numpy()
    assert np.array_equal(some[open_], found)
    assert open_.sum() > 0
    metrics = measure(recorded, judge_executed(car_task, recorded), some)
    rows = slice(6, 12)
    assert metrics["feasible"].values[1] == pytest.approx(np.nanmean(some[rows]))
    assert metrics["feasible_followed"].values[1] == pytest.approx(good[rows][some[rows] == 1.0].mean())


def test_a_deployment_shorter_than_a_window_has_no_executed_starts(
    car_task: Task, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stlc.controller.evaluation.deployment.LATENCY_SECONDS", 60.0)
    found = deploy(car_task, Careful(car_task), Setting((0, 1), 2, 3), "none")
    assert "executed_starts" not in found.metrics
    assert "plan_accuracy" in found.metrics
    assert found.latency.samples == 12


# ------------------------------------------------------------------------ intervals


@pytest.mark.parametrize(
    ("freedom", "t"), [(1, 12.7062), (2, 4.30265), (3, 3.18245), (4, 2.77645), (9, 2.26216), (29, 2.04523)]
)
def test_quantiles_of_student(freedom: int, t: float) -> None:
    assert student(freedom) == pytest.approx(t, rel=1.3e-3)


def test_an_interval_covers_the_mean_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    found = [MeanInterval.of(sample.tolist()) for sample in rng.normal(3.0, 2.0, (4000, 10))]
    covered = np.mean([interval.low <= 3.0 <= interval.high for interval in found])  # type: ignore[operator]
    assert covered == pytest.approx(0.95, abs=0.012)


def test_one_seed_has_no_interval() -> None:
    single = MeanInterval.of([0.5])
    assert (single.mean, single.low, single.high, single.half) == (0.5, None, None, None)
    assert MeanInterval.of([1.0, math.inf]).half is None
    assert MeanInterval.of([2.0, 2.0, 2.0]).half == 0.0


# -------------------------------------------------------------------------- on disk


def test_a_trace_carries_its_decisions_and_where_it_is_from(
    car_task: Task, car_run: RunDir, recorded: DeploymentRecording, tmp_path: Path
) -> None:
    run = Run(car_run, car_task, BestOfKPolicy(car_task, None))  # type: ignore[arg-type]
    paths = save_trace_of(run, recorded, SETTING, tmp_path / "also.npz")
    for path in paths:
        trace = Trace.load(path)
        assert trace.traces == 12
        assert trace.meta.spec_text == (car_run.path / "spec.stl").read_text()
        assert trace.meta.run == car_run.name
        assert trace.meta.horizon == 25
        assert np.array_equal(trace.data["v"], recorded.states[..., 1])
        assert np.array_equal(trace.extras["decision"], recorded.source)
        assert np.array_equal(trace.extras["action.u"], recorded.actions[..., 0])
        assert trace.extras["seed"].tolist() == [0] * 6 + [1] * 6
        assert trace.extras["agent"].tolist() == [*range(6)] * 2


def test_a_scene_is_read_back_without_pickle(recorded: DeploymentRecording, tmp_path: Path) -> None:
    save_scene(tmp_path / "scene.npz", recorded.scene)
    with np.load(tmp_path / "scene.npz", allow_pickle=False) as scene:
        assert np.array_equal(scene["pose"], recorded.scene["pose"])
    (tmp_path / "taken").write_text("")
    with pytest.raises(MissingError):
        save_scene(tmp_path / "taken" / "scene.npz", recorded.scene)
