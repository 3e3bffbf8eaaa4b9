"""Time compiled into state says the same as the formula that was written, on every executed trace."""

from __future__ import annotations

import pytest
from helpers.mission_strategies import bodies, missions, nested
from hypothesis import given, settings
from hypothesis import strategies as st
from proof.missions import check_margins, check_mission, check_nested, check_past, check_recorded

from stlc.compile.ir import typed

seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=25)
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


@settings(max_examples=15)
@given(nested, seeds)
def test_what_looks_ahead_on_the_mission_clock_says_the_same(formula: typed.Formula, seed: int) -> None:
    check_nested(formula, seed)


@pytest.mark.slow
@settings(max_examples=2_000)
@given(nested, seeds)
def test_the_same_of_two_thousand_that_look_ahead(formula: typed.Formula, seed: int) -> None:
    check_nested(formula, seed)


@settings(max_examples=20)
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


@settings(max_examples=20)
@given(missions, seeds)
def test_a_recorded_trace_is_judged_as_defined(formula: typed.Formula, seed: int) -> None:
    check_recorded(formula, seed)
