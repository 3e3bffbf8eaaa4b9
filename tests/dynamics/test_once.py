"""Jumps that happen once, timers in discrete time, and initial states that the command line gives."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from stlc.compile.semantics.switch import Tanh
from stlc.dynamics.system import System

Make = Callable[..., System]

FUSE = """\
time: {dt: 0.1 s, horizon: 5 steps}
state: {x: {}, y: {}}
control: {u: {range: [-1, 1]}}
flow: {x: u}
jump: [{name: blow fuse, guard: x > 0.5, reset: {y: y + 1}, once: true}]
init: {mixture: [{draw: {x: "uniform(0, 1)", y: 0}}]}
"""


def test_it_happens_once_in_a_trajectory(make: Make) -> None:
    system = make(FUSE)
    assert system.names == ("x", "y", "blow_fuse_happened")
    x0 = system.sample(100, seed=0, dtype=torch.float64)
    assert not bool(x0[:, 2].any())
    end = system.rollout(x0, torch.zeros(100, 5, 1, dtype=torch.float64))[:, -1]
    assert torch.equal(end[:, 1], (x0[:, 0] > 0.5).double())
    assert torch.equal(end[:, 2], end[:, 1])


def test_its_blend_has_a_gradient(make: Make) -> None:
    system = make(FUSE)
    u = torch.zeros(4, 5, 1, requires_grad=True)
    x0 = torch.tensor([[0.5, 0.0, 0.0]]).expand(4, -1)
    system.rollout(x0, u, Tanh(10.0))[:, -1, 1].sum().backward()  # type: ignore[no-untyped-call]
    assert u.grad is not None
    assert bool((u.grad[:, 0] != 0).all())


def test_timers_count_in_discrete_time(make: Make) -> None:
    text = FUSE.replace("horizon: 5 steps", "horizon: 5 steps, discrete: true")
    text = text.replace("x: {}", "x: {}, tau: {unit: s, timer: up, run: x > 0}")
    system = make(text.replace("flow: {x: u}", "flow: {x: x}").replace("y: 0}", "y: 0, tau: 0}"))
    x = system.rollout(system.sample(3, seed=0), torch.zeros(3, 5, 1))
    torch.testing.assert_close(x[:, :, 1], (0.1 * torch.arange(6.0)).expand(3, -1))


@pytest.mark.parametrize(("text", "low", "high"), [("0.25", 0.25, 0.25), ("uniform(2, 3)", 2.0, 3.0)])
def test_the_command_line_gives_initial_states(make: Make, text: str, low: float, high: float) -> None:
    x = make(FUSE, x=text).sample(50, seed=0)[:, 0]
    assert low <= float(x.min()) <= float(x.max()) <= high
