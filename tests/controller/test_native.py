"""Parts that run as C, and reasons why others do not; those give the same results in torch."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from stlc import native
from stlc.controller.problem.task import Task
from stlc.controller.training.objective import guided_objective, loss
from stlc.diagnostics import Notice
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

pytestmark = pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")
ARM = Path(__file__).parents[1] / "data" / "arm.yaml"
SPEC = """
{extern}
signal a, b [rad]
{body}
def tip = hand([a, b])
require clear: always[0, T] norm(tip - [1 m, 1 m]) > 0.5 m
require seen: once[0, 0.3 s] a > 0.1 rad
"""
EXACT = {"searches": True, "smooth": False}
OUTSIDE = "extern fn hand(q: real[2]) -> real[2] [m]"
INSIDE = "def hand(q) = [q[0] * 2 m - q[0]^3 / 6 * 1 m, q[1] * 2 m - q[1]^3 / 6 * 1 m]"


def _task(extern: str, body: str) -> Task:
    return Task.of(Spec.parse(Source("arm.stl", SPEC.format(extern=extern, body=body))), System.load(ARM))


def test_a_function_in_python_leaves_the_work_to_torch_with_the_same_results() -> None:
    outside, inside = _task(OUTSIDE, ""), _task("", INSIDE)
    why = "the function `hand` has no C form"
    assert outside.torch_reasons("cpu", **EXACT) == dict.fromkeys(("verdicts", "search", "gradient"), why)
    assert not any(inside.torch_reasons("cpu", **EXACT).values())
    x0 = outside.sample(50, seed=1, dtype=torch.float64)
    results = []
    for task in (outside, inside):
        u = torch.linspace(-1, 1, 500, dtype=torch.float64).view(50, 5, 2).sin().requires_grad_()
        judged = task.judge(x0, u.detach())
        value = loss(task, guided_objective(0.1, slope=5.0, performance_weight=0.3), x0, u)
        results.append((judged.requirements, *torch.autograd.grad(value.sum(), u)))
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_the_paper_s_objective_a_device_and_a_missing_compiler(
    car_task: Task, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert car_task.torch_reasons("cpu", **EXACT) == {"verdicts": "", "search": "", "gradient": ""}
    smooth = car_task.torch_reasons("cpu", searches=False, smooth=True)
    assert smooth == {"verdicts": "", "gradient": "the paper's objective is smooth"}
    assert set(car_task.torch_reasons("cuda", **EXACT).values()) == {"the device is cuda"}
    fresh = Task(car_task.compiled, System(car_task.system.decl))
    monkeypatch.setattr(native, "compiler", lambda: None)
    monkeypatch.setattr("stlc.controller.problem.native.compiler", lambda: None)
    assert set(fresh.torch_reasons("cpu", **EXACT).values()) == {"there is no C compiler"}
    monkeypatch.undo()
    fresh = Task(car_task.compiled, System(car_task.system.decl))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compiler = tmp_path / "cc"
    compiler.write_text("#!/bin/sh\ntest $1 = --version || { echo fatal error: no room; exit 4; }\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    with pytest.warns(Notice, match="W702: the C compiler `.*/cc` fails with exit code 4"):
        reasons = fresh.torch_reasons("cpu", **EXACT)
    assert set(reasons.values()) == {"the C compiler fails with exit code 4: fatal error: no room"}
