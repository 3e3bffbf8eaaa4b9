"""Proofs on boxes of initial states: bounds, modes, counterexamples, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.small_policies import half_seen_task, policy, task_of

from stlc.assurance.verification.boxes import Box, Unsupported, modes_of
from stlc.assurance.verification.forms import Forms
from stlc.assurance.verification.network import PlanBounds
from stlc.assurance.verification.plans import ProposedPlans
from stlc.assurance.verification.verify import Verification, Verifier
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.controller.policies.policy import BestOfKPolicy, ModelRollout, PlanNetwork
from stlc.controller.problem.task import Task
from stlc.diagnostics import UsageError
from stlc.dynamics.declaration.init import GridDecl, InitDecl, Situation
from stlc.dynamics.declaration.motion import Assign
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source


@cache
def verifier() -> Verifier:
    return Verifier(ProposedPlans(policy().task, policy()), seed=1)


@cache
def verified() -> Verification:
    return verifier().run(1e6, boxes=12)


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
    bounds = found.bound(mode, boxes, index)
    low, effects = bounds.low, bounds.effects
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
    assert len(proved) > 4
    rng = np.random.default_rng(2)
    for each, box in proved:
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
    one, other = (
        Verifier(ProposedPlans(policy().task, policy()), seed=4).run(1e6, boxes=2) for _ in range(2)
    )
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
        plan = bounds.plan(observed, index, 4)
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


OTHERS = [
    ("ship_safe", "ship_safe", 3e-3),
    ("ship_track", "ship_track", 3e-3),
    ("manipulation", "panda", 3e-3),
    ("reach_n_avoid", "maze", 1e-3),
    pytest.param("navigation", "rover", 1e-3, marks=pytest.mark.apart),
]


@cache
def other_verifier(spec: str, system: str) -> Verifier:
    """Verifier of a small network with random weights, for a benchmark that is not `traffic`."""
    task = task_of(spec, system)
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = PlanNetwork(task, hidden=(16, 12), plans=2).eval()
        network.normalise(task.sample(300, seed=1))
    return Verifier(ProposedPlans(task, BestOfKPolicy(task, network)), seed=1)


@pytest.mark.apart
@pytest.mark.parametrize(("spec", "system", "width"), OTHERS)
def test_bounds_on_other_benchmarks_are_below_the_robustness(spec: str, system: str, width: float) -> None:
    found, rng = other_verifier(spec, system), np.random.default_rng(4)
    plans = found.plans
    for mode in found.modes[:: max(1, len(found.modes) // 2)][:2]:
        coordinates = len(mode.coordinates)
        centre = rng.uniform(width, 1.0 - width, (24, coordinates))
        boxes = [Box(each, np.full(coordinates, 0.5 * width)) for each in centre]
        index = np.arange(24) % 2
        bounds = plans.bound(mode, boxes, index)
        assert np.isfinite(bounds.low).sum() > 4
        for _ in range(4):
            at = centre + rng.choice([-0.5, 0.5, 0.2], centre.shape) * width
            rho = plans.choices(plans.states(mode, at))[np.arange(24), index]
            assert (bounds.low <= rho + 1e-9).all()
            assert (bounds.high >= rho - 1e-9).all()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_states_that_the_policy_does_not_see_keep_their_symbols(tmp_path: Path, sign: float) -> None:
    task = half_seen_task(tmp_path)
    network = PlanNetwork(task, hidden=(2,), plans=1).eval()
    with torch.no_grad():  # the control is 0.5 - |y| or the negative
        network.body[0].weight.copy_(torch.tensor([[1.0], [-1.0]]))
        network.body[0].bias.zero_()
        network.body[-1].weight.copy_(torch.tensor([[-sign, -sign]]) / 9)
        network.body[-1].bias.fill_(sign * 0.5 / 9)
    plans = ProposedPlans(task, BestOfKPolicy(task, network))
    mode, whole = plans.modes[0], Box(np.full(2, 0.5), np.full(2, 0.5))
    bounds = plans.bound(mode, [whole], 0)
    rho = plans.robustness(plans.states(mode, np.random.default_rng(0).random((1000, 2))))
    assert bounds.low[0] <= rho.min() < -0.2
    assert bounds.high[0] >= rho.max()


def test_a_mirrored_box_is_the_image_of_its_mirror_image() -> None:
    plans = other_verifier("ship_safe", "ship_safe").plans
    mode, half = plans.modes[0], np.full(8, 1e-3)
    at = np.array([0.7, 0.4, 0.5, 0.6, 0.3, 0.9, 0.2, 0.6])
    image = at.copy()
    image[[0, 1, 3, 4, 6, 7]] = 1.0 - at[[0, 1, 3, 4, 6, 7]]  # y, psi, v, r, y1, y2
    found = plans.bound(mode, [Box(at, half), Box(image, half)], 0)
    assert np.isfinite(found.low).all()
    assert found.low[0] == pytest.approx(found.low[1])


TURNING = """
stlc: 1
name: turning
time: {dt: 1 s, horizon: 1 steps, discrete: true}
state:
  x: {range: [-1, 1]}
  h: {range: [-9, 9]}
control:
  a: {range: [-3.141592653589793, 3.141592653589793], squash: angle}
flow:
  h: a
init:
  mixture:
    - draw: {x: "uniform(-1, 1)", h: 0}
