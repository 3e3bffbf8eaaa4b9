"""Rank and choice of plans: the same over arrays of every library, and in C."""

from __future__ import annotations

import ctypes
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stlc import native
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.c.emit import HEAD
from stlc.compile.backends.torch.ops import TORCH
from stlc.export.c_header import decision
from stlc.runtime.decision import acceptable, best, continued, longest, rank

VALUES = st.sampled_from([-math.inf, -2.0, -1.0, -2e-6, -1e-6, -5e-7, 0.0, 5e-7, 0.5, 1.0, math.inf])
COSTS = st.sampled_from([-1.0, 0.0, 0.5, 0.5 + 5e-7, 2.0, math.inf, math.nan])
PLANS = st.lists(st.tuples(VALUES, VALUES, COSTS, st.lists(VALUES, min_size=3, max_size=3)), min_size=1)
DOORS = """
double rank_of_(double rho, double cost, double safe) { return rank_of(rho, cost, safe); }
int continued_(int count, const double *rho, const double *safe, const double *cost) {
  unsigned char allowed[1000];
  return continued(count, rho, safe, cost, allowed);
}
int longest_(int count, const double *samples, const double *rho, const double *depth, const double *cost) {
  unsigned char allowed[1000];
  return longest(count, samples, rho, depth, cost, allowed);
}
"""


@pytest.fixture(scope="module")
def in_c() -> ctypes.CDLL:
    library = native.load("\n".join((HEAD, decision(), DOORS)))
    if library is None:
        pytest.skip("needs a C compiler")
    library.rank_of_.restype = ctypes.c_double
    return library


def pointer(values: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(values.ctypes.data)


@given(PLANS)
def test_rank_and_choices_are_the_same_in_every_library_and_in_c(in_c: ctypes.CDLL, plans: list) -> None:
    rho, safe, cost = np.array([each[:3] for each in plans]).T.copy()
    falls = np.array([each[3] for each in plans]).T.copy()
    tensors = [torch.from_numpy(each) for each in (rho, safe, cost, falls)]
    with NUMPY.quiet():
        ranks = rank(rho, cost, safe, NUMPY)
        chosen, last = continued(rho, safe, cost, NUMPY), longest(falls, rho, cost, NUMPY)
        samples, depth = (falls >= -1e-6).sum(0).astype(float), np.minimum(falls, 0.0).sum(0) / 3.0
    assert torch.equal(rank(tensors[0], tensors[2], tensors[1], TORCH), torch.from_numpy(ranks))
    assert continued(*tensors[:3], TORCH).tolist() == chosen.tolist()
    assert longest(tensors[3], tensors[0], tensors[2], TORCH).tolist() == last.tolist()
    doubles = [ctypes.c_double(value) for row in zip(rho, cost, safe, strict=True) for value in row]
    in_turn = [in_c.rank_of_(*doubles[3 * i : 3 * i + 3]) for i in range(len(rho))]
    np.testing.assert_array_equal(in_turn, ranks)
    some = acceptable(rho, safe, NUMPY).any()
    first = int(chosen.argmax()) if some else -1
    assert in_c.continued_(len(rho), *map(pointer, (rho, safe, cost))) == first
    assert in_c.longest_(len(rho), *map(pointer, (samples, rho, depth, cost))) == int(last.argmax())


def test_a_satisfying_plan_is_preferred_to_a_safe_one_and_a_cheap_one_among_equals() -> None:
    rho, safe = np.array([-1.0, 0.2, 0.2, -3.0]), np.array([9.0, 0.5, 0.5, -1.0])
    cost = np.array([0.0, 3.0, 2.0, 0.0])
    assert continued(rho, safe, cost, NUMPY).tolist() == [False, False, True, False]
    assert continued(rho[[0, 3]], safe[[0, 3]], cost[[0, 3]], NUMPY).tolist() == [True, False]
    assert rank(rho, cost, safe, NUMPY).argsort().tolist() == [3, 0, 1, 2]
    assert best(rho > -2.0, (safe,), NUMPY).tolist() == [True, False, False, False]
