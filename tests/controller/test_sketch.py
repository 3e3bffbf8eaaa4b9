"""Drawing by worlds: colours of who decided, and paths."""

import numpy as np
import pytest

from stlc.controller.guard.candidates import SOURCES
from stlc.controller.sketch import (
    DECIDED,
    DECIDERS,
    VIOLATED,
    deciders,
    numbers,
    outlines,
    plans,
    scale_bar,
    segments,
    tails,
    violations,
)
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
    (drawn_,) = axes.collections
    (path,) = drawn_.get_paths()
    np.testing.assert_allclose(path.vertices[:3], [(5, 9), (4, 7), (6, 7)], atol=1e-12)


def test_short_lines_are_drawn_as_one(axes):
    segments(axes, np.array([[(0.0, 1.0), (0.0, 2.0)], [(5.0, 6.0), (5.0, 7.0)]]), BLUE, 1.0)
    assert drawn(axes) == {BLUE: [[0, 1, 0, 2], [5, 6, 5, 7]]}


def test_a_rejected_plan_is_dashed_and_red_and_its_replacement_has_the_colour_of_who_decided(axes):
    nothing = np.full((1, 2, 3, 2), np.nan, dtype=np.float32)
    rejected, taken = nothing.copy(), nothing.copy()
    rejected[0, 1], taken[0, 1] = [(0, 0), (1, 0), (2, 0)], [(0, 0), (1, 1), (2, 2)]
    scene = {"rejected": rejected, "taken": taken, "decision": np.array([[0, 1]])}
    plans(axes, scene, 0, lambda places: places + 10)
    dashed = {line.get_color(): line.is_dashed() for line in axes.lines}
    assert dashed == {VIOLATED: True, ORANGE: False}
    assert {line.get_color(): line.get_xydata()[-1].tolist() for line in axes.lines} == {
        VIOLATED: [12, 10],
        ORANGE: [12, 12],
    }
    plans(axes, {"decision": scene["decision"]}, 0)
    assert len(axes.lines) == 2  # where nobody recorded them


def test_a_violation_is_a_ring_with_the_number_of_the_agent(axes):
    places = np.array([(1.0, 2.0), (3.0, 4.0), (np.nan, 0.0)])
    violations(axes, places, {"violated": np.array([[False, True, True]])}, 0)
    (ring,) = axes.lines
    assert (ring.get_markeredgecolor(), ring.get_markerfacecolor()) == (VIOLATED, "none")
    assert [text.get_text() for text in axes.texts] == ["1"]
    violations(axes, places, {}, 0)
    assert len(axes.lines) == 1


def test_violated_is_told_from_every_decider_by_its_lightness():
    def light(color):
        return sum(
            part * (int(color[k : k + 2], 16) / 255) ** 2.2
            for part, k in ((0.2126, 1), (0.7152, 3), (0.0722, 5))
        )

    assert VIOLATED not in DECIDED
    assert light(DECIDED[1]) > 3 * light(VIOLATED)


def test_few_agents_carry_numbers_and_a_scale_its_length(axes):
    numbers(axes, np.zeros((2, 2)))
    scale_bar(axes, 0, 0, 5)
    numbers(axes, np.zeros((20, 2)))
    assert [text.get_text() for text in axes.texts] == ["0", "1", "5 m"]


def test_worlds_of_older_run_folders_find_what_they_import(axes):
    from stlc.controller.sketch import BANK, CHARGE, GOAL, GROUND, NOTE, STONE, WALL, WATER, pieces

    assert all((BANK, CHARGE, GOAL, GROUND, NOTE, STONE, WALL, WATER))
    pieces(axes, np.zeros((3, 2)), np.array([(0.0, 0.0), (1.0, 0.0)]), "white", 1.0)
    assert len(axes.lines) == 1
