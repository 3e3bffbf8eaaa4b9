"""Tags that change numbers, comparisons of whole numbers, and what is warned of in training."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from helpers.resolving import codes, formula, spec
from hypothesis import given
from hypothesis import strategies as st

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.grammar.spec import Spec
from stlc.source import Source

SIGNALS = """
signal x [m] in [-10, 8]
signal tau [s] in [0, 8]
signal gap [m]
signal n in [0, 5]
"""


def robustness(node: typed.Formula, **values: float) -> float:
    lowered = Grid().lower(node, [])
    env = {name: np.array([[value]]) for name, value in values.items()}
    return float(evaluate([lowered], env, ops=NUMPY)[0][0, 0])


def scale(tag: str, text: str) -> float:
    return spec(f"{SIGNALS}{tag}\nrequire r: {text}\n").requirements[0].scale


def test_scale_is_the_reach_of_the_predicates() -> None:
    assert scale("@scale(auto)", "x > 2 m") == 12.0
    assert scale("@scale(auto)", "always[0, 1 s] (x > 2 m and tau < 1 s)") == 12.0
    assert scale("@scale(auto)", "freeze a = x in always[0, 1 s] x > a") == 18.0
    assert scale("@scale(auto)", "always[0, 1 s] delta(x) < 1 m") == 19.0
    assert scale("@scale(x)", "tau > 1 s") == 10.0
    assert scale("@scale(2 * tau)", "x > 1 m") == 16.0
    assert scale("@scale(4)", "x > 1 m") == 4.0


def test_without_a_range_there_is_no_scale() -> None:
    assert codes(f"{SIGNALS}@scale(auto) require r: gap > 1 m") == ["E205"]
    assert codes(f"{SIGNALS}@scale(gap) require r: x > 1 m") == ["E205"]
    assert codes(f"{SIGNALS}@scale(auto) require r: true") == ["E205"]
    assert codes(f"{SIGNALS}@scale(0) require r: x > 1 m") == ["E205"]
    assert codes(f"{SIGNALS}@product(2) require r: x > 1 m") == ["E501"]


@given(st.floats(-5, 5), st.floats(-5, 5))
def test_product_is_that_of_the_paper(x: float, low: float) -> None:
    text = f"@product\nrequire r: x in [{low:.17f}, 5.5 m]"
    node = spec(f"{SIGNALS}{text}\n").requirements[0].formula
    assert robustness(node, x=x) == pytest.approx((x - low) * (5.5 - x), abs=1e-9)


def test_product_reaches_into_definitions_and_stays_in_its_requirement() -> None:
    text = "def inside = x in [0 m, 4 m]\nrequire a: inside\n@product require b: inside\nrequire c: inside\n"
    first, second, third = (r.formula for r in spec(SIGNALS + text).requirements)
    assert robustness(first, x=1.0) == robustness(third, x=1.0) == 1.0
    assert robustness(second, x=1.0) == 3.0


@given(st.integers(-5, 5), st.integers(-5, 5), st.sampled_from(["<", "<=", ">", ">=", "==", "!="]))
def test_whole_numbers_are_compared_with_half_a_step(n: int, k: int, op: str) -> None:
    rho = robustness(formula(f"n {op} {k}"), n=float(n))
    truth = {"<": n < k, "<=": n <= k, ">": n > k, ">=": n >= k, "==": n == k, "!=": n != k}[op]
    assert (rho > 0) is truth
    assert abs(rho) >= 0.5
    assert abs(rho) % 1.0 == 0.5


def test_a_range_of_whole_numbers_and_sums_of_them() -> None:
    assert robustness(formula("n in [1, 3]"), n=3.0) == 0.5
    assert robustness(formula("1 <= n < 3"), n=3.0) == -0.5
    assert robustness(formula("2 * n + 1 > 7"), n=3.0) == -0.5
    assert robustness(formula("n < 2.5"), n=3.0) == -0.5
    assert robustness(formula("n > x / 1 m"), n=3.0, x=3.0) == 0.0


def warnings(text: str, purpose: str = "train") -> list[str]:
    parsed = Spec.parse(Source("a.stl", SIGNALS + text))
    compiled = compile_spec(parsed, grid=Grid(Fraction(1, 10), 20), purpose=purpose)
    return [finding.code for finding in compiled.warnings]


def test_a_modulo_is_warned_of_where_it_may_jump() -> None:
    assert warnings("require a: always[0, T] gap % 2 m > 1 m") == ["W403"]
    assert warnings("require a: always[0, T] tau % 3 s > 1 s") == ["W403"]
    assert warnings("require a: always[0, T] tau % 8 s > 1 s") == []
    assert warnings("require a: always[0, T] gap % 2 m > 1 m", "check") == []


def test_what_looks_before_a_plan_is_told_so() -> None:
    from stlc.diagnostics import SpecError

    with pytest.raises(SpecError, match="before the start of every plan"):
        warnings("require a: always[0, T] delta(x) < 1 m")
    assert warnings("require a: always[1 steps, T] delta(x) < 1 m") == []
    node = formula("always[1 steps, 3 steps] delta(x) < 1")
    assert [part.num.columns for part in node.walk() if isinstance(part, typed.Predicate)] == [{"x"}]
