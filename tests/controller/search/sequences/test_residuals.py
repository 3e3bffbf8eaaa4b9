"""Progression of formulas over prefixes of trajectories."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.text import show_formula
from stlc.controller.search.sequences.residuals import Progression

P, Q = ir.Predicate(ir.Signal("p")), ir.Predicate(ir.Signal("q"))
STEPS = 9


def eventually(lo: int, hi: int, body: ir.Formula) -> ir.Formula:
    return ir.Temporal("eventually", ir.Window(lo, hi), body)


def after(formula: ir.Formula, p: list[float], q: list[float]) -> ir.Formula:
    env = {"p": np.array([p], np.float64).T, "q": np.array([q], np.float64).T}
    return Progression([formula], STEPS).after(env)[0]


def test_what_is_left_of_goals_in_order() -> None:
    formula = eventually(0, 6, ir.BoolOp("and", (P, eventually(0, 3, Q))))
    assert show_formula(after(formula, [-1, 1, -1], [-1, -1, -1])) == (
        "eventually[1..2] q >= 0 or eventually[1..4] (p >= 0 and eventually[0..3] q >= 0)"
    )
    assert after(formula, [-1, 1, -1], [-1, -1, 1]) == ir.Truth(True)


def test_an_answer_is_due_from_its_question_on() -> None:
    formula = ir.Temporal(
        "always", ir.Window(0, 6), ir.BoolOp("or", (ir.Predicate(ir.Signal("p"), -1), eventually(0, 3, Q)))
    )
    left = after(formula, [-1, 1, -1], [-1, -1, -1])
    assert show_formula(left).startswith("eventually[1..2] q >= 0 and always[1..4]")


FORMULAS = st.recursive(
    st.sampled_from([P, Q]),
    lambda inner: st.one_of(
        st.builds(lambda a, b: ir.BoolOp("or", (a, b)), inner, inner),
        st.builds(
            lambda lo, more, body: eventually(lo, lo + more, body),
            st.integers(0, 2),
            st.integers(0, 3),
            inner,
        ),
        st.builds(
            lambda lo, more, a, b: ir.Until("until", ir.Window(lo, lo + more), a, b),
            *(st.integers(0, 2), st.integers(0, 3), st.sampled_from([P, Q]), st.sampled_from([P, Q])),
        ),
    ),
    max_leaves=3,
)


@settings(max_examples=30, deadline=None)
@given(FORMULAS, st.lists(st.sampled_from([-1.0, 1.0]), min_size=20, max_size=20), st.integers(0, STEPS - 1))
def test_a_continuation_that_meets_the_residual_meets_the_formula(
    formula: ir.Formula, values: list[float], now: int
) -> None:
    env = {"p": np.array([values[:10]]).T, "q": np.array([values[10:]]).T}
    prefix = {name: column[: now + 1] for name, column in env.items()}
    try:
        whole = evaluate([formula], env, ops=NUMPY)[0][0, 0]
    except ValueError:  # a window beyond the trace
        return
    left = Progression([formula], STEPS).after(prefix)[0]
    rest = {name: column[now:] for name, column in env.items()}
    met = left.value if isinstance(left, ir.Truth) else evaluate([left], rest, ops=NUMPY)[0][0, 0] >= 0
    assert not met or whole >= 0


@pytest.mark.parametrize(("p", "lost"), [([1, 1], False), ([1, -1], True)])
def test_a_lost_formula_is_false(p: list[float], lost: bool) -> None:
    formula = ir.Temporal("always", ir.Window(0, 6), P)
    assert (after(formula, p, [0, 0]) == ir.Truth(False)) is lost
