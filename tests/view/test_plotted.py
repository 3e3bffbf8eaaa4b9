"""A verdict is drawn with what it judged."""

from __future__ import annotations

import numpy as np
import pytest

import stlc

TEXT = "signal x [m]\nrequire low: always[0 s, 1 s] x < 3 m\nrequire far: eventually x > 1 m\n"


@pytest.mark.parametrize("given", [np.array([1.0, 2.0, 4.0, 0.0]), np.array([[1.0, 2.0, 4.0, 0.0]] * 3)])
def test_signals_and_requirements_have_an_axis_each(given):
    pytest.importorskip("matplotlib")
    figure = stlc.plot(stlc.check(TEXT, {"t": np.arange(4.0), "x": given}))
    assert len(figure.axes) % 3 == 0  # of each trace the signal and two requirements
    drawn = [np.asarray(line.get_ydata(), dtype=float) for axes in figure.axes for line in axes.get_lines()]
    assert any(len(ys) >= 4 and np.allclose(ys[:4], [1.0, 2.0, 4.0, 0.0]) for ys in drawn)
