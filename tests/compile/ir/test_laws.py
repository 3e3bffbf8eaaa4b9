"""The laws that formulas are rewritten by keep the robustness, and are applied only where they hold."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers import laws
from helpers.formula_strategies import SPAN, formulas, traces
from helpers.laws import ALL, LAWS, Formula, defined, logic, steps, windowed
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed

short = traces(high=9, batch=1)


@pytest.mark.parametrize("name", LAWS)
@settings(max_examples=5)
@given(st.data(), short, st.booleans())
def test_a_law_keeps_the_robustness(name: str, data: st.DataObject, env: dict[str, Any], flip: bool) -> None:
    laws.check_law(LAWS[name], data.draw, env, flip=flip)


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
@settings(max_examples=1000)
@given(st.data(), short, st.booleans())
def test_a_law_keeps_the_robustness_of_many(
    name: str, data: st.DataObject, env: dict[str, Any], flip: bool
) -> None:
    laws.check_law(LAWS[name], data.draw, env, flip=flip)


def test_laws_of_the_exact_semantics_do_not_hold_under_the_others() -> None:
    """Else they could be applied there."""
    env = {name: np.array([[0.5], [1.0], [2.5], [3.0], [4.0]]) + k for k, name in enumerate("xyz")}
    p, q, r = (typed.Predicate(SPAN, ir.Signal(name), strict=True) for name in "xyz")
    twice = windowed("always", steps(0, 2), windowed("always", steps(0, 1), p))
    ends = windowed("always", steps(0, None), windowed("always", steps(0, None), p))
    sides = {
        LAWS["repeated_operand"]: (logic("and", p, q, p), logic("and", p, q)),
        LAWS["nested_junctions"]: (logic("and", logic("and", p, q), windowed("always", steps(1, 1), r)),
                                   logic("and", p, q, windowed("always", steps(1, 1), r))),
        LAWS["windows_of_windows"]: (twice, windowed("always", steps(0, 3), p)),
        LAWS["windows_to_the_end"]: (ends, windowed("always", steps(0, None), p)),
    }  # fmt: skip
    for law, (left, right) in sides.items():
        for name in ALL:
            one, other = (defined(side, env, name, "truncate")[0] for side in (left, right))
            assert one is not None
            assert other is not None
            assert (abs(one[0] - other[0]) < 1e-9) is (name in law.holds), (law, name)


@settings(max_examples=12)
@given(st.data(), short)
def test_what_is_constant_is_moved_out_of_windows(data: st.DataObject, env: dict[str, Any]) -> None:
    laws.check_moved(data.draw, env)


@settings(max_examples=12)
@given(st.data(), short)
def test_at_the_first_sample_the_clock_is_the_time_from_now(data: st.DataObject, env: dict[str, Any]) -> None:
    laws.check_clock(data.draw, env)


@settings(max_examples=12)
@given(formulas() | formulas(held=()), short)
def test_a_compiled_formula_has_the_robustness_of_the_definition(
    formula: Formula, env: dict[str, Any]
) -> None:
    laws.check_compiled(formula, env)
