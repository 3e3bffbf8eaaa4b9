"""The kernel equals the torch graph for random systems with every feature, and random specifications."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.emitted import gathered
from helpers.system_strategies import formulas, spec_of, systems

from stlc import native
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.switch import Hard, StraightThrough
from stlc.controller.problem.task import Task
from stlc.diagnostics import SpecError
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

pytestmark = pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")

EXAMPLES = Path(__file__).parents[3] / "examples"
ROWS = 40
SLOPE = 5.0


@pytest.fixture(autouse=True)
def _quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many formulas in one text: the compiler is to spend little on it."""
    monkeypatch.setattr(native, "FLAGS", (*native.FLAGS, "-O0"))


def _tasks(count: int, rules: int, *, smooth: bool) -> list[Task]:
    """Random systems, each with a specification of several requirements that training takes."""
    texts = gathered(systems(), 3 * count)[-count:]
    drawn = list(dict.fromkeys(gathered(formulas(smooth=smooth), 3 * count * rules)))[-2 * count * rules :]
    tasks = []
    for number, text in enumerate(texts):
        system = System(parse_system(Source(str(EXAMPLES / "drawn.yaml"), text), EXAMPLES / "drawn.yaml", {}))
        lines = [line for line in drawn[number::count] if _trains(line, system)][:rules]
        tasks.append(Task.of(Spec.parse(Source("drawn.stl", spec_of(lines))), system))
    return tasks


def _trains(line: str, system: System) -> bool:
    try:
        Task.of(Spec.parse(Source("drawn.stl", spec_of([line]))), system)
    except SpecError:
        return False
    return True


def _tried(task: Task, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """States in the middle of missions, and plans."""
    generator = torch.Generator().manual_seed(seed)
    low, high = task.system.control_low.double(), task.system.control_high.double()
    shape = (ROWS, task.horizon, len(low))
    u = [low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64) for _ in range(2)]
    x0 = task.sample(ROWS, seed=seed, dtype=torch.float64)
    return task.rollout(x0, u[0])[:, 3], u[1]


def values_agree(task: Task, seed: int) -> None:
    x0, u = _tried(task, seed)
    assert task.native is not None
    each, columns = task.native.judge(x0, u, columns=True)
    states = task.system.rollout_columns(x0, u, Hard())
    for name, column in states.items():
        np.testing.assert_allclose(columns[name], column, rtol=1e-9, atol=1e-9, err_msg=name)
    expected = task.graph.per_requirement_columns(states, ops=TORCH)
    np.testing.assert_allclose(each, expected, rtol=1e-9, atol=1e-9)


def gradients_agree(task: Task, seed: int) -> None:
    x0, u = _tried(task, seed)
    generator = torch.Generator().manual_seed(seed)
    assert task.gradient is not None
    still = _stands_still(task.system.rollout_columns(x0, u, Hard()))
    by_each = torch.rand(ROWS, len(task.rules), generator=generator, dtype=torch.float64) * ~still[:, None]
    by_states = torch.rand(len(task.system.names), ROWS, generator=generator, dtype=torch.float64)

    def gradient(each: torch.Tensor, states: dict[str, torch.Tensor], plan: torch.Tensor) -> torch.Tensor:
        total = (by_each * torch.where(torch.isfinite(each), each, 0.0)).sum()
        for name, weights in zip(task.system.names, by_states, strict=True):
            total = total + (weights * states[name][1:].square()).sum()
        return torch.autograd.grad(total, plan)[0]

    plan = u.clone().requires_grad_()
    each, columns = task.gradient(x0, plan, slope=SLOPE)
    found = gradient(each, dict(columns), plan)
    plan = u.clone().requires_grad_()
    states = task.system.rollout_columns(x0, plan, StraightThrough(SLOPE))
    expected = gradient(task.graph.per_requirement_columns(states, ops=TORCH), states, plan)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8)


def _stands_still(states: dict[str, torch.Tensor]) -> torch.Tensor:
    """Rows in which a clamped state repeats itself: a minimum over time is a tie there."""
    pairs = [states[name][1:] == states[name][:-1] for name in ("x", "q[0]", "q[1]")]
    return torch.stack(pairs).any(0).any(0)


def test_values_of_random_systems_and_specifications() -> None:
    for seed, task in enumerate(_tasks(2, 8, smooth=False)):
        values_agree(task, seed)


def test_gradients_of_random_systems_and_specifications() -> None:
    for seed, task in enumerate(_tasks(2, 6, smooth=True)):
        gradients_agree(task, seed)


@pytest.mark.slow
def test_values_of_many_systems_and_specifications() -> None:
    for seed, task in enumerate(_tasks(100, 20, smooth=False)):
        values_agree(task, seed)


@pytest.mark.slow
def test_gradients_of_many_systems_and_specifications() -> None:
    for seed, task in enumerate(_tasks(40, 12, smooth=True)):
        gradients_agree(task, seed)
