"""Every registered semantics is held to one contract."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stlc.compile.ops import Ops
from stlc.compile.ops_numpy import NUMPY
from stlc.compile.ops_torch import TORCH
from stlc.compile.semantics import SEMANTICS, TOLERANCE, Exact, LogSumExp, Pick, Semantics
from stlc.compile.windows import Windows
from stlc.diagnostics import UsageError

INF = math.inf


def column(*values: float) -> np.ndarray:
    return np.array(values, dtype=float)[:, None]


@pytest.mark.parametrize("ops", [NUMPY, TORCH], ids=["numpy", "torch"])
@pytest.mark.parametrize("pick", ["min", "max"])
@pytest.mark.parametrize("name", SEMANTICS.names)
def test_contract(name: str, pick: Pick, ops: Ops) -> None:
    semantics = SEMANTICS.get(name)()
    rng = np.random.default_rng(0)
    x = rng.normal(size=(6, 3))
    data = x if ops is NUMPY else torch.tensor(x)
    exact = x.min(0) if pick == "min" else x.max(0)
    reduced = semantics.reduce(data, pick, ops)
    assert reduced.shape == (1, 3)
    np.testing.assert_allclose(reduced[0], exact, atol=math.log(6) / 500)
    joined = semantics.join([data[i : i + 1] for i in range(6)], pick, ops)
    np.testing.assert_allclose(joined, reduced, atol=1e-12)
    one = semantics.join([data[:1], data[1:2]], pick, ops)
    np.testing.assert_allclose(semantics.pair(data[:1], data[1:2], pick, ops), one, atol=1e-12)
    np.testing.assert_allclose(semantics.join([data], pick, ops), x)
    neutral = math.inf if pick == "min" else -math.inf
    rows = ops.full((1, 3), neutral, data)
    np.testing.assert_allclose(semantics.reduce(ops.cat([data, rows]), pick, ops), reduced, atol=1e-12)
    assert (np.asarray(semantics.pair(rows, rows, pick, ops)) == neutral).all()
    assert (np.asarray(semantics.pair(data[:1], -rows, pick, ops)) == -neutral).all()
    single = data.astype(np.float32) if ops is NUMPY else data.float()
    assert semantics.reduce(single, pick, ops).dtype == single.dtype


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=9), st.floats(0.5, 500))
def test_log_sum_exp_brackets_the_extremum(values: list[float], k: float) -> None:
    x, smooth = column(*values), LogSumExp(k)
    slack = math.log(len(values)) / k + 1e-9
    top = smooth.reduce(x, "max", NUMPY).item()
    low = smooth.reduce(x, "min", NUMPY).item()
    assert max(values) <= top + 1e-9
    assert top <= max(values) + slack
    assert min(values) - slack <= low <= min(values) + 1e-9
    formula = math.log(sum(math.exp(k * (value - max(values))) for value in values)) / k + max(values)
    assert top == pytest.approx(formula, abs=1e-9)


def test_unknown_semantics_are_named() -> None:
    with pytest.raises(UsageError, match="exakt"):
        SEMANTICS.get("exakt")
    assert TOLERANCE == 1e-6


@pytest.mark.parametrize("semantics", [Exact(), LogSumExp(1.0)])
@pytest.mark.parametrize("pick", ["min", "max"])
@given(
    values=st.lists(st.integers(-9, 9), min_size=1, max_size=20),
    count=st.integers(1, 20),
    width=st.integers(1, 25),
    batch=st.sampled_from([1, 64]),
)
def test_windows_are_the_definition(
    semantics: Semantics, pick: Pick, values: list[int], count: int, width: int, batch: int
) -> None:
    """Extrema and until over every window, cut to the array, by loops."""
    rng = np.random.default_rng(len(values))
    x = np.repeat(column(*values), batch, axis=1)
    y = np.repeat(rng.integers(-9, 9, (len(values), 1)).astype(float), batch, axis=1)
    windows = Windows(semantics, NUMPY)
    extrema = windows.extrema(x, pick, count=count, width=width)
    until = windows.until(y, x, pick, count=count, width=width)
    assert extrema.shape == until.shape == (count, batch)
    other: Pick = "max" if pick == "min" else "min"
    nothing = INF if pick == "min" else -INF
    for j in range(count):
        inside = range(j, min(j + width, len(values)))
        if not inside:
            assert extrema[j, 0] == until[j, 0] == nothing
            continue
        wanted = semantics.reduce(x[inside.start : inside.stop], pick, NUMPY)[0]
        np.testing.assert_allclose(extrema[j], wanted, atol=1e-9)
        met = [semantics.reduce(np.concatenate([x[t : t + 1], y[j : t + 1]]), other, NUMPY) for t in inside]
        slack = 1e-9 if semantics.idempotent else 3 * math.log(len(values) + 1)
        wanted = semantics.reduce(np.concatenate(met), pick, NUMPY)[0]
        np.testing.assert_allclose(until[j], wanted, atol=slack)
