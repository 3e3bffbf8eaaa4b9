"""Checks that time compiled into state says the same as the formula that was written, on executed traces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from helpers.formula_strategies import SPAN
from helpers.laws import OnTheClock
from helpers.mission_strategies import GRID, SAMPLES, augmented, requirement, walks
from helpers.reference import Interval, Trace
from hypothesis import assume

from stlc.compile.augment.augment import augment
from stlc.compile.augment.mission import GoalLeaf
from stlc.compile.augment.timers import TimerTable
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.simplify import simplify
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.diagnostics import Diagnostic

BATCH = 4
HORIZON = GRID.horizon or 0


def _defined(formula: typed.Formula, columns: Mapping[str, np.ndarray], t: int = 0) -> list[bool]:
    """Verdicts from the definitions, one a trace."""
    return [low >= -TOLERANCE for low, _ in _bounds(formula, columns, "truncate", t)]


def _bounds(
    formula: typed.Formula, columns: Mapping[str, np.ndarray], end: Literal["truncate", "open"], t: int = 0
) -> list[Interval]:
    """Robustness from the definitions, one a trace."""
    found = []
    for row in range(next(iter(columns.values())).shape[1]):
        trace = Trace({name: column[:, row] for name, column in columns.items()}, GRID, end)
        value = OnTheClock(trace).at(formula, t)
        assert value is not None
        found.append(value)
    return found


def _planned(formula: typed.Formula, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Truth of the rewritten formula in every planning window, (starts, batch)."""
    sink: list[Diagnostic] = []
    table = TimerTable(frozenset(columns))
    found = augment(requirement(formula), GRID, table, sink)
    errors = {finding.code for finding in sink if finding.severity == "error"}
    assume(not errors & {"E312", "E307"})
    assert not errors
    compiled = simplify(GRID.lower(found.formula, sink))
    env = augmented(table.timers, columns)
    possible = simplify(GRID.lower(found.alive, sink))
    count = SAMPLES - HORIZON
    margins, alive = (
        np.broadcast_to(each, (count, BATCH))
        for each in evaluate([compiled, possible], env, ops=NUMPY, count=count)
    )
    assert (np.diff((alive >= 0).astype(int), axis=0) <= 0).all(), "what is falsified stays falsified"
    if isinstance(found.goal, GoalLeaf):
        assert (margins[alive < 0] >= -TOLERANCE).all(), "what is falsified is asked for no more"
    return margins >= -TOLERANCE


def check_mission(formula: typed.Formula, seed: int) -> None:
    """Every planning window satisfies the rewriting iff the trace satisfies the mission."""
    assume(formula.absolute)
    columns = walks(seed, BATCH)
    planned = _planned(formula, columns)
    np.testing.assert_array_equal(planned.all(0), _defined(formula, columns))


LONG = 110
"""Samples that are longer than any nested formula looks."""
LOOK = 45
"""Samples after which what was falsified is known to be."""


def _endless(formula: typed.Formula) -> bool:
    return any(
        isinstance(node, (typed.Temporal, typed.Until))
        and node.op not in ("once", "historically", "since")
        and node.interval.hi is None
        for node in formula.walk()
    )


