"""Sliding extrema and until: values by loops, gradients by plain torch, with the C kernel and without."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array import kernel
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.array.windows import Windows
from stlc.compile.backends.torch.extrema import small_windows
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.namespace import Pick, Sliding
from stlc.compile.semantics.semantics import Exact

BOTH = pytest.mark.parametrize("pick", ["min", "max"])


@pytest.fixture(params=["kernel", "array operations"])
def _method(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """By the C kernel, a few windows at a time, or without one."""
    monkeypatch.setattr(kernel, "_CHUNK", 4)
    monkeypatch.setattr("stlc.compile.backends.array.numpy_ops._MANY", 1)
    monkeypatch.setattr("stlc.compile.backends.torch.extrema._SMALL", 0)
    kernel.kernel_library.cache_clear()
    if request.param != "kernel":
        monkeypatch.setattr(kernel.native, "load", lambda _: None)
    yield
    kernel.kernel_library.cache_clear()


@st.composite
def windows(draw: st.DrawFn) -> Sliding:
    rows = draw(st.integers(1, 40))
    return Sliding(rows, draw(st.integers(1, rows)), draw(st.integers(1, rows + 3)))


def extrema_by_loops(x: torch.Tensor, pick: Pick, window: Sliding) -> torch.Tensor:
    reduce = torch.amin if pick == "min" else torch.amax
    return torch.stack([reduce(x[j : j + window.width], 0) for j in range(window.count)])


def until_by_loops(left: torch.Tensor, right: torch.Tensor, pick: Pick, window: Sliding) -> torch.Tensor:
    one, other = (torch.minimum, torch.maximum) if pick == "min" else (torch.maximum, torch.minimum)
    out = []
    for j in range(window.count):
        held = found = None
        for t in range(j, min(j + window.width, window.rows)):
            held = left[t] if held is None else other(held, left[t])
            met = other(held, right[t])
            found = met if found is None else one(found, met)
        out.append(found)
    return torch.stack(out)


def sliding_extrema(x: torch.Tensor, pick: Pick, window: Sliding) -> torch.Tensor:
    return Windows(Exact(), TORCH).over([x], pick, count=window.count, width=window.width)


def sliding_until(left: torch.Tensor, right: torch.Tensor, pick: Pick, window: Sliding) -> torch.Tensor:
    return Windows(Exact(), TORCH).over([left, right], pick, count=window.count, width=window.width)


def gradients(value: torch.Tensor, operands: list[torch.Tensor], seed: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    weights = torch.randn(value.shape, generator=generator, dtype=value.dtype)
    return list(torch.autograd.grad(value, operands, weights))


def random(window: Sliding, seed: int, batch: int = 3) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(window.rows, batch, generator=generator, dtype=torch.float64)


@pytest.mark.usefixtures("_method")
@BOTH
@settings(max_examples=8)
@given(window=windows(), seed=st.integers(0, 999))
def test_values_and_gradients_are_those_of_loops(pick: Pick, window: Sliding, seed: int) -> None:
    x, y = random(window, seed).requires_grad_(), random(window, seed + 1).requires_grad_()
    value, wanted = sliding_extrema(x, pick, window), extrema_by_loops(x, pick, window)
    assert torch.equal(value, wanted)
    numpy, sizes = Windows(Exact(), NUMPY), {"count": window.count, "width": window.width}
    np.testing.assert_array_equal(numpy.over([x.detach().numpy()], pick, **sizes), wanted.detach())
    mine, theirs = gradients(value, [x], seed), gradients(wanted, [x], seed)
    torch.testing.assert_close(mine, theirs, atol=1e-12, rtol=1e-12)

    value, wanted = sliding_until(x, y, pick, window), until_by_loops(x, y, pick, window)
    assert torch.equal(value, wanted)
    met = numpy.over([x.detach().numpy(), y.detach().numpy()], pick, **sizes)
    np.testing.assert_array_equal(met, wanted.detach())
    mine, theirs = gradients(value, [x, y], seed), gradients(wanted, [x, y], seed)
    torch.testing.assert_close(mine, theirs, atol=1e-12, rtol=1e-12)


@BOTH
@settings(max_examples=8)
@given(window=windows(), seed=st.integers(0, 999))
def test_windows_side_by_side_are_those_of_loops(pick: Pick, window: Sliding, seed: int) -> None:
    x, y = random(window, seed).requires_grad_(), random(window, seed + 1).requires_grad_()
    wanted = extrema_by_loops(x, pick, window)
    assert torch.equal(small_windows([x], pick, window), wanted)
    value, wanted = small_windows([x, y], pick, window), until_by_loops(x, y, pick, window)
    assert torch.equal(value, wanted)
    mine, theirs = gradients(value, [x, y], seed), gradients(wanted, [x, y], seed)
    torch.testing.assert_close(mine, theirs, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("batch", [1, 40, pytest.param(1000, marks=pytest.mark.apart)])
@pytest.mark.parametrize("width", [3, 40, 200])
@BOTH
def test_every_size_goes_the_same_way(pick: Pick, width: int, batch: int) -> None:
    """Small, middling and large arrays take different methods, or leave it to others: all agree."""
    window = Sliding(70, 70, width)
    x, y = random(window, 0, batch).requires_grad_(), random(window, 1, batch).requires_grad_()
    torch_windows, numpy_windows = Windows(Exact(), TORCH), Windows(Exact(), NUMPY)
    p, q = x.detach().numpy(), y.detach().numpy()
    wanted = extrema_by_loops(x, pick, window)
    value = torch_windows.over([x], pick, count=70, width=width)
    assert torch.equal(value, wanted)
    np.testing.assert_array_equal(
        numpy_windows.over([p], pick, count=70, width=width), wanted.detach().numpy()
    )
    torch.testing.assert_close(gradients(value, [x], 5), gradients(wanted, [x], 5), atol=1e-10, rtol=1e-10)
    wanted = until_by_loops(x, y, pick, window)
    value = torch_windows.over([x, y], pick, count=70, width=width)
    assert torch.equal(value, wanted)
    np.testing.assert_array_equal(
        numpy_windows.over([p, q], pick, count=70, width=width), wanted.detach().numpy()
    )
    mine, theirs = gradients(value, [x, y], 5), gradients(wanted, [x, y], 5)
    torch.testing.assert_close(mine, theirs, atol=1e-10, rtol=1e-10)


@pytest.mark.usefixtures("_method")
@BOTH
@settings(max_examples=5)
@given(window=windows(), seed=st.integers(0, 999))
def test_gradients_where_operands_tie_are_subgradients(pick: Pick, window: Sliding, seed: int) -> None:
    """The gradient of every window goes to operands that have its value, and nothing of it is lost."""
    x, y = random(window, seed).round_().requires_grad_(), random(window, seed + 1).round_().requires_grad_()
    extreme, met = sliding_extrema(x, pick, window), sliding_until(x, y, pick, window)
    extreme_by_loops = extrema_by_loops(x, pick, window).detach()
    met_by_loops = until_by_loops(x, y, pick, window).detach()
    for j in range(window.count):
        (row,) = torch.autograd.grad(extreme[j].sum(), [x], retain_graph=True)
        assert ((row.sum(0) - 1).abs() < 1e-12).all()
        inside = torch.zeros(window.rows, 1, dtype=torch.bool)
        inside[j : j + window.width] = True
        assert ((row == 0) | inside & (x == extreme_by_loops[j])).all()
        left, right = torch.autograd.grad(met[j].sum(), [x, y], retain_graph=True)
        assert ((left.sum(0) + right.sum(0) - 1).abs() < 1e-12).all()
        assert ((left == 0) | inside & (x == met_by_loops[j])).all()
        assert ((right == 0) | inside & (y == met_by_loops[j])).all()


@BOTH
@pytest.mark.parametrize("width", [5, 50])
def test_gradients_are_central_differences(pick: Pick, width: int) -> None:
    window = Sliding(50, 48, width)
    x, y = random(window, 0, batch=1).requires_grad_(), random(window, 1, batch=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: sliding_extrema(x, pick, window), (x,))
    assert torch.autograd.gradcheck(lambda x, y: sliding_until(x, y, pick, window), (x, y))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_layout_of_the_operands_will_do(dtype: torch.dtype) -> None:
    """Transposed, expanded, in inference mode, and after it."""
    window = Sliding(30, 30, 7)
    x = random(window, 2, batch=4).to(dtype)
    wanted = extrema_by_loops(x, "min", window)
    turned = x.T.contiguous().T.requires_grad_()
    value = sliding_extrema(turned, "min", window)
    assert value.dtype == dtype
    assert torch.equal(value, wanted)
    value.sum().backward()
    assert torch.equal(turned.grad.sum(0), torch.full((4,), 30.0, dtype=dtype))
    one = x[:, :1].expand(-1, 4)
    assert torch.equal(sliding_until(one, x, "max", window), until_by_loops(one, x, "max", window))
    with torch.inference_mode():
        assert torch.equal(sliding_extrema(x, "min", window), wanted)
    assert torch.equal(sliding_extrema(x, "min", window), wanted)


def test_infinite_operands_are_neutral() -> None:
    """Nothing is NaN, and what is finite and chosen gets its gradient."""
    window = Sliding(6, 6, 3)
    inf = torch.inf
    x = torch.tensor([inf, 2.0, inf, inf, inf, 1.0], dtype=torch.float64)[:, None].requires_grad_()
    value = sliding_extrema(x, "min", window)
    assert value.flatten().tolist() == [2.0, 2.0, inf, 1.0, 1.0, 1.0]
    value[torch.isfinite(value)].sum().backward()
    assert x.grad.flatten().tolist() == [0.0, 2.0, 0.0, 0.0, 0.0, 3.0]
