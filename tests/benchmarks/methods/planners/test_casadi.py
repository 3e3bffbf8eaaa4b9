"""CasADi expressions have the values of the array libraries."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.apart
casadi = pytest.importorskip("casadi")

from benchmarks.methods.planners._casadi import CASADI, SymbolicColumn  # noqa: E402


@pytest.mark.parametrize("b", [0.1, -0.3, 2.0])
@pytest.mark.parametrize("a", [1.0, -1.0, 9.0, 0.0])
def test_the_remainder_is_that_of_numpy(a: float, b: float) -> None:
    x = casadi.SX.sym("x")
    found = casadi.Function("f", [x], [CASADI.mod(SymbolicColumn(x), b).entries])(a)
    assert float(found) == a % b
