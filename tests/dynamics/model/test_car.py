"""`examples/car.yaml` is the paper's traffic benchmark: dynamics and initial states, written out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from stlc.compile.semantics.switch import Hard, StraightThrough, Tanh
from stlc.dynamics.system import System

DT, V_MAX, TOTAL, SHARP = 0.1, 10.0, 8.0, 500.0


def states(n: int, seed: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """States all over the ranges, half of them with a leader, and controls."""
    generator = torch.Generator().manual_seed(seed)
    r = torch.rand(n, 9, generator=generator, dtype=torch.float64)
    x = -10 + 18 * r[:, 0]
    v = -0.01 + 10.01 * r[:, 1]
    light = (r[:, 2] < 0.5).double()
    tau = TOTAL * r[:, 3]
    gap = torch.where(r[:, 4] < 0.5, -1.0, 10 * r[:, 5])
    lead = torch.where(gap < 0, 0.0, 10 * r[:, 6])
    yielding = (r[:, 7] < 0.5).double()
    u = -10 + 20 * r[:, 8:]
    return torch.stack([x, v, light, tau, gap, lead, yielding], 1).to(dtype), u.to(dtype)


def exact_step(s: Tensor, u: Tensor) -> Tensor:
    """One step of the authors' model, S(z) the hard step."""
    x, v, light, tau, gap, lead, yielding = s.unbind(1)
    running = tau + DT * ((x >= -1) & (x <= 0)).to(tau)
    stop = torch.where(x > 0, 0.0, running)
    phase = tau + DT - torch.where(tau + DT >= TOTAL, TOTAL, 0.0)
    return torch.stack(
        [
            x + v * DT,
            torch.clamp(v + u[:, 0] * DT, -0.01, V_MAX),
            light,
            (1 - light) * stop + light * phase,
            gap + (lead - v) * DT * (gap >= 0),
            lead,
            yielding,
        ],
        1,
    )


def soft(rho: Tensor, sharpness: float = SHARP) -> Tensor:
    """The paper's I_w."""
    return (1 + torch.tanh(sharpness * rho)) / 2


def soft_step(s: Tensor, u: Tensor) -> Tensor:
    """Eq. 6: `I_w reset + (1 - I_w) flow` for each jump, soft indicators in the flow."""
    x, v, light, tau, gap, lead, yielding = s.unbind(1)
    at_stop, at_light = 0.5 - light, 0.5 - (light - 1).abs()
    flowed = tau + DT * soft(torch.maximum(at_light, torch.minimum(x + 1, -x)))
    leave = soft(torch.minimum(at_stop, x))
    cycle = soft(torch.minimum(at_light, tau + DT - TOTAL))
    stopped = leave * 0 + (1 - leave) * flowed
    return torch.stack(
        [
            x + v * DT,
            torch.clamp(v + u[:, 0] * DT, -0.01, V_MAX),
            light,
            cycle * (tau + DT - TOTAL) + (1 - cycle) * stopped,
            gap + (lead - v) * DT * soft(gap),
            lead,
            yielding,
        ],
        1,
    )


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_one_step_is_the_benchmark(car: System, dtype: torch.dtype, tolerance: float) -> None:
    x, u = states(10_000, 1, torch.float64)
    got = car.step(x.to(dtype), u.to(dtype))
    assert got.dtype == dtype
    want = exact_step(x.to(dtype), u.to(dtype)).double()
    assert (got.double() - want).abs().max() <= tolerance


@pytest.mark.parametrize("steps", [1, 2, 25])
def test_a_rollout_is_the_benchmark_step_by_step(car: System, steps: int) -> None:
    x, _ = states(10_000, 2, torch.float64)
    u = torch.randn(10_000, steps, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) * 6
    got = car.rollout(x, u)
    assert got.shape == (10_000, steps + 1, 7)
    for t in range(steps):
        assert (got[:, t] - x).abs().max() <= 1e-12
        x = exact_step(x, u[:, t])
    assert (got[:, -1] - x).abs().max() <= 1e-12


