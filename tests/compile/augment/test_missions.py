"""Time compiled into state says the same as the formula that was written, on every executed trace."""

from __future__ import annotations

from fractions import Fraction

import pytest
from helpers.mission_strategies import bodies, missions, nested
from hypothesis import given, settings
from hypothesis import strategies as st
from proof.missions import check_margins, check_mission, check_nested, check_past, check_recorded

from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.grammar.spec import Spec
from stlc.source import Source

seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=15)
@given(missions, seeds)
def test_every_plan_satisfies_the_rewriting_iff_the_trace_satisfies_the_mission(
    formula: typed.Formula, seed: int
) -> None:
    check_mission(formula, seed)


@pytest.mark.slow
@settings(max_examples=10_000)
@given(missions, seeds)
def test_the_same_ten_thousand_times(formula: typed.Formula, seed: int) -> None:
    check_mission(formula, seed)


@settings(max_examples=8)
@given(nested, seeds)
def test_what_looks_ahead_on_the_mission_clock_says_the_same(formula: typed.Formula, seed: int) -> None:
    check_nested(formula, seed)


@pytest.mark.slow
@settings(max_examples=2_000)
@given(nested, seeds)
def test_the_same_of_two_thousand_that_look_ahead(formula: typed.Formula, seed: int) -> None:
    check_nested(formula, seed)


@settings(max_examples=12)
@given(bodies, seeds)
def test_timers_say_what_operators_of_the_past_say(formula: typed.Formula, seed: int) -> None:
    check_past(formula, seed)


@pytest.mark.slow
@settings(max_examples=10_000)
@given(bodies, seeds)
def test_timers_ten_thousand_times(formula: typed.Formula, seed: int) -> None:
    check_past(formula, seed)


@settings(max_examples=15)
@given(bodies, seeds)
def test_margins_of_the_past_are_those_of_the_definition(formula: typed.Formula, seed: int) -> None:
    check_margins(formula, seed)


@settings(max_examples=12)
@given(missions, seeds)
def test_a_recorded_trace_is_judged_as_defined(formula: typed.Formula, seed: int) -> None:
    check_recorded(formula, seed)


@pytest.mark.parametrize(
    ("body", "text"),
    [
        ("not x <= 0.4 m", "true where `not x <= 0.4 m` holds"),
        ("not (x > 1 m and x < 2 m)", "true where `not (x > 1 m and x < 2 m)` holds"),
        ("`x` > 0.4 m", "true where '`x` > 0.4 m' holds"),
    ],
)
def test_the_text_of_a_status_is_true(body, text):
    spec = Spec.parse(Source("s.stl", f"signal x [m]\nrequire r: eventually@[0 s, 5 s] {body}\n"))
    compiled = compile_spec(spec, grid=Grid(Fraction(1, 10), 10), interface=None)
    assert any(text in timer.about for timer in compiled.timers)
