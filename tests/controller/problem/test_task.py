"""Verdicts of plans, and the order in which plans are preferred."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import stlc
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.native import Effort
from stlc.controller.problem.task import Task
from stlc.controller.search.planner import PlanBudget, plan
from stlc.monitor.verdict import Monitor
from stlc.runtime.decision import rank


def _plans(task: Task, n: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 20.0 * torch.rand(n, task.horizon, 1, generator=generator, dtype=torch.float64) - 10.0


def test_judging_equals_robustness_of_the_rollout(car_task: Task) -> None:
    x0 = car_task.sample(500, seed=1, dtype=torch.float64)
    u = _plans(car_task, 500, seed=2)
    judged = car_task.judge(x0, u)
    x = car_task.rollout(x0, u)
    assert torch.allclose(judged.rho, car_task.robustness(x), atol=1e-12)
    assert torch.allclose(judged.requirements, car_task.requirement_robustness(x), atol=1e-12)
    assert torch.allclose(judged.safe, car_task.safety.robustness(x), atol=1e-12)
    assert torch.equal(judged.rho, judged.requirements.amin(1))
    assert (judged.safe >= judged.rho).all()


SCALED = {
    "a large number": ("@scale(1000000)\nrequire r: always[0, T] x >= 0.9 m\n", 0.5),
    "a truth value": ("@scale(auto)\nrequire r: f <= 500 kN until[0, T] go\n", 0.0),
    "a weight": ("@weight(1000)\nrequire r: always[0, T] x >= 0.9 m\n", 0.9 - 1e-8),
}


@pytest.mark.parametrize("name", SCALED)
def test_plans_and_recordings_have_one_verdict_whatever_the_scale(name: str, tmp_path: Path) -> None:
    formula, start = SCALED[name]
    spec, system = tmp_path / "s.stl", tmp_path / "s.yaml"
    spec.write_text(f"signal x: real [m]\nsignal f: real [N] in [0, 1e6]\nsignal go: bool\n{formula}")
    system.write_text(
        "stlc: 1\nname: s\ntime: {dt: 1 s, horizon: 3 steps}\n"
        "state: {x: {unit: m, range: [-1, 1]}, f: {unit: N, range: [0, 1e6]}, go: {bool: true}}\n"
        "control: {u: {range: [-1, 1]}}\nflow: {f: 0 N/s * u}\n"
        f"init: {{mixture: [{{draw: {{x: {start}, f: 0, go: 0}}}}]}}\n"
    )
    task = Task.load(spec, str(system))
    x0 = task.sample(4, seed=1, dtype=torch.float64)
    u = torch.zeros(4, task.horizon, 1, dtype=torch.float64)
    judged = task.judge(x0, u)
    columns = dict(zip(task.system.names, task.rollout(x0, u)[0].T.numpy(), strict=True))
    recorded = Monitor(spec, dt=1, horizon=3).check({key: columns[key] for key in ("x", "f", "go")})
    wanted = name == "a weight"
    assert recorded.satisfied is wanted
    assert (
        TOLERANCE.satisfied(judged.rho).tolist()
        == TOLERANCE.satisfied(judged.requirements).all(1).tolist()
        == [wanted] * 4
    )
    assert task.native is not None
    _, rho = task.native.local_search(x0, u, u[:0], Effort(1, 0.0, 1))
    assert TOLERANCE.satisfied(rho).tolist() == [wanted] * 4
    assert bool((plan(task, x0, budget=PlanBudget(evaluations=100)).rho >= -1e-6).all()) is wanted


def test_a_plan_with_nan_is_violated_and_never_preferred(car_task: Task) -> None:
    x0 = car_task.sample(2, seed=3, dtype=torch.float64)
    u = torch.zeros(2, car_task.horizon, 1, dtype=torch.float64)
    u[0, 3] = torch.nan
    judged = car_task.judge(x0, u)
    assert judged.rho[0] == -torch.inf
    assert judged.safe[0] == -torch.inf
    assert torch.isfinite(judged.rho[1])
    order = car_task.rank(judged, safety=False)
    assert order[0] < rank(torch.tensor(-1e6), torch.tensor(0.0), None, TORCH)


def test_satisfied_allows_for_rounding_but_not_for_more() -> None:
    exact = torch.tensor([0.0, -0.9e-6, -1.1e-6], dtype=torch.float64)
    assert TOLERANCE.satisfied(exact).tolist() == [True, True, False]
    assert TOLERANCE.satisfied(torch.tensor([-0.9e-5, -1.1e-5])).tolist() == [True, False]


@given(
    st.lists(st.tuples(st.floats(-50, 50), st.floats(0, 100)), min_size=2, max_size=8),
)
def test_satisfying_plans_come_first_then_cheap_ones_then_robust_ones(
    pairs: list[tuple[float, float]],
) -> None:
    rho, cost = torch.tensor(pairs, dtype=torch.float64).unbind(1)
    best = int(rank(rho, cost, None, TORCH).argmax())
    good = TOLERANCE.satisfied(rho)
    if good.any():
        assert good[best]
        assert cost[best] <= cost[good].min() + 1e-9
    else:
        assert rho[best] >= rho.max() - 1e-9


@pytest.mark.parametrize("by_torch", [False, True])
def test_plans_of_other_sizes_are_refused(
    car_task: Task, by_torch: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    x0, u = car_task.sample(4, seed=3), torch.zeros(4, car_task.horizon, 1)
    if by_torch:
        monkeypatch.setitem(car_task.__dict__, "native", None)
    for start, plans in ((x0, u[:1]), (x0[:1], u), (x0[:, :3], u), (x0, u.expand(-1, -1, 2))):
        with pytest.raises(ValueError, match=r"takes x0 \(B, "):
            car_task.judge(start, plans)
        with pytest.raises(ValueError, match=r"takes x0 \(B, "):
            car_task.rollout(start, plans)
    for plans in (u[:, 1:], torch.cat((u, u), 1)):
        with pytest.raises(ValueError, match=rf"u \(B, {car_task.horizon}, 1\)"):
            car_task.judge(x0, plans)


@pytest.mark.parametrize("steps", [0, 1, 7, None])
def test_plans_of_any_length_are_rolled_out_as_the_system_says(car_task: Task, steps: int | None) -> None:
    assert car_task.native is not None
    x0 = car_task.sample(20, seed=3, dtype=torch.float64)
    low, high = car_task.system.control_low.double(), car_task.system.control_high.double()
    length = car_task.horizon if steps is None else steps
    u = low + (high - low) * torch.rand((20, length, 1), dtype=torch.float64)
    found = car_task.rollout(x0, u)
    assert found.shape == (20, length + 1, len(car_task.system.names))
    torch.testing.assert_close(found, car_task.system.rollout(x0, u), rtol=1e-12, atol=1e-12)
    car_task.rollout(x0, u.requires_grad_())
    if length:
        car_task.rollout(x0, u).sum().backward()
        assert u.grad is not None


def test_initial_states_satisfy_the_assumptions_on_them(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text(
        "stlc: 1\nname: s\ntime: {dt: 1 s, horizon: 3}\nstate: {x: {}, n: {}}\n"
        "control: {a: {range: [-1, 1]}}\nflow: {x: a}\n"
        'init: {mixture: [{draw: {x: "uniform(-1, 1)", n: "uniform(-2, 2)"}}], where: [x < 0.5]}\n'
    )
    (tmp_path / "s.stl").write_text(
        'system "s.yaml"\nsignal x\nsignal n\nparam r: real in [0, 1]\n'
        "assume right: x >= 0 and n < 1\nassume later: always[0 s, 1 s] n > -1\nassume reached: x < r\n"
        "require close: always x < 5\n"
    )
    system = stlc.System.load(tmp_path / "s.yaml")
    task = stlc.compile(stlc.load(tmp_path / "s.stl"), system)
    x, n, _ = task.sample(500, seed=0).unbind(1)
    assert 0.0 <= float(x.min()) < 0.1 < 0.4 < float(x.max()) < 0.5
    assert -2.0 <= float(n.min()) < -1.5 < 0.9 < float(n.max()) < 1.0  # the future of n is not drawn
    assert task.system.decl.init.where_text == ("x < 0.5", "assume right")
    assert float(system.sample(500, seed=0)[:, 0].min()) < -0.9