def test_the_soft_step_is_the_papers(car: System) -> None:
    x, u = states(10_000, 4, torch.float64)
    x[:2000, 0] = torch.linspace(-0.01, 0.01, 2000, dtype=torch.float64)  # where switching is soft
    x[2000:4000, 3] = torch.linspace(7.89, 7.91, 2000, dtype=torch.float64)
    got = car.step(x, u, Tanh())
    want = soft_step(x, u)
    assert (got - want).abs().max() <= 1e-12
    assert ((got - car.step(x, u)).abs().max(1).values > 0.01).sum() > 100


def test_a_soft_rollout_repeats_the_soft_step(car: System) -> None:
    x, _ = states(2000, 5, torch.float64)
    u = torch.randn(2000, 25, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(6)) * 6
    got = car.rollout(x, u, Tanh())
    for t in range(25):
        assert (got[:, t] - x).abs().max() <= 1e-9
        x = soft_step(x, u[:, t])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_straight_through_is_hard_forward(car: System, dtype: torch.dtype) -> None:
    x, _ = states(10_000, 7, dtype)
    u = torch.randn(10_000, 25, 1, dtype=dtype, generator=torch.Generator().manual_seed(8)) * 6
    hard = car.rollout(x, u, Hard())
    through = car.rollout(x, u, StraightThrough(10.0))
    assert (hard - through).abs().max() <= 32 * torch.finfo(dtype).eps


@pytest.mark.parametrize("switch", [Hard(), Tanh(), StraightThrough(10.0)])
def test_gradients_are_finite(car: System, switch: object) -> None:
    x0 = car.sample(2000, seed=9)
    u = (torch.randn(2000, 25, 1, generator=torch.Generator().manual_seed(10)) * 6).requires_grad_()
    columns = car.rollout_columns(x0, u, switch)  # type: ignore[arg-type]
    sum(column.square().sum() for column in columns.values()).backward()
    assert u.grad is not None
    assert torch.isfinite(u.grad).all()
    assert u.grad[:, :20].abs().max() > 0


def test_straight_through_has_a_gradient_where_the_hard_step_has_none(car: System) -> None:
    x0 = torch.tensor([[-1.3, 0.5, 0.0, 0.0, -1.0, 0.0, 0.0]])
    u = torch.zeros(1, 25, 1, requires_grad=True)
    assert not car.rollout_columns(x0, u, Hard())["tau"].requires_grad
    car.rollout_columns(x0, u, StraightThrough(5.0))["tau"][-1].sum().backward()
    assert u.grad is not None
    assert u.grad.abs().sum() > 0


def test_columns_that_never_change_are_views(car: System) -> None:
    columns = car.rollout_columns(car.sample(64, seed=0), torch.zeros(64, 25, 1))
    assert {name for name, column in columns.items() if column.stride(0) == 0} == {
        "sign",
        "v_lead",
        "yielding",
    }
    assert all(column.shape == (26, 64) for column in columns.values())


# ------------------------------------------------------------------------ initial states

N = 40_000


@pytest.fixture(scope="module")
def drawn(car: System) -> dict[str, Tensor]:
    x0 = car.sample(N, seed=1007, dtype=torch.float64)
    return dict(zip(car.names, x0.unbind(1), strict=True))


def is_share(mask: Tensor, share: float) -> bool:
    """Within four and a half standard deviations of a binomial share."""
    n = mask.numel()
    return abs(float(mask.double().mean()) - share) < 4.5 * math.sqrt(share * (1 - share) / n)


def is_uniform(values: Tensor, low: float, high: float) -> bool:
    """Kolmogorov-Smirnov at a level of 1e-4."""
    ordered = ((values - low) / (high - low)).sort().values
    n = len(ordered)
    ranks = torch.arange(1, n + 1, dtype=torch.float64) / n
    distance = torch.maximum((ranks - ordered).abs(), (ordered - ranks + 1 / n).abs()).max()
    return bool(distance < 2.23 / math.sqrt(n)) and bool(((ordered >= 0) & (ordered <= 1)).all())


def speed_limit(x: Tensor) -> Tensor:
    return torch.clamp(torch.sqrt(20 * (-x - 1)), max=10)


