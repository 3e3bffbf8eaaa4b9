"""Extrema with gradients of our own are those of torch, apart from who gets the gradient of a tie."""

from __future__ import annotations

from functools import reduce

import pytest
import torch

from stlc.compile.backends.torch.extrema import choice, reduction
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.schedule.schedule import Pick

SHAPES = [(2, 3), (40, 700)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("number", [1, 2, 3, 5])
@pytest.mark.parametrize("pick", ["min", "max"])
def test_choice(pick: Pick, number: int, shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    items = [torch.randn(shape, dtype=torch.float64, requires_grad=True) for _ in range(number)]
    weights = torch.randn(shape, dtype=torch.float64)
    wanted = reduce(torch.minimum if pick == "min" else torch.maximum, items)
    value = choice(items, pick)
    assert torch.equal(value, wanted)
    mine, theirs = (torch.autograd.grad(v, items, weights) for v in (value, wanted))
    torch.testing.assert_close(mine, theirs)
    kept = weights.clone()
    torch.autograd.grad(choice(items, pick), items, weights)
    assert torch.equal(weights, kept)


@pytest.mark.parametrize("shape", SHAPES)
def test_choice_of_equal_operands_keeps_the_whole_gradient(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    items = [torch.randn(shape).round_().requires_grad_() for _ in range(4)]
    constant = torch.zeros(shape)
    value = choice([*items, constant], "max")
    grads = torch.autograd.grad(value.sum(), items)
    for item, grad in zip(items, grads, strict=True):
        assert ((grad == 0) | (item == value)).all()
    chosen = sum(grads)
    assert (chosen[value > 0] == 1).all()
    assert ((chosen >= 0) & (chosen <= 1)).all()


def test_choice_of_arrays_of_different_shapes() -> None:
    a, b = torch.randn(100, 100, requires_grad=True), torch.randn(100, 1, requires_grad=True)
    choice([a, b], "min").sum().backward()
    assert b.grad.shape == (100, 1)
    assert float(a.grad.sum() + b.grad.sum()) == pytest.approx(10_000)


@pytest.mark.parametrize("shape", [(3, 2), (40, 700)])
@pytest.mark.parametrize("pick", ["min", "max"])
def test_reduction(pick: Pick, shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    for x in (torch.randn(shape, dtype=torch.float64), torch.randn(shape, dtype=torch.float64).round_()):
        x.requires_grad_()
        wanted = x.amin(0, keepdim=True) if pick == "min" else x.amax(0, keepdim=True)
        value = reduction(x, pick)
        assert torch.equal(value, wanted)
        weights = torch.randn_like(wanted)
        mine, theirs = (torch.autograd.grad(v, x, weights) for v in (value, wanted))
        torch.testing.assert_close(mine, theirs)


def test_a_constant_beyond_the_dtype_is_infinite() -> None:
    like = torch.zeros(3)
    assert torch.equal(TORCH.full((2,), 1e200, like), torch.full((2,), torch.inf))
    assert torch.equal(TORCH.full((2,), -1e200, like), torch.full((2,), -torch.inf))
    assert TORCH.full((), 0.25, like).item() == 0.25
