"""Time compiled into state says the same as the formula that was written, on every executed trace."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from formula_strategies import SPAN
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mission_strategies import GRID, SAMPLES, augmented, bodies, missions, requirement, walks
from reference import Interval, Robustness, Trace

from stlc.compile import typed
from stlc.compile.augment import augment
from stlc.compile.graph import evaluate
from stlc.compile.lift import recorded
from stlc.compile.lower import lower
from stlc.compile.ops_numpy import NUMPY
from stlc.compile.semantics import TOLERANCE
from stlc.compile.simplify import simplify
from stlc.compile.timers import Ledger
from stlc.compile.walk import absolute, on_clock
from stlc.diagnostics import Diagnostic

BATCH = 4
HORIZON = GRID.horizon or 0


class OnTheClock(Robustness):
    """The definitions, with absolute operators judged at the start of the mission wherever they stand."""

    def at(self, node: typed.Formula, t: int, positive: bool = True) -> Interval | None:
        return super().at(node, 0 if on_clock(node) else t, positive)


def _reference(formula: typed.Formula, columns: Mapping[str, np.ndarray], t: int = 0) -> list[bool]:
    """Verdicts from the definitions, one a trace."""
    verdicts = []
    for row in range(next(iter(columns.values())).shape[1]):
        trace = Trace({name: column[:, row] for name, column in columns.items()}, GRID, "truncate")
        value = OnTheClock(trace).at(formula, t)
        assert value is not None
        verdicts.append(value[0] >= -TOLERANCE)
    return verdicts


def _planned(formula: typed.Formula, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Whether the rewritten formula holds in every planning window, (starts, batch)."""
    sink: list[Diagnostic] = []
    ledger = Ledger(frozenset(columns))
    found = augment(requirement(formula), GRID, ledger, sink)
    errors = {finding.code for finding in sink if finding.severity == "error"}
    assume(not errors & {"E312", "E307"})
    assert not errors
    compiled = simplify(lower(found.formula, GRID, sink))
    env = augmented(ledger.timers, columns)
    (margins,) = evaluate([compiled], env, ops=NUMPY, count=SAMPLES - HORIZON)
    return np.broadcast_to(margins, (SAMPLES - HORIZON, BATCH)) >= -TOLERANCE


def _same(formula: typed.Formula, seed: int) -> None:
    assume(absolute(formula))
    columns = walks(seed, BATCH)
    planned = _planned(formula, columns)
    np.testing.assert_array_equal(planned.all(0), _reference(formula, columns))
    assert (np.diff(planned.astype(int), axis=0) <= 0).all(), "what is falsified stays falsified"


@settings(max_examples=150)
@given(missions, st.integers(0, 2**32 - 1))
def test_every_plan_satisfies_the_rewriting_iff_the_trace_satisfies_the_mission(
    formula: typed.Formula, seed: int
) -> None:
    _same(formula, seed)


@pytest.mark.slow
@settings(max_examples=10_000)
@given(missions, st.integers(0, 2**32 - 1))
def test_the_same_ten_thousand_times(formula: typed.Formula, seed: int) -> None:
    _same(formula, seed)


def _back(formula: typed.Formula, seed: int) -> None:
    columns = walks(seed, BATCH)
    whole = typed.Temporal(SPAN, "always", typed.Interval(typed.Time(), typed.Time(horizons=1)), formula)
    planned = _planned(whole, columns)
    for k in (0, 1, 7, SAMPLES - HORIZON - 1):
        np.testing.assert_array_equal(planned[k], _reference(whole, columns, k))


@settings(max_examples=100)
@given(bodies, st.integers(0, 2**32 - 1))
def test_timers_say_what_operators_of_the_past_say(formula: typed.Formula, seed: int) -> None:
    _back(formula, seed)


@pytest.mark.slow
@settings(max_examples=10_000)
@given(bodies, st.integers(0, 2**32 - 1))
def test_timers_ten_thousand_times(formula: typed.Formula, seed: int) -> None:
    _back(formula, seed)


@settings(max_examples=100)
@given(missions, st.integers(0, 2**32 - 1))
def test_a_recorded_trace_is_judged_as_defined(formula: typed.Formula, seed: int) -> None:
    assume(absolute(formula))
    sink: list[Diagnostic] = []
    columns = walks(seed, BATCH)
    compiled = simplify(lower(recorded(formula), GRID, sink))
    (margins,) = evaluate([compiled], columns, ops=NUMPY, end="truncate")
    verdicts = np.broadcast_to(margins, (1, BATCH))[0] >= -TOLERANCE
    np.testing.assert_array_equal(verdicts, _reference(formula, columns))