def test_blocks_have_their_shares(drawn: dict[str, Tensor]) -> None:
    light = drawn["sign"] == 1
    inside = (drawn["sign"] == 0) & (drawn["x"] > -1)
    assert is_share(light, 0.5)
    assert is_share(inside, 0.25)
    lead = drawn["dx"] != -1
    assert is_share(lead[light], 0.5)
    assert is_share(lead[~light & ~inside], 0.5)
    assert not lead[inside].any()


def test_block_a_approaches_a_stop_sign(drawn: dict[str, Tensor]) -> None:
    a = (drawn["sign"] == 0) & (drawn["x"] <= -1)
    x = drawn["x"][a]
    assert is_uniform(x, -10, -1)
    assert is_uniform(drawn["v"][a] / speed_limit(x), 0, 1)
    assert (drawn["tau"][a] == 0).all()
    assert is_share(drawn["yielding"][a] == 1, 0.5)


def test_block_b_is_at_the_stop_sign(drawn: dict[str, Tensor]) -> None:
    b = (drawn["sign"] == 0) & (drawn["x"] > -1)
    assert is_uniform(drawn["x"][b], -1, 0)
    assert is_uniform(drawn["v"][b], 0, 1)
    assert is_uniform(drawn["tau"][b], 0, 1.1)
    for name, value in (("dx", -1), ("v_lead", 0), ("yielding", 0)):
        assert (drawn[name][b] == value).all()


def test_block_c_approaches_a_light(drawn: dict[str, Tensor]) -> None:
    c = drawn["sign"] == 1
    assert is_uniform(drawn["x"][c], -10, -1)
    assert is_uniform(drawn["v"][c] / speed_limit(drawn["x"][c]), 0, 1)
    assert is_uniform(drawn["tau"][c], 0, 8)
    assert (drawn["yielding"][c] == 0).all()


def test_a_leader_is_fast_enough_to_be_avoidable(drawn: dict[str, Tensor]) -> None:
    lead = drawn["dx"] != -1
    gap, v, v_lead = drawn["dx"][lead], drawn["v"][lead], drawn["v_lead"][lead]
    assert is_uniform(gap, 1, 10)
    low = torch.sqrt(torch.relu(20 * (1 - gap) + v**2))
    assert is_uniform((v_lead - low) / (10 - low), 0, 1)
    assert (drawn["v_lead"][~lead] == 0).all()


def test_the_objective_is_the_benchmarks_and_stands_still_at_stop_signs(car: System) -> None:
    x0 = car.sample(500, seed=11, dtype=torch.float64)
    u = torch.randn(500, 25, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(12)) * 4
    columns = car.rollout_columns(x0, u)
    sat = (torch.arange(500) % 3 > 0).double()
    x, v, light, tau = (columns[name] for name in ("x", "v", "sign", "tau"))
    green = ((light == 0) | (tau > 4)).double()
    paper = 0.1 * sat * torch.relu(5 - v) * green + 0.1 * sat * torch.relu(-1 - x)
    stopping = ((light == 0) & (x >= -1) & (x <= 0) & (tau < 1)).double()
    each = paper + 0.2 * sat * torch.relu(v) * stopping
    assert torch.allclose(car.performance(columns, sat, sat), each.mean(0), atol=1e-12)


def test_what_the_file_says_beside_the_dynamics(car: System) -> None:
    decl = car.decl
    assert (car.decl.name, car.dt, car.horizon, car.control_names) == ("car", 0.1, 25, ("u",))
    assert (float(car.control_low), float(car.control_high)) == (-10.0, 10.0)
    assert decl.objective.gamma == 0.5
    assert decl.objective.smoothing == 500
    assert decl.test.world is not None
    assert (decl.test.world.path.name, decl.test.world.name) == ("traffic_grid.py", "TrafficGrid")
    assert (decl.test.agents, decl.test.steps) == (20, 150)
    assert [event.name for event in decl.test.events] == ["next_junction", "leader_changes", "yield_command"]
    assert decl.spec is not None
    assert decl.spec.name == "traffic.stl"
    assert decl.warnings == ()
    assert len(decl.source.text.splitlines()) <= 150
