"""What worlds draw with: colours of who decided, and paths."""

import numpy as np
import pytest

from stlc.controller.deploy import SOURCES
from stlc.controller.sketch import DECIDED, DECIDERS, deciders, outlines, pieces, tails
from stlc.view.style import BLUE, ORANGE, PINK, SKY


@pytest.fixture
def axes():
    return pytest.importorskip("matplotlib.figure").Figure().add_subplot()


def drawn(axes):
    """Colour -> the stretches that were drawn in it, as rows x, y, x, y."""
    return {
        line.get_color(): np.reshape(np.asarray(line.get_data()).T, (-1, 3, 2))[:, :2].reshape(-1, 4).tolist()
        for line in axes.lines
    }


def test_every_source_has_a_colour_of_the_pictures():
    assert len(DECIDED) == len(DECIDERS) == len(SOURCES)
    assert DECIDED == (BLUE, ORANGE, PINK, SKY)


def test_without_a_record_the_policy_decided():
    assert deciders({}, 3, 2).tolist() == [0, 0]
    assert deciders({"decision": np.array([[0, 2], [1, 3]], dtype=np.int8)}, 1, 2).tolist() == [1, 3]


def test_a_stretch_has_the_colour_of_the_decision_before_it(axes):
    paths = np.stack([np.arange(5.0), np.zeros(5)], 1)[:, None]
    tails(axes, paths, {"decision": np.array([[0], [1], [1], [0], [2]])}, 4, frames=3)
    assert drawn(axes) == {BLUE: [[3, 0, 4, 0]], ORANGE: [[1, 0, 2, 0], [2, 0, 3, 0]]}


def test_nan_breaks_a_path(axes):
    paths = np.array([[[0.0, 0.0]], [[np.nan, np.nan]], [[2.0, 0.0]], [[3.0, 0.0]]])
    tails(axes, paths, {}, 3, frames=10)
    assert drawn(axes) == {BLUE: [[2, 0, 3, 0]]}


def test_nothing_lies_behind_the_first_frame(axes):
    tails(axes, np.zeros((4, 2, 2)), {}, 0, frames=10)
    assert not axes.lines


def test_an_outline_is_turned_and_placed(axes):
    arrow = np.array([(2.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
    outlines(axes, arrow, np.array([[5.0, 7.0, np.pi / 2]]), np.array([1]))
    (patch,) = axes.patches
    np.testing.assert_allclose(patch.get_xy()[:3], [(5, 9), (4, 7), (6, 7)], atol=1e-12)


def test_the_same_line_at_many_places(axes):
    pieces(axes, np.array([(0.0, 0.0), (5.0, 5.0)]), np.array([(0.0, 1.0), (0.0, 2.0)]), BLUE, 1.0)
    assert drawn(axes) == {BLUE: [[0, 1, 0, 2], [5, 6, 5, 7]]}
