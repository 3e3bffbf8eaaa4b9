"""Verdicts from weighed robustness: those of the robustness itself, whatever weight and scale."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from stlc import native
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.c.emit import HEAD
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.tolerance import TOLERANCE

RHO = st.floats(-1e9, 1e9) | st.floats(-1e-5, 1e-5) | st.sampled_from([0.0, -1e-6, np.inf, -np.inf])
FACTORS = st.floats(1e-9, 1e9)


@given(st.lists(RHO, min_size=1, max_size=8), FACTORS)
@example([-0.1, -1e-6, 0.0, 0.5], 1e-6)
@example([-1e-9, -1e-5], 1e3)
def test_weighing_changes_no_verdict(values: list[float], factor: float) -> None:
    rho = np.array(values)
    kinds: list[tuple[Any, Any]] = [(rho, NUMPY), (torch.tensor(values, dtype=torch.float64), TORCH)]
    for given_values, ops in kinds:
        found = np.asarray(TOLERANCE.weighed(given_values, factor, ops))
        np.testing.assert_array_equal(found >= -1e-6, rho >= -1e-6)
        np.testing.assert_array_equal(found > 0, rho > 0)
        np.testing.assert_allclose(found, rho * factor, rtol=1e-9, atol=1e-6 * (1 + factor))
        order = np.argsort(rho, kind="stable")
        assert (found[order][1:] >= found[order][:-1]).all()


@pytest.mark.parametrize("factor", [1e-6, 0.5, 2.0, 1e3])
def test_float32_is_judged_with_its_own_tolerance(factor: float) -> None:
    rho = torch.tensor([-8.0, -1.1e-5, -0.9e-5, 0.0, 3.0])
    assert TOLERANCE.of(rho) == 1e-5
    assert (TOLERANCE.weighed(rho, factor, TORCH) >= -1e-5).tolist() == [False, False, True, True, True]


@pytest.mark.parametrize("value", [-3.0, 3.0])
def test_the_gradient_is_the_factor(value: float) -> None:
    rho = torch.tensor([value], dtype=torch.float64, requires_grad=True)
    TOLERANCE.weighed(rho, 1e-6, TORCH).sum().backward()
    assert rho.grad is not None
    assert rho.grad.tolist() == [1e-6]


@pytest.fixture(scope="module")
def in_c() -> ctypes.CDLL:
    doors = """
    int satisfied_(double rho) { return satisfied(rho); }
    double weighed_(double rho, double factor) { return weighed(rho, factor); }
    """
    library = native.load(HEAD + doors)
    if library is None:
        pytest.skip("needs a C compiler")
    library.weighed_.restype = ctypes.c_double
    return library


@given(RHO, FACTORS)
def test_c_weighs_and_judges_alike(in_c: ctypes.CDLL, rho: float, factor: float) -> None:
    assert bool(in_c.satisfied_(ctypes.c_double(rho))) == TOLERANCE.satisfied(rho)
    found = in_c.weighed_(ctypes.c_double(rho), ctypes.c_double(factor))
    assert found == float(TOLERANCE.weighed(np.array([rho]), factor, NUMPY)[0])
