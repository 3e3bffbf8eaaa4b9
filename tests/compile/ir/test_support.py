from __future__ import annotations

import numpy as np
import pytest
from helpers.formula_strategies import GRID, formulas, traces
from hypothesis import given, settings

from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.defined import defined

P, Q = ir.Predicate(ir.Signal("p")), ir.Predicate(ir.Signal("q"))


@pytest.mark.parametrize(
    ("formula", "past", "future", "end"),
    [
        (P, 0, 0, False),
        (ir.Temporal("always", ir.Window(2, 5), P), 0, 5, False),
        (ir.Temporal("always", ir.Window(2, 5), ir.PastTemporal("once", ir.Window(1, 9), P)), 7, 5, False),
        (ir.Temporal("always", ir.Window(2, None), P), 0, 2, True),
        (ir.PastTemporal("once", ir.Window(2, None), P), 2, 0, False),
        (ir.Until("until", ir.Window(1, 3), ir.Shift(2, P), Q), 0, 5, False),
        (ir.Since("since", ir.Window(1, 3), ir.Shift(2, P), Q), 3, 2, False),
        (ir.BoolOp("and", (ir.Shift(-1, P), ir.Shift(1, Q))), 1, 1, False),
    ],
)
def test_reach(formula: ir.Formula, past: int, future: int, end: bool) -> None:
    assert formula.reach == (past, future)
    assert formula.uses_end is end


def test_columns_of_conditions_inside_numbers() -> None:
    num = ir.Op("add", (ir.Where(P, ir.Signal("a"), ir.Const(1.0)), ir.Indicator(Q)))
    assert ir.Temporal("always", ir.Window(0, 1), ir.Predicate(num)).columns == {"p", "q", "a"}


@settings(max_examples=36)
@given(formulas(bounded_only=True), traces(high=24))
def test_nothing_beyond_the_reach_is_read(formula: typed.Formula, env: dict[str, np.ndarray]) -> None:
    """A bounded formula has a value exactly where its reach fits, and samples beyond do not change it."""
    node = GRID.lower(formula, [])
    samples = len(env["x"])
    past, future = node.reach
    inside = defined(node, samples)
    if not any(isinstance(part, (ir.PastTemporal, ir.Since, ir.Shift)) for part in node.walk()):
        np.testing.assert_array_equal(inside, np.arange(samples) < samples - future)
    assert inside[past : max(samples - future, 0)].all()
    changed = {name: column.copy() for name, column in env.items()}
    for column in changed.values():
        column[future + 1 :] = 99.0
    if inside[0]:
        one, other = (robustness_signal(node, e, ops=NUMPY) for e in (env, changed))
        np.testing.assert_array_equal(one[0], other[0])


SOON = ir.Temporal("eventually", ir.Window(0, 2), P)
BEFORE = ir.Shift(-1, P)


@pytest.mark.parametrize(
    ("formula", "samples"),
    [
        (SOON, "1111.."),
        (ir.Temporal("always", ir.Window(1, None), P), "11111."),
        (ir.Temporal("always", ir.Window(0, None), SOON), "......"),
        (ir.Until("until", ir.Window(0, 1), SOON, Q), "111..."),
        (ir.Until("until", ir.Window(0, 1), Q, SOON), "111..."),
        (ir.Until("release", ir.Window(1, None), Q, P), "11111."),
        (ir.Until("until", ir.Window(2, 3), BEFORE, Q), ".11..."),
        (BEFORE, ".11111"),
        (ir.Shift(-1, P, outside=False), "111111"),
        (ir.Shift(2, P), "1111.."),
        (ir.PastTemporal("once", ir.Window(0, None), BEFORE), "......"),
        (ir.PastTemporal("once", ir.Window(2, 2), BEFORE), "11.111"),
        (ir.Since("since", ir.Window(1, 1), BEFORE, Q), "1.1111"),
        (ir.Since("since", ir.Window(1, 2), P, SOON), "11111."),
        (ir.BoolOp("and", (SOON, BEFORE)), ".111.."),
    ],
)
def test_where_a_formula_is_defined(formula: ir.Formula, samples: str) -> None:
    assert "".join("1" if inside else "." for inside in defined(formula, 6)) == samples
