"""Values at the instants at which a requirement is judged: every instant sees its own window."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import formula_strategies as random_formulas
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.simplify import simplify
from stlc.monitor.values import Ends, Record, bounds, window_bounds


@pytest.mark.parametrize("ends", ["open", "truncate"])
@settings(max_examples=12, deadline=None)
@given(
    written=random_formulas.formulas(held=()),
    trace=random_formulas.traces(1, 14, 2),
    window=st.integers(0, 6),
)
def test_a_window_is_a_record_of_its_own(ends: Ends, written, trace, window) -> None:
    formula = simplify(random_formulas.GRID.lower(written, []))
    record = Record(trace, NUMPY)
    found = window_bounds(formula, record, range(record.samples), window, ends)
    for k in range(record.samples):
        stop = k + window + 1
        wanted = bounds(formula, record.cut(stop), range(k, k + 1), ends, stop)
        np.testing.assert_array_equal([end[k] for end in found], [end[0] for end in wanted])


def test_readings_of_earlier_samples_are_history() -> None:
    earlier = ir.Predicate(ir.ShiftedSignal("x", -2, clamped=True))
    assert earlier.history == 2
    assert (
        ir.Freeze((("v", ir.ShiftedSignal("x", -3, clamped=True)),), ir.Predicate(ir.FrozenVar("v"))).history
        == 3
    )
    record = Record({"x": np.arange(8.0)[:, None]}, NUMPY)
    low, _ = window_bounds(ir.Temporal("always", ir.Window(0, None), earlier), record, range(6), 2, "open")
    np.testing.assert_array_equal(low[:, 0], [0, 0, 0, 1, 2, 3])
