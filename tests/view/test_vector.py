"""Drawings, kept as commands."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from stlc.view.animation import Animation, dark_colors
from stlc.view.style import BLUE, INK, ON_DARK
from stlc.view.vector import vector_animation, vector_frames


def square(axes, index):
    axes.set(xlim=(0, 10), ylim=(0, 10))
    axes.set_axis_off()
    axes.fill((0, 10, 10, 0), (0, 0, 5, 5), fc=BLUE, lw=0)
    axes.plot((index, index + 1, np.nan, 3, 4), (10, 10, np.nan, 0, 0), color=INK, lw=1.44, ls="--")
    axes.text(5, 5, "a <b> $x$", ha="center", color=INK)


def test_what_frames_share_is_kept_once():
    recorded = vector_frames(square, range(3), (2.0, 1.0))
    assert (recorded.width, recorded.height) == (200, 100)
    assert [len(frame) for frame in recorded.frames] == [3, 3, 3]
    assert len(recorded.commands) == 2 + 3
    shared = set.intersection(*map(set, recorded.frames))
    assert {recorded.commands[number][0] for number in shared} == {"p", "t"}


def test_coordinates_are_quarters_of_a_dot_from_the_upper_left():
    recorded = vector_frames(square, range(1), (2.0, 1.0))
    area, line, words = (recorded.commands[number] for number in recorded.frames[0])
    assert area[1:4] == ("M0 400l800 0l0 -200l-800 0z", BLUE, None)
    assert line[1] == "M0 0l80 0M240 400l80 0"  # a gap begins anew
    assert line[3:5] == (INK, 2)
    assert line[5]
    assert words[0:4] == ("t", 400, 200, "a <b> $x$")  # no mathematics in names
    assert words[6] == "center"


def test_a_line_without_a_gap_goes_on():
    def stretches(axes, _):
        axes.set(xlim=(0, 2), ylim=(0, 1))
        axes.set_axis_off()
        axes.plot((0, 1, np.nan, 1, 2), (0, 0, np.nan, 0, 0), color=INK)

    (command,) = vector_frames(stretches, range(1), (2.0, 1.0)).commands
    assert command[1] == "M0 400l400 0l400 0"


def test_what_is_cut_to_an_outline_says_so_and_what_cannot_be_seen_is_left_out():
    def clipped(axes, _):
        axes.set(xlim=(0, 2), ylim=(0, 1))
        axes.set_axis_off()
        (frame,) = axes.fill((0, 1, 1), (0, 0, 1), fc=INK, alpha=0.5, lw=0)
        axes.fill((0, 2, 2), (0, 0, 1), fc=BLUE, lw=0)[0].set_clip_path(frame)
        axes.plot((0, 1), (0, 1), color=INK, alpha=0)

    seen, cut = vector_frames(clipped, range(1), (2.0, 1.0)).commands
    assert seen[2] == INK + "80"
    assert cut[6] == seen[1]


def test_pictures_are_embedded_and_stay_on_white_paper():
    def pixels(axes, _):
        axes.imshow(np.zeros((4, 8, 3)), extent=(0, 8, 0, 4))
        axes.set_axis_off()

    recorded = vector_frames(pixels, range(1), (2.0, 1.0))
    (command,) = recorded.commands
    assert command[0] == "i"
    assert command[5].startswith("data:image/webp;base64,")
    assert recorded.pictured
    assert dark_colors([recorded], ON_DARK) == {}


def test_colours_that_nobody_has_chosen_stay_on_white_paper():
    recorded = vector_frames(square, range(1), (2.0, 1.0))
    assert dark_colors([recorded], ON_DARK) == ON_DARK
    assert dark_colors([recorded], {BLUE: "#ffffff"}) == {}


def test_a_whole_picture_is_recorded():
    def begin(figure):
        (line,) = figure.add_subplot().plot((0, 1), (0, 1))
        figure.set_layout_engine("none")
        return lambda index: line.set_data((0, index), (0, 1))

    recorded = vector_animation(Animation(3, 0.1, (2, 1), begin, "a line"), range(3))
    assert len(recorded.frames) == 3
    assert len({tuple(frame) for frame in recorded.frames}) == 3
