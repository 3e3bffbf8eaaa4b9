"""The native kernel and torch give the same verdicts, and torch takes over where there is no kernel."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from stlc import native
from stlc.controller.problem.native import NativeJudge
from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

pytestmark = pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")


def _both(
    task: Task, x0: torch.Tensor, u: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> tuple[PlanVerdicts, PlanVerdicts]:
    fast = task.judge(x0, u)
    monkeypatch.setattr(native, "compiler", lambda: None)
    other = Task(task.compiled, System(task.system.decl))
    assert NativeJudge.of(other.system, other.rules) is None
    return fast, other.judge(x0, u)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 2e-5)])
def test_kernel_and_torch_agree(
    car_task: Task, monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype, tolerance: float
) -> None:
    assert NativeJudge.of(car_task.system, car_task.rules) is not None
    x0 = car_task.sample(3000, seed=1, dtype=dtype)
    u = (
        20.0 * torch.rand(3000, car_task.horizon, 1, generator=torch.Generator().manual_seed(2), dtype=dtype)
        - 10.0
    )
    fast, slow = _both(car_task, x0, u, monkeypatch)
    apart = (fast.requirements - slow.requirements).abs().amax(1)
    near_tie = apart > tolerance  # a switch within rounding of its edge may fall to either side in float32
    assert near_tie.double().mean() <= (0.0 if dtype == torch.float64 else 0.03)
    assert fast.rho.dtype == slow.rho.dtype == dtype
    for name in car_task.system.names:
        gap = (fast.columns[name] - slow.columns[name]).abs().amax(0)
        assert gap[~near_tie].max() <= tolerance
    assert torch.allclose(car_task.cost(fast)[~near_tie], car_task.cost(slow)[~near_tie], atol=1e-4)


def test_broken_plans_are_violated_in_both(car_task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    x0 = car_task.sample(4, seed=1, dtype=torch.float64)
    x0[1, 1] = torch.nan
    u = torch.zeros(4, car_task.horizon, 1, dtype=torch.float64)
    u[2, 0] = torch.inf
    for judged in _both(car_task, x0, u, monkeypatch):
        assert torch.isneginf(judged.rho).tolist() == [False, True, True, False]


def test_a_state_that_no_requirement_reads_must_be_a_number_in_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = tmp_path / "log.yaml"
    there.write_text("""\
stlc: 1
name: log
time: {dt: 0.1 s, horizon: 5 steps}
state: {x: {range: [-5, 5]}, y: {range: [-5, 5]}, still: {}}
control: {a: {range: [-1, 1]}}
flow: {x: a, y: log(y)}
init: {mixture: [{draw: {x: 0, y: 1, still: 0}}]}
""")
    text = "spec a\nstate signal x\nrequire r: always[0,T] x < 2\n"
    task = Task.of(Spec.parse(Source("a.stl", text)), System.load(there))
    x0 = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, torch.nan]], dtype=torch.float64)
    for judged in _both(task, x0, torch.zeros(3, 5, 1, dtype=torch.float64), monkeypatch):
        assert torch.isneginf(judged.rho).tolist() == [False, True, False]


def test_states_are_left_out_where_nobody_wants_them(car_task: Task) -> None:
    x0 = car_task.sample(4, seed=1)
    judged = car_task.judge(x0, torch.zeros(4, car_task.horizon, 1), states=False)
    assert not judged.columns
    assert torch.equal(judged.rho, car_task.judge(x0, judged.plans).rho)
