"""Rollouts of the emitted C equal torch's, for every feature of a system file."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from dynamics.model.test_motion import RICH
from dynamics.test_vectors import ARM
from helpers.emitted import sizes_of

from stlc.compile.backends.c.emit import Motion, emit
from stlc.controller.problem.kernel import Kernel
from stlc.dynamics.model.step import build_step
from stlc.dynamics.system import System
from stlc.native import compiler, load

Make = Callable[..., System]
pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler here")


@pytest.mark.apart
@pytest.mark.parametrize("integrator", ["euler", "heun", "rk4", "ros2"])
@pytest.mark.parametrize("substeps", [1, 3])
def test_rollouts_of_a_rich_system_equal_torch(make: Make, integrator: str, substeps: int) -> None:
    agree(make(RICH.format(integrator=integrator, substeps=substeps)))


def test_rollouts_of_vectors_equal_torch(make: Make) -> None:
    agree(make(ARM))


SINGULAR = """\
time: {dt: 0.1 s, horizon: 5 steps}
state: {x: {}, y: {}, z: {}}
param: {r: {range: [-1, 1]}}
control: {a: {range: [-1, 1]}, b: {range: [-1, 1]}}
flow:
  x: ind(r > 0) * log(r) + b
  y: if r <= 0 then 0 else y * sqrt(r) * a
  z: if r <= 0 or a > 0.9 then z else z * log(r)
init: {mixture: [{draw: {x: "uniform(-1, 1)", y: "uniform(0, 1)", z: "uniform(0, 1)"}}]}
"""


def test_branches_not_taken_and_products_with_zero_are_nan_in_both_or_in_neither(make: Make) -> None:
    system = make(SINGULAR)
    x0 = system.sample(300, seed=2, dtype=torch.float64)
    agree(system)
    x = system.rollout(x0, torch.zeros(300, 5, 2, dtype=torch.float64))
    found = dict(zip(system.names, x.unbind(2), strict=True))
    negative = x0[:, system.names.index("r")] <= 0.0
    assert negative.any()
    assert torch.isnan(found["x"][negative, 1:]).all()
    assert torch.isfinite(found["y"]).all()
    assert torch.isfinite(found["z"]).all()


def agree(system: System) -> None:
    """The rollouts of random plans by the kernel are those of torch."""
    step = build_step(system.decl, soft=False)
    motion = Motion(system.names, system.control_names, step.lets, step.next, system.horizon, system.dt)
    x0 = system.sample(300, seed=2, dtype=torch.float64)
    span = system.control_high - system.control_low
    generator = torch.Generator().manual_seed(3)
    u = system.control_low + span * torch.rand(
        300, system.horizon, 2, generator=generator, dtype=torch.float64
    )
    library = load(emit(motion, []))
    assert library is not None
    kernel = Kernel(library, sizes_of(motion, 0))
    _, columns = kernel.judge(x0.numpy(), u.numpy(), columns=True)
    assert columns is not None
    expected = system.rollout(x0, u).permute(2, 1, 0).numpy()
    np.testing.assert_allclose(columns, expected, rtol=1e-9, atol=1e-9)
