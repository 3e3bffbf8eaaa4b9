"""The kernel for windows against loops: values, subgradients, ties, NaN, every layout and edge of a size."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from stlc import native
from stlc.compile.backends.array import kernel
from stlc.compile.backends.array.windows import Windows
from stlc.compile.backends.torch.extrema import by_kernel
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.namespace import Pick, Sliding
from stlc.compile.semantics.semantics import Exact

pytestmark = pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")

BATCHES = (1, 2, 5, 8, 9, 16, 17, 33)


def pair(a: Tensor, b: Tensor, pick: Pick) -> Tensor:
    return torch.minimum(a, b) if pick == "min" else torch.maximum(a, b)


def by_loops(operands: list[Tensor], pick: Pick, window: Sliding) -> Tensor:
    other: Pick = "max" if pick == "min" else "min"
    out = []
    for j in range(window.count):
        held = found = None
        for t in range(j, min(j + window.width, window.rows)):
            met = operands[-1][t]
            if len(operands) == 2:
                held = operands[0][t] if held is None else pair(held, operands[0][t], other)
                met = pair(held, met, other)
            found = met if found is None else pair(found, met, pick)
        out.append(found)
    return torch.stack(out)


def laid(x: Tensor, layout: str) -> Tensor:
    """The same numbers: traces, or samples beside each other, or neither."""
    match layout:
        case "traces":
            return x.clone(memory_format=torch.contiguous_format)
        case "samples":
            return x.T.contiguous().T
        case _:
            wide = x.new_zeros(2 * x.shape[0], 3 * x.shape[1])
            wide[::2, ::3] = x
            return wide[::2, ::3]


@st.composite
def cases(draw: st.DrawFn) -> tuple[Sliding, int]:
    rows = draw(st.integers(1, 45))
    window = Sliding(rows, draw(st.integers(1, rows)), draw(st.integers(1, rows + 3)))
    return window, draw(st.sampled_from(BATCHES))


@pytest.mark.apart
@pytest.mark.parametrize("operands", [1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@settings(max_examples=18)
@given(
    case=cases(),
    pick=st.sampled_from(["min", "max"]),
    layouts=st.tuples(*[st.sampled_from(["traces", "samples", "apart"])] * 3),
    ties=st.booleans(),
    seed=st.integers(0, 999),
)
def test_values_and_subgradients(dtype, operands, case, pick, layouts, ties, seed) -> None:
    window, batch = case
    generator = torch.Generator().manual_seed(seed)

    def numbers(rows: int) -> Tensor:
        if ties:
            return torch.randint(-1, 2, (rows, batch), generator=generator).to(dtype)
        return torch.randn(rows, batch, generator=generator, dtype=dtype)

    data = [laid(numbers(window.rows), layouts[i]).requires_grad_() for i in range(operands)]
    found = by_kernel(data, pick, window)
    assert found is not None
    wanted = by_loops(data, pick, window)
    assert torch.equal(found, wanted)
    weights = laid(torch.randn(window.count, batch, generator=generator, dtype=dtype), layouts[2])
    mine = torch.autograd.grad(found, data, weights)
    if not ties:
        theirs = torch.autograd.grad(wanted, data, weights, allow_unused=True)
        for one, two in zip(mine, theirs, strict=True):
            torch.testing.assert_close(one, torch.zeros_like(one) if two is None else two)
    # One of several equal rows gets everything: a gradient is conserved, and goes to equal values only.
    torch.testing.assert_close(sum(each.sum(0) for each in mine), weights.sum(0), atol=1e-4, rtol=1e-4)
    for at in range(window.count):
        (alone,) = torch.autograd.grad(by_kernel(data, pick, window)[at].sum(), data[:1])
        assert set(alone.unique().tolist()) <= {0.0, 1.0}
        hit = alone.bool()
        assert torch.equal(data[0].detach()[hit], found.detach()[at].expand_as(alone)[hit])


@pytest.mark.parametrize(("pick", "operands"), list(product(["min", "max"], [1, 2])))
def test_not_a_number_is_never_overlooked(pick: Pick, operands: int) -> None:
    window = Sliding(50, 50, 7)
    data = [torch.randn(50, 40, dtype=torch.float64) for _ in range(operands)]
    data[-1][20, 3] = torch.nan
    assert torch.equal(by_kernel(data, pick, window).isnan(), by_loops(data, pick, window).isnan())


@pytest.mark.parametrize(("pick", "operands"), list(product(["min", "max"], [1, 2])))
@pytest.mark.parametrize("value", [torch.inf, -torch.inf])
def test_infinite_values_stay_and_their_gradient_is_finite(pick: Pick, operands: int, value: float) -> None:
    window = Sliding(30, 30, 4)
    data = [torch.randn(30, 17).requires_grad_() for _ in range(operands)]
    with torch.no_grad():
        data[0][5:20] = value
    found = by_kernel(data, pick, window)
    assert torch.equal(found, by_loops(data, pick, window))
    found.nan_to_num().sum().backward()
    assert all(each.grad is not None and each.grad.isfinite().all() for each in data)


def test_no_traces_are_no_values() -> None:
    x = torch.zeros(5, 0, requires_grad=True)
    found = by_kernel([x], "min", Sliding(5, 3, 2))
    assert found is not None
    assert found.shape == (3, 0)
    found.sum().backward()
    assert x.grad is not None
    assert x.grad.shape == (5, 0)


def test_one_gradient_for_all_rows() -> None:
    """Gradient of `sum`, which has no strides."""
    x = torch.randn(200, 40, dtype=torch.float64, requires_grad=True)
    by_kernel([x], "max", Sliding(200, 200, 9)).sum().backward()
    (wanted,) = torch.autograd.grad(by_loops([x], "max", Sliding(200, 200, 9)).sum(), x)
    assert torch.equal(x.grad, wanted)


@pytest.mark.parametrize("dtype", [torch.float16, torch.int64])
def test_other_dtypes_are_left_to_torch(dtype: torch.dtype) -> None:
    assert by_kernel([torch.zeros(9, 2, dtype=dtype)], "min", Sliding(9, 9, 3)) is None


def test_memory_of_its_own_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel, "_ROOM", 1)
    assert by_kernel([torch.zeros(900, 1)], "min", Sliding(900, 900, 800)) is None
    assert by_kernel([torch.zeros(900, 900)], "min", Sliding(900, 900, 800)) is not None


@pytest.mark.parametrize("batch", [1, 40])
def test_without_a_compiler_torch_does_the_same(batch: int, monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = torch.randn(2, 300, batch, dtype=torch.float64).requires_grad_()
    windows = Windows(Exact(), TORCH)

    def judged() -> list[Tensor]:
        met = windows.over([x, y], "max", count=300, width=20)
        values = [met, windows.over([x], "min", count=300, width=33)]
        return [*values, *torch.autograd.grad(sum(each.sum() for each in values), [x, y])]

    with_kernel = judged()
    kernel.kernel_library.cache_clear()
    monkeypatch.setattr(native, "load", lambda _: None)
    try:
        assert by_kernel([x], "min", Sliding(300, 300, 20)) is None
        without = judged()
    finally:
        kernel.kernel_library.cache_clear()
    torch.testing.assert_close(with_kernel, without)
