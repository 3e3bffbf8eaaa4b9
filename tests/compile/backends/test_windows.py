"""Windows under every semantics against loops, and the shapes at their edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array import windows as module
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.array.windows import Windows
from stlc.compile.semantics.semantics import (
    ArithmeticGeometricMean,
    Exact,
    GeneralizedMean,
    LogSumExp,
    Pick,
    Semantics,
)


@pytest.mark.parametrize(
    "semantics", [Exact(), LogSumExp(1.0), ArithmeticGeometricMean(), GeneralizedMean(0.1)]
)
@pytest.mark.parametrize("pick", ["min", "max"])
@settings(max_examples=18)
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
    x = np.repeat(np.array(values, dtype=float)[:, None], batch, axis=1)
    y = np.repeat(rng.integers(-9, 9, (len(values), 1)).astype(float), batch, axis=1)
    windows = Windows(semantics, NUMPY)
    extrema = windows.over([x], pick, count=count, width=width)
    until = windows.over([y, x], pick, count=count, width=width)
    assert extrema.shape == until.shape == (count, batch)
    other: Pick = "max" if pick == "min" else "min"
    nothing = math.inf if pick == "min" else -math.inf
    for j in range(count):
        inside = range(j, min(j + width, len(values)))
        if not inside:
            assert extrema[j, 0] == until[j, 0] == nothing
            continue
        wanted = semantics.reduce(x[inside.start : inside.stop], pick, NUMPY)[0]
        np.testing.assert_allclose(extrema[j], wanted, atol=1e-9)
        met = []
        for t in inside:
            held = semantics.reduce(y[j : t + 1], other, NUMPY)
            met.append(semantics.pair(held, x[t : t + 1], other, NUMPY))
        wanted = semantics.reduce(np.concatenate(met), pick, NUMPY)[0]
        np.testing.assert_allclose(until[j], wanted, atol=1e-9)


@pytest.mark.parametrize("pick", ["min", "max"])
@settings(max_examples=18)
@given(rows=st.integers(1, 90), count=st.integers(1, 100), width=st.integers(1, 12), batch=st.integers(1, 9))
def test_long_traces_are_judged_in_stretches(
    pick: Pick, rows: int, count: int, width: int, batch: int
) -> None:
    """Whatever their length, also where they end within the trace or beyond it."""
    x, y = np.random.default_rng(rows).normal(size=(2, rows, batch))
    windows = Windows(Exact(), NUMPY)
    whole = (
        windows.over([x], pick, count=count, width=width),
        windows.over([y, x], pick, count=count, width=width),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_TILE", 8)
        patch.setattr(module, "_OVERLAP", 1)
        assert len(windows._tiles(x, 100, 1)) > 10
        np.testing.assert_array_equal(windows.over([x], pick, count=count, width=width), whole[0])
        np.testing.assert_array_equal(windows.over([y, x], pick, count=count, width=width), whole[1])
