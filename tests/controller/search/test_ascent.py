"""Gradient steps on plans: never worse than what they begin with, within bounds, and the same each time."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from stlc.controller.problem.task import Task
from stlc.controller.search import ascent
from stlc.controller.search.ascent import APART, KEPT, GradientAscent
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from tests.controller.guard.test_prefix_shooting import F64, failing

ROOT = Path(__file__).parents[3]
TARGET = 0.01


def made(task: Task, *, by_torch: bool = False) -> GradientAscent:
    found = GradientAscent(task, torch.Generator().manual_seed(0), target=TARGET)
    if by_torch:
        found._native = None
    return found


def worth(task: Task, x: Tensor, plans: Tensor) -> Tensor:
    """Robustness of plans (agents, k, T, m) by the monitor: (agents, k)."""
    judged = task.judge(x.repeat_interleave(plans.shape[1], 0), plans.flatten(0, 1))
    below = torch.where(judged.safe >= -1e-6, judged.rho, judged.safe - APART)
    return torch.where(judged.rho >= -1e-6, judged.rho + APART, below).view(plans.shape[:2])


@pytest.fixture(scope="module")
def rover_task() -> Task:
    """One of the controls is a direction, which turns round."""
    spec = Spec.parse(File(ROOT / "specs" / "navigation.stl").read())
    return Task.of(spec, System.load(ROOT / "examples" / "rover.yaml"))


@pytest.mark.parametrize("by_torch", [False, True])
def test_plans_are_mended(car_task: Task, by_torch: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ascent, "STEPS", 10)
    x, plan = failing(car_task, 10.0, 120)
    x, plan = x[:16], plan[:16]
    refined = made(car_task, by_torch=by_torch).refine(x, plan[:, None])
    assert refined.shape == (len(x), KEPT, car_task.horizon, 1)
    assert refined.dtype == F64
    assert (car_task.judge(x, refined[:, 0]).rho >= -1e-6).double().mean() >= 0.5


@pytest.mark.apart
def test_it_is_never_worse_than_what_it_begins_with(car_task: Task, rover_task: Task) -> None:
    for task in (car_task, rover_task):
        x = task.sample(60, seed=4, dtype=F64)
        low, high = task.system.control_low.double(), task.system.control_high.double()
        guesses = low + (high - low) * torch.rand(
            60, 2, task.horizon, len(low), generator=torch.Generator().manual_seed(1), dtype=F64
        )
        refined = made(task).refine(x, guesses)
        assert (refined >= low).all()
        assert (refined <= high).all()
        value, before = worth(task, x, refined), worth(task, x, guesses)
        assert (value[:, 0] >= torch.minimum(value[:, 1], before.new_tensor(APART + TARGET))).all()
        assert (value[:, 0] >= before.amax(1).clamp(max=APART + TARGET)).all()
        assert (value[:, 0] > before.amax(1) + 0.01).any()


def test_no_more_is_changed_than_is_enough(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, 120)
    refinement = made(car_task)
    found = refinement.refine(x, plan[:, None])[:, 0]
    good = car_task.judge(x, found).rho >= TARGET
    assert good.double().mean() > 0.6
    less = found + (plan - found) / ascent.SHARES
    changed = (found - plan).abs().amax((1, 2)) > 0.1
    worse = car_task.judge(x, less).rho < TARGET
    whole = torch.from_numpy(refinement._eased(*(part.numpy() for part in (x, plan, found))))
    assert torch.equal(whole[good & worse], found[good & worse])
    assert (good & worse & changed).sum() > 10
    far = torch.full_like(plan, -10.0)
    brake = car_task.judge(x, far).rho >= TARGET
    eased = torch.from_numpy(refinement._eased(*(part[brake].numpy() for part in (x, plan, far))))
    assert (car_task.judge(x[brake], eased).rho >= TARGET).all()
    assert (eased > far[brake]).any()


@pytest.mark.apart
def test_a_direction_turns_round(rover_task: Task) -> None:
    turns = [control.squash == "angle" for control in rover_task.system.decl.controls]
    assert any(turns)
    refinement = made(rover_task)
    beyond = (refinement._high + 0.1 * refinement._span) * np.ones((1, 1, rover_task.horizon, 1))
    bounded = refinement._bounded(beyond)
    for i, turn in enumerate(turns):
        expected = refinement._low[i] + 0.1 * refinement._span[i] if turn else refinement._high[i]
        assert bounded[..., i] == pytest.approx(expected)


@pytest.mark.parametrize("name", ["car_task", "rover_task"])
def test_torch_and_the_kernel_say_the_same(name: str, request: pytest.FixtureRequest) -> None:
    task: Task = request.getfixturevalue(name)
    native, torchs = made(task), made(task, by_torch=True)
    if native._native is None:
        pytest.skip("there is no C compiler")
    x = task.sample(64, seed=7).double().numpy()
    u = native._low + native._span * np.random.default_rng(0).random((64, task.horizon, len(native._low)))
    (each, pull), (expected, slow) = native._judged(x, u), torchs._judged(x, u)
    np.testing.assert_allclose(each, expected, rtol=1e-6, atol=1e-6)
    by = np.random.default_rng(1).random(each.shape)
    same = np.isclose(pull(by), slow(by), rtol=1e-4, atol=1e-6).all((1, 2))
    assert same.mean() > 0.5  # the others have ties, in which either is a gradient


def test_who_is_alone_gets_the_same(car_task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    x, plan = failing(car_task, 10.0, 60)
    refinement = made(car_task)
    together = refinement.refine(x, plan[:, None])
    monkeypatch.setattr(ascent, "AGENTS", 7)
    assert torch.equal(together, refinement.refine(x, plan[:, None]))
    assert torch.equal(together[3:4], made(car_task).refine(x[3:4], plan[3:4, None]))


def test_without_time_the_best_of_the_beginnings_is_handed_on(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, 60)
    none = torch.zeros_like(plan)
    refined = made(car_task).refine(x, torch.stack((plan, none), 1), until=0.0)
    value = worth(car_task, x, refined)[:, 0]
    before = worth(car_task, x, torch.stack((plan, none), 1)).amax(1)
    assert (value >= before.clamp(max=APART + TARGET)).all()
    full = worth(car_task, x, made(car_task).refine(x, plan[:, None]))[:, 0]
    assert (full > value).any()


def test_states_that_are_no_numbers_leave_plans_that_are(car_task: Task) -> None:
    x, plan = failing(car_task, 10.0, 20)
    x[:3] = math.nan
    refined = made(car_task).refine(x, plan[:, None])
    assert torch.isfinite(refined).all()
    assert torch.equal(refined[3:], made(car_task).refine(x[3:], plan[3:, None]))


def test_nobody_gets_no_plans(car_task: Task) -> None:
    x, guesses = torch.zeros(0, len(car_task.system.names)), torch.zeros(0, 2, car_task.horizon, 1)
    assert made(car_task).refine(x, guesses).shape == (0, KEPT, car_task.horizon, 1)
