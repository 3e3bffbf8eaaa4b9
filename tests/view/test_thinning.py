"""Lines of many samples: what is drawn has their extremes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.signature import Column, Signature
from stlc.trace import Trace
from stlc.view.signals import Choice, draw_signals
from stlc.view.thinning import COLUMNS, extremes


@settings(max_examples=12)
@given(st.integers(1, 6 * COLUMNS), st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_each_column_keeps_its_least_and_greatest(count, seed, holes):
    rng = np.random.default_rng(seed)
    values = np.where(rng.random(count) < holes, np.nan, rng.standard_normal(count))
    kept = extremes(values)
    assert len(kept) <= max(2 * COLUMNS, 1) + 2
    assert kept[0] == 0
    assert kept[-1] == count - 1
    assert (np.diff(kept) > 0).all()
    width = -(-count // COLUMNS)
    for start in range(0, count, max(width, 1)) if count > 2 * COLUMNS else ():
        column = values[start : start + width]
        chosen = values[kept[(kept >= start) & (kept < start + width)]]
        if np.isfinite(column).any():
            assert np.nanmin(chosen) == np.nanmin(column)
            assert np.nanmax(chosen) == np.nanmax(column)
        else:
            assert np.isnan(chosen).all()
            assert len(chosen)


def test_a_short_line_is_kept_whole():
    assert extremes(np.zeros(2 * COLUMNS)).tolist() == list(range(2 * COLUMNS))


@pytest.mark.apart
def test_one_violated_sample_of_many_is_in_a_small_picture(tmp_path):
    count = 8_000
    x = np.random.default_rng(0).standard_normal((1, count)) * 0.01
    x[0, 4_777] = 5.0
    on = (np.arange(count) % 2).astype(np.float64)[None]
    columns = Signature((Column("x"), Column("on", kind="bool")))
    trace = Trace(columns, 0.01, {"x": x, "on": on})
    picture = draw_signals(trace, {"r": 2 - x}, (Choice(0, "trace 0"),))
    drawn = [line.get_ydata() for axes in picture.figure.axes for line in axes.get_lines()]
    assert max(np.nanmax(line) for line in drawn if len(line) > 2) == 5.0
    assert min(np.nanmin(line) for line in drawn if len(line) > 2) == -3.0
    assert all(len(line) <= 2 * COLUMNS + 2 for line in drawn)
    path = tmp_path / "p.svg"
    picture.figure.savefig(path)
    assert path.stat().st_size < 2_000_000
