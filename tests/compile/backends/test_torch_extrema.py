"""Extrema with gradients of our own are those of torch, apart from who gets the gradient of a tie."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce

import pytest
import torch

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.torch.extrema import _Choice, _Reduction, by_kernel, choice, reduction
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.namespace import Pick, Sliding
from stlc.native import compiler

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


def random(*shape: int) -> torch.Tensor:
    source = torch.Generator().manual_seed(sum(shape))
    return torch.randn(shape, generator=source, dtype=torch.float64, requires_grad=True)


@pytest.mark.parametrize("pick", ["min", "max"])
@pytest.mark.parametrize("window", [Sliding(9, 7, 3), Sliding(9, 9, 9), Sliding(9, 2, 40)])
@pytest.mark.parametrize("operands", [1, 2])
@pytest.mark.skipif(compiler() is None, reason="there is no C compiler here")
def test_windows_of_the_kernel_have_derivatives_of_any_order(
    operands: int, window: Sliding, pick: Pick
) -> None:
    given = [random(9, 3 + i)[:, :3] for i in range(operands)]

    def squared(*arrays: torch.Tensor) -> torch.Tensor:
        found = by_kernel(tuple(each**3 for each in arrays), pick, window)
        assert found is not None
        return found

    assert torch.autograd.gradcheck(squared, given)
    assert torch.autograd.gradgradcheck(squared, given)


@pytest.mark.parametrize("pick", ["min", "max"])
def test_extrema_have_second_derivatives(pick: Pick) -> None:
    items = [random(3, 2 + i)[:, :2] for i in range(3)]
    assert torch.autograd.gradgradcheck(lambda *xs: _Choice.apply(pick, *(x**3 for x in xs)), items)
    assert torch.autograd.gradgradcheck(lambda x: _Reduction.apply(x**3, pick), random(5, 2))


@pytest.mark.parametrize("k", [3.0, -3.0, 500.0])
def test_smooth_extrema_are_those_of_numpy(k: float) -> None:
    values = [-math.inf, -2.0, -1e-3, 0.0, 1e-3, 2.0, math.inf]
    a, b = torch.cartesian_prod(*[torch.tensor(values, dtype=torch.float64)] * 2).unbind(1)
    two = torch.from_numpy(NUMPY.softmax2(a.numpy(), b.numpy(), k))
    torch.testing.assert_close(TORCH.softmax2(a, b, k), two, rtol=1e-15, atol=1e-15)
    many = torch.stack((a, b, a + 1.0))
    whole = torch.from_numpy(NUMPY.softmax(many.numpy(), k))
    torch.testing.assert_close(TORCH.softmax(many, k), whole, rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("k", [3.0, -3.0])
def test_smooth_extrema_have_derivatives_of_any_order(k: float) -> None:
    a, b = random(3, 2), random(3, 3)[:, :2]
    for function, given in (
        (lambda x: TORCH.softmax(x, k), (a,)),
        (lambda x, y: TORCH.softmax2(x, y, k), (a, b)),
    ):
        assert torch.autograd.gradcheck(function, given)
        assert torch.autograd.gradgradcheck(function, given)

        def slope(*xs: torch.Tensor, function: Callable[..., torch.Tensor] = function) -> torch.Tensor:
            (found,) = torch.autograd.grad(function(*xs).sum(), xs[0], create_graph=True)
            return found

        assert torch.autograd.gradgradcheck(slope, given)


def test_second_derivatives_are_finite_where_a_branch_is_singular() -> None:
    x = torch.tensor([0.0, 2.0], dtype=torch.float64, requires_grad=True)
    y = torch.maximum(-x, 2.0 - TORCH.guarded.div(torch.ones(()), x))
    (slope,) = torch.autograd.grad((y**2).sum(), x, create_graph=True)
    (bent,) = torch.autograd.grad(slope.sum(), x)
    assert slope.tolist() == [0.0, 2 * 1.5 / 4]
    assert bent.tolist() == [2.0, 2 / 16 - 2 * 1.5 * 2 / 8]
