"""Symbolic derivatives against automatic ones, and the integrator for stiff systems that uses them."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS
from stlc.dynamics.model.derivative import derivative
from stlc.dynamics.system import System

Make = Callable[..., System]
X, Y = ir.Signal("x"), ir.Signal("y")


def value(num: ir.Num, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    found = ArrayProgram({"out": num})({"x": x, "y": y}, TORCH)["out"]
    return torch.as_tensor(found, dtype=x.dtype).expand_as(x)


def slopes_agree(num: ir.Num) -> None:
    """The symbolic derivative with respect to x equals that of torch, at points between 0 and 1."""
    torch.manual_seed(0)
    x, y = 0.05 + 0.9 * torch.rand(40, dtype=torch.float64), 0.05 + 0.9 * torch.rand(40, dtype=torch.float64)
    x.requires_grad_()
    out = value(num, x, y)
    wanted = torch.autograd.grad(out.sum(), x)[0] if out.requires_grad else torch.zeros_like(x)
    found = derivative(num, "x")
    got = torch.zeros_like(x) if found is None else value(found, x.detach(), y)
    torch.testing.assert_close(got, wanted, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("name", [name for name, each in FUNCTIONS.items() if each.kind != "sampler"])
def test_every_function_has_its_derivative(name: str) -> None:
    count = FUNCTIONS[name].most or 3
    inner = ir.Op("mul", (X, Y)), ir.Op("sub", (X, ir.Const(0.4))), ir.Op("add", (Y, ir.Const(0.5)))
    slopes_agree(ir.Op(name, inner[:count]))
    last = ir.Op("add", (X, Y)) if name == "clip" else Y
    slopes_agree(ir.Op(name, (ir.Const(0.3), X, last)[3 - count :]))


def test_choices_calls_and_constants() -> None:
    slopes_agree(ir.Where(ir.Predicate(ir.Op("sub", (X, Y))), ir.Op("square", (X,)), Y))
    slopes_agree(ir.Op("pow", (X, ir.Const(0.8))))
    half = ir.Op("mul", (ir.Const(0.5), ir.Signal("a")))
    body = ir.Body(
        ("a", "b"),
        (("half", half), ("both", ir.Op("mul", (ir.Signal("half"), ir.Signal("b"))))),
        (ir.Op("sin", (ir.Signal("both"),)), ir.Signal("half")),
    )
    for output in (0, 1):
        slopes_agree(ir.Extern("f", (ir.Op("square", (X,)), ir.Op("add", (X, Y))), output, body))
    assert derivative(ir.Op("square", (Y,)), "x") is None


STIFF = """\
time: {{dt: 0.1 s, horizon: 20 steps, integrator: ros2, substeps: {substeps}}}
state: {{x: {{}}, y: {{}}, z: {{}}}}
flow:
  x: (-10000 * (x - cos(z)) + 200 * y) / 1 s
  y: (x - 50 * y * abs(y)) / 1 s
  z: 1 / (1 s)
init: {{mixture: [{{draw: {{x: 0, y: 0, z: 0}}}}]}}
"""


def test_stiff_systems_are_followed_with_long_steps(make: Make) -> None:
    def end(substeps: int) -> torch.Tensor:
        system = make(STIFF.format(substeps=substeps))
        x0 = system.sample(1, seed=0, dtype=torch.float64)
        return system.rollout(x0, torch.zeros(1, 20, 0, dtype=torch.float64))[0, -1]

    coarse, fine = end(1), end(16)
    assert fine[0].item() == pytest.approx(math.cos(2.0) + 0.02 * fine[1].item(), abs=2e-4)
    torch.testing.assert_close(coarse, fine, atol=2e-3, rtol=0)