policy:
  mirror: {x: -x, a: 3.141592653589793 - a}
"""


@pytest.mark.parametrize("angle", [-2.0, 0.0, 1.0])
def test_mirrored_angles_are_wrapped_into_a_turn(tmp_path: Path, angle: float) -> None:
    (tmp_path / "turning.yaml").write_text(TURNING)
    text = Source("turning.stl", "signal x, h\nrequire r: always[0 s, 1 s] h < 2")
    task = Task.of(Spec.parse(text), System.load(tmp_path / "turning.yaml"))
    network = PlanNetwork(task, hidden=(2,), plans=1).eval()
    with torch.no_grad():
        network.body[-1].weight.zero_()
        network.body[-1].bias.copy_(torch.tensor([np.cos(angle), np.sin(angle)]))
    plans = ProposedPlans(task, BestOfKPolicy(task, network))
    at = np.array([[0.25], [0.75]])  # one is seen in the mirror
    bounds = plans.bound(plans.modes[0], [Box(each, np.full(1, 0.1)) for each in at], 0)
    rho = plans.robustness(plans.states(plans.modes[0], at))
    assert (bounds.low <= rho).all()
    assert (bounds.high >= rho).all()
    assert (bounds.high - bounds.low < (1e-3 if angle else 7.0)).all()  # 0 is mirrored to the end of the turn


def test_a_box_on_both_sides_of_a_mirror_is_not_proved() -> None:
    plans = other_verifier("ship_safe", "ship_safe").plans
    at = np.full(8, 0.5)
    assert plans.bound(plans.modes[0], [Box(at, np.full(8, 1e-6))], 0).low[0] == -np.inf


def test_the_share_that_meets_where_is_bounded_from_above() -> None:
    mode = other_verifier("ship_safe", "ship_safe").modes[0]
    plans, rng = other_verifier("ship_safe", "ship_safe").plans, np.random.default_rng(0)
    share = plans.admits(mode, rng.random((20_000, 8))).mean()
    assert share - 0.01 < plans.acceptance(mode) < share + 0.02
    assert verifier().plans.acceptance(verifier().modes[0]) == 1.0


def test_conditions_of_a_box_hold_for_its_states() -> None:
    found, rng = other_verifier("ship_track", "ship_track"), np.random.default_rng(2)
    mode, plans = found.modes[20], found.plans
    boxes = small_boxes(rng, 200, len(mode.coordinates))
    truth = mode.truths(boxes, plans.names)
    assert 0 < truth.sure.sum() < 200
    for _ in range(5):
        at = np.stack([box.centre + rng.uniform(-1, 1, len(box.half)) * box.half for box in boxes])
        met = plans.admits(mode, at)
        assert met[truth.sure].all()
        assert not met[~truth.possible].any()


@pytest.mark.apart
def test_boxes_around_states_contain_them_and_are_sound() -> None:
    rng = np.random.default_rng(5)
    found = verifier().around(10, seed=2)
    assert sum(each.states for each in found) == 10
    assert sum(each.proved for each in found) > 5
    for each in found:
        assert each.proved + each.violated <= each.states
        for box in each.boxes[:3]:
            at = box.centre + rng.uniform(-1, 1, (200, len(box.half))) * box.half
            assert (verifier().robustness(verifier().states(each.mode, at)) >= -1e-6).all()


def test_boxes_of_a_mode_do_not_overlap() -> None:
    for each in verified().modes:
        low = np.array([box.centre - box.half for box in each.boxes]).reshape(-1, len(each.mode.coordinates))
        high = np.array([box.centre + box.half for box in each.boxes]).reshape(low.shape)
        apart = (np.minimum(high[:, None], high) - np.maximum(low[:, None], low)).min(2) <= 1e-12
        assert (apart | np.eye(len(low), dtype=bool)).all()


def test_a_policy_that_is_no_network_of_plans_is_refused() -> None:
    task = task_of("traffic", "car")
    with pytest.raises(UsageError, match="can be verified"):
        ProposedPlans(task, ModelRollout(lambda x: x[:, :1], task))


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
        ir.Op("randint", (ir.Const(0.0), ir.Signal("a"))),
    ],
)
def test_other_draws_are_refused(value: ir.Num) -> None:
    with pytest.raises(Unsupported):
        modes_of(situation(assign("a", value)))


def test_discrete_draws_within_numbers_make_modes() -> None:
    coin = ir.Op("bernoulli", (ir.Const(0.5),))
    found = modes_of(
        situation(assign("a", ir.Op("add", (coin, ir.Op("randint", (ir.Const(1.0), ir.Const(3.0)))))))
    )
    assert len(found) == 6
    assert sum(mode.weight for mode in found) == pytest.approx(1.0)
    values = [float(mode.states({"": np.zeros(1)}, ("a",), NUMPY)[0][0]) for mode in found]
    assert sorted(values) == [1.0, 2.0, 2.0, 3.0, 3.0, 4.0]


def test_too_many_discrete_cases_are_refused() -> None:
    many = ir.Op("randint", (ir.Const(0.0), ir.Const(99.0)))
    with pytest.raises(Unsupported, match="more than 1000"):
        modes_of(situation(assign("a", many), assign("b", many)))


def test_points_have_no_boxes() -> None:
    with pytest.raises(Unsupported, match="points"):
        modes_of(InitDecl((Situation("grid", 1.0, (), points=GridDecl(())),)))