def check_nested(formula: typed.Formula, seed: int) -> bool:
    """The same of absolute operators over formulas that look ahead; False where no state holds them."""
    columns = walks(seed, BATCH, LONG)
    sink: list[Diagnostic] = []
    table = TimerTable(frozenset(columns))
    beside = typed.Temporal(
        SPAN, "always", typed.Interval(typed.Time(), typed.Time(), clock="start"), typed.Truth(SPAN, True)
    )
    whole = typed.Logic(SPAN, "and", (formula, beside))  # so that it is judged at the start
    found = augment(requirement(whole), GRID, table, sink)
    errors = {finding.code for finding in sink if finding.severity == "error"}
    assert errors <= {"E307", "E309", "E310", "E312"}, errors
    if errors:
        return False
    compiled = simplify(GRID.lower(found.formula, sink))
    env = augmented(table.timers, columns)
    starts = LONG - HORIZON
    plans = {
        name: np.stack([column[k : k + HORIZON + 1] for k in range(starts)], 1)
        for name, column in env.items()
    }
    flat = {name: plan.reshape(HORIZON + 1, -1) for name, plan in plans.items()}
    (margins,) = evaluate([compiled], flat, ops=NUMPY)
    planned = np.broadcast_to(margins, (1, starts * BATCH)).reshape(starts, BATCH) >= -TOLERANCE
    satisfied = planned.all(0)
    if not _endless(formula):
        np.testing.assert_array_equal(satisfied, _defined(formula, columns))
        return True
    # What never ends is falsified some time: not before it is for certain, and hardly later.
    earlier = {name: column[: LONG - LOOK] for name, column in columns.items()}
    long_lost, lost = (
        np.array([high < -TOLERANCE for _, high in _bounds(formula, seen, "open")])
        for seen in (earlier, columns)
    )
    assert (lost | satisfied).all()
    assert (~satisfied | ~long_lost).all()
    return True


def check_past(formula: typed.Formula, seed: int) -> None:
    """Timers say what operators of the past say."""
    columns = walks(seed, BATCH)
    whole = typed.Temporal(SPAN, "always", typed.Interval(typed.Time(), typed.Time(horizons=1)), formula)
    planned = _planned(whole, columns)
    for k in (0, 1, 7, SAMPLES - HORIZON - 1):
        np.testing.assert_array_equal(planned[k], _defined(whole, columns, k))


def _formula(formula: typed.Formula, table: TimerTable) -> ir.Formula:
    """Formula that plans are asked for."""
    sink: list[Diagnostic] = []
    found = augment(requirement(formula), GRID, table, sink)
    assert not [finding for finding in sink if finding.severity == "error"]
    return simplify(GRID.lower(found.formula, sink))


def check_margins(formula: typed.Formula, seed: int) -> None:
    """By how much plans satisfy formulas of the past: as defined on a whole trace, finite from anywhere."""
    columns = walks(seed, BATCH)
    whole = typed.Temporal(SPAN, "always", typed.Interval(typed.Time(), typed.Time(horizons=1)), formula)
    table = TimerTable(frozenset(columns))
    compiled = _formula(whole, table)
    env = augmented(table.timers, columns)
    starts = SAMPLES - HORIZON
    (margins,) = evaluate([compiled], env, ops=NUMPY, count=starts)
    margins = np.broadcast_to(margins, (starts, BATCH))
    for k in (0, 1, 7, starts - 1):
        defined = np.array([low for low, _ in _bounds(whole, columns, "truncate", k)])
        known = np.isfinite(defined)
        np.testing.assert_array_equal(margins[k][known], defined[known])
        plan = {name: column[k : k + HORIZON + 1] for name, column in env.items()}
        cut = np.broadcast_to(evaluate([compiled], plan, ops=NUMPY)[0][0], (BATCH,))
        np.testing.assert_array_equal(cut >= -TOLERANCE, defined >= -TOLERANCE)
        assert (cut > -np.inf).all(), "plans that fail can be compared"


def check_recorded(formula: typed.Formula, seed: int) -> None:
    """The robustness of a recorded mission, and its bounds where it goes on."""
    assume(formula.absolute)
    sink: list[Diagnostic] = []
    cut = {name: column[: 1 + seed % SAMPLES] for name, column in walks(seed, BATCH).items()}
    compiled = simplify(GRID.lower(formula.from_first_sample(), sink))
    ends = {end: evaluate([compiled], cut, ops=NUMPY, end=end)[0] for end in ("truncate", "lower", "upper")}
    judged = {end: np.broadcast_to(values, (1, BATCH))[0] for end, values in ends.items()}
    np.testing.assert_array_equal(judged["truncate"], [low for low, _ in _bounds(formula, cut, "truncate")])
    bounds = _bounds(formula, cut, "open")
    np.testing.assert_array_equal(judged["lower"], [low for low, _ in bounds])
    np.testing.assert_array_equal(judged["upper"], [high for _, high in bounds])
