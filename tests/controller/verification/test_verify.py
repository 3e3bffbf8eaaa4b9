"""Proofs on boxes of initial states: bounds, modes, counterexamples, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.controller.policies.policy import BestOfKPolicy, PlanNetwork
from stlc.controller.problem.task import Task
from stlc.controller.verification.boxes import Unsupported, modes_of
from stlc.controller.verification.forms import Forms
from stlc.controller.verification.network import PlanBounds
from stlc.controller.verification.verify import Box, Verification, Verifier
from stlc.diagnostics import UsageError
from stlc.dynamics.declaration.init import InitDecl, Situation
from stlc.dynamics.declaration.motion import Assign
from stlc.dynamics.model.system import System
from stlc.files import read_source
from stlc.grammar.parse.parser import parse

ROOT = Path(__file__).parents[3]


@cache
def task_of(spec: str, system: str) -> Task:
    files = ROOT / "specs" / f"{spec}.stl", ROOT / "examples" / f"{system}.yaml"
    return Task.of(parse(read_source(files[0])), System.load(files[1]))


@cache
def policy() -> BestOfKPolicy:
    """A small network with random weights, whose first proposal brakes hard and whose second does little."""
    task = task_of("traffic", "car")
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(5)
        network = PlanNetwork(task, hidden=(24, 16), plans=2, varied=True).eval()
        network.normalise(task.sample(500, seed=1))
        last = network.body[-1]
        last.weight *= 0.3
        last.bias.view(2, -1)[0] -= 0.8
    return BestOfKPolicy(task, network)


@cache
def verifier() -> Verifier:
    return Verifier(policy().task, policy(), seed=1)


@cache
def verified() -> Verification:
    return verifier().run(1e6, boxes=100)


def small_boxes(rng: np.random.Generator, count: int, coordinates: int) -> list[Box]:
    half = 0.5 * 10.0 ** rng.uniform(-3, -0.5, (count, coordinates))
    centre = rng.uniform(half, 1.0 - half)
    return [Box(*each) for each in zip(centre, half, strict=True)]


@pytest.mark.parametrize("number", range(7))
@pytest.mark.parametrize("index", [0, 1])
def test_bounds_are_below_the_robustness_of_every_sampled_state(number: int, index: int) -> None:
    found, task = verifier(), policy().task
    mode, rng = found.modes[number], np.random.default_rng(number)
    boxes = small_boxes(rng, 40, len(mode.coordinates))
    low, effects = found.bound(mode, boxes, index)
    assert effects.shape == (40, len(mode.coordinates))
    known = np.isfinite(low)
    for _ in range(5):
        at = np.stack(
            [box.centre + rng.choice([-1, 1, rng.uniform(-1, 1)], len(box.half)) * box.half for box in boxes]
        )
        x0 = found.states(mode, at)
        with torch.no_grad():
            plans = policy().candidates(x0)[:, index].double()
        rho = task.judge(x0, plans).rho.numpy()
        assert (low <= rho + 1e-9)[known].all()
    if number in (0, 1, 4, 5):
        assert known.sum() > 10


def test_random_states_of_proved_boxes_satisfy_the_specification() -> None:
    proved = [(each, box) for each in verified().modes for box in each.boxes]
    assert len(proved) > 10
    rng = np.random.default_rng(2)
    for each, box in (proved[i] for i in rng.choice(len(proved), 10, replace=False)):
        at = box.centre + rng.uniform(-1, 1, (200, len(box.half))) * box.half
        assert (verifier().robustness(verifier().states(each.mode, at)) >= -1e-6).all()


@pytest.mark.bench
def test_many_random_states_of_every_proved_box() -> None:
    rng = np.random.default_rng(3)
    for each in verified().modes:
        for box in each.boxes:
            at = box.centre + rng.uniform(-1, 1, (10_000, len(box.half))) * box.half
            assert (verifier().robustness(verifier().states(each.mode, at)) >= -1e-6).all()


def test_the_shares_of_a_mode_add_up() -> None:
    found = verified()
    assert found.proved + found.refuted + found.open == pytest.approx(1.0)
    for each in found.modes:
        assert each.proved + each.refuted + each.open == pytest.approx(1.0)
        assert each.proved == pytest.approx(sum(box.volume for box in each.boxes))
    assert found.proved > 0.02


def test_a_witness_violates_the_specification() -> None:
    task = policy().task
    witnesses = [each.witness for each in verified().modes if each.witness is not None]
    assert witnesses
    for witness in witnesses:
        x0 = torch.tensor([[witness.state[name] for name in task.system.names]], dtype=torch.float64)
        assert float(policy().plan_judged(x0)[1].rho[0]) == pytest.approx(witness.robustness)
        assert witness.robustness < 0


def test_the_same_seed_gives_the_same_result() -> None:
    one, other = (Verifier(policy().task, policy(), seed=4).run(1e6, boxes=2) for _ in range(2))
    assert [each.proved for each in one.modes] == [each.proved for each in other.modes]
    assert [each.examined for each in one.modes] == [each.examined for each in other.modes]


def test_no_time_proves_nothing() -> None:
    found = verifier().run(0.0)
    assert (found.proved, found.open) == (0.0, pytest.approx(1.0))


# ------------------------------------------------------------------------------------ parts


@pytest.mark.parametrize("width", [0.0, 1e-3, 0.1])
def test_plans_stay_within_their_forms(width: float) -> None:
    network, task = policy().network, policy().task
    bounds, rng = PlanBounds(network, task), np.random.default_rng(3)
    centre = task.sample(6, seed=2).double().numpy()
    generators = rng.normal(size=(4, *centre.shape)) * width
    observed = [Forms(centre[:, i], generators[:, :, i], np.zeros(6)) for i in range(centre.shape[1])]
    for index in range(2):
        plan = bounds.plan(observed, index)
        for _ in range(10):
            symbols = rng.uniform(-1, 1, 4)
            x0 = torch.from_numpy(centre + np.tensordot(symbols, generators, 1))
            with torch.no_grad():
                exact = network(x0)[:, index].double().numpy()
            for step, forms in enumerate(plan):
                for i, form in enumerate(forms):
                    rest = np.abs(form.generators[4:]).sum(0) + form.rest
                    linear = form.centre + np.tensordot(symbols, form.generators[:4], 1)
                    assert (np.abs(exact[:, step, i] - linear) <= rest).all()
                    assert width or (rest < 1e-2).all()


def test_modes_are_the_whole_distribution() -> None:
    found, task = verifier(), policy().task
    assert sum(mode.weight for mode in found.modes) == pytest.approx(1.0)
    assert [len(mode.coordinates) for mode in found.modes] == [2, 2, 4, 4, 3, 3, 5]
    rng = np.random.default_rng(1)
    states = [found.states(mode, rng.random((2000, len(mode.coordinates)))).numpy() for mode in found.modes]
    mean = sum(mode.weight * each.mean(0) for mode, each in zip(found.modes, states, strict=True))
    drawn = task.sample(20_000, seed=3).double().numpy()
    np.testing.assert_allclose(mean, drawn.mean(0), atol=0.15)
    for each in states:
        assert each.min(0)[4] >= -1.0


def test_a_split_box_is_its_two_halves() -> None:
    box = Box(np.array([0.5, 0.25]), np.array([0.5, 0.25]))
    left, right = box.split(0)
    assert (left.volume, right.volume) == (0.25, 0.25)
    assert (left.centre[0] + left.half[0], right.centre[0] - right.half[0]) == (0.5, 0.5)


@pytest.mark.parametrize(
    ("spec", "system"), [("ship_safe", "ship_safe"), ("navigation", "rover"), ("manipulation", "panda")]
)
def test_what_is_not_supported_is_refused_with_a_reason(spec: str, system: str) -> None:
    task = task_of(spec, system)
    network = PlanNetwork(task, hidden=(8,), plans=2)
    with pytest.raises(UsageError, match="cannot be verified"):
        Verifier(task, BestOfKPolicy(task, network))


def assign(name: str, value: ir.Num) -> Assign:
    return replace(policy().task.system.decl.init.mixture[0].draws[0], name=name, value=value)


def situation(*draws: Assign) -> InitDecl:
    return InitDecl((Situation("only", 2.0, draws),))


def uniform(low: ir.Num, high: ir.Num) -> ir.Num:
    return ir.Op("uniform", (low, high))


def test_a_draw_within_a_draw_is_one_draw() -> None:
    inner = uniform(ir.Const(0.0), ir.Const(1.0))
    outer = uniform(inner, ir.Op("add", (inner, ir.Const(1.0))))
    (mode,) = modes_of(situation(assign("a", outer), assign("b", ir.Op("add", (inner, inner)))))
    assert mode.coordinates == ("#0", "#1", "#2")
    at = {name: np.array([value]) for name, value in zip(mode.coordinates, (0.25, 0.5, 0.75), strict=True)}
    a, b = mode.states({**at, "": np.zeros(1)}, ("a", "b"), NUMPY)
    assert (float(a[0]), float(b[0])) == (0.75, 1.5)


def test_bernoulli_makes_two_modes() -> None:
    found = modes_of(situation(assign("a", ir.Op("bernoulli", (ir.Const(0.25),)))))
    assert [(mode.weight, mode.name) for mode in found] == [(0.25, "only, a"), (0.75, "only, not a")]
    assert [float(mode.states({"": np.zeros(1)}, ("a",), NUMPY)[0][0]) for mode in found] == [1.0, 0.0]


@pytest.mark.parametrize(
    "value",
    [
        ir.Op("normal", (ir.Const(0.0), ir.Const(1.0))),
        ir.Op("add", (ir.Op("bernoulli", (ir.Const(0.5),)), ir.Const(1.0))),
    ],
)
def test_other_draws_are_refused(value: ir.Num) -> None:
    with pytest.raises(Unsupported):
        modes_of(situation(assign("a", value)))


def test_points_have_no_boxes() -> None:
    with pytest.raises(Unsupported, match=r"points|where|coordinate"):
        modes_of(task_of("reach_n_avoid", "maze").system.decl.init)
