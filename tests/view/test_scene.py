"""Scenes with their legend and the strip of margins beneath them."""

import numpy as np
import pytest

from stlc.controller.sketch import DECIDERS
from stlc.view.animation import DPI
from stlc.view.scene import TALLEST, WIDTH, SceneOptions, scene_animation
from stlc.view.signals import MOST_ROWS, Strip
from stlc.view.style import PAPER, new_figure, picture_style

FRAMES = 21
TIMES = np.arange(FRAMES) * 0.1


def draw_field(axes, scene, index):
    axes.plot(scene["x"][index], 5, "o", color="#0072b2")
    axes.set(xlim=(0, 20), ylim=(0, 20 * float(scene["tall"][0])), aspect="equal")
    axes.set_axis_off()


def scene_of(tall=0.4, decision=None):
    scene = {"x": np.linspace(1, 19, FRAMES), "tall": np.full(FRAMES, tall)}
    return scene if decision is None else {**scene, "decision": decision}


def drawn(animation, index):
    """The figure at an instant, and its picture."""
    with picture_style():
        figure = new_figure(*animation.size)
        figure.set_dpi(DPI)
        figure.set_facecolor(PAPER)
        animation.begin(figure)(index)
        return figure, np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)


def texts(figure):
    return [text.get_text() for part in (figure, *figure.axes) for text in part.texts]


@pytest.fixture
def acted():
    decision = np.zeros((FRAMES, 4), dtype=np.int8)
    decision[12:14, :3] = 1
    decision[5, 0] = 2
    return decision


def strip_of(decision, **margins):
    known = {name: np.asarray(rho, dtype=float) for name, rho in margins.items()}
    return Strip(TIMES, known, decision.astype(np.int64))


def test_a_flat_scene_has_its_strip_beneath_and_a_tall_one_beside(acted):
    strip = strip_of(acted, safe=np.linspace(1, -1, FRAMES))
    sizes = {
        tall: scene_animation(scene_of(tall, acted), SceneOptions(draw_field, 0.1, strip=strip)).size
        for tall in (0.3, 1.0)
    }
    assert sizes[0.3][0] == WIDTH
    assert sizes[0.3][1] > 0.3 * WIDTH + 1
    assert sizes[1.0][0] > TALLEST + 3
    assert sizes[1.0][1] < TALLEST + 1.5


def test_the_still_is_where_most_agents_were_guarded(acted):
    assert scene_animation(scene_of(decision=acted), SceneOptions(draw_field, 0.1)).moment in (12, 13)
    assert scene_animation(scene_of(), SceneOptions(draw_field, 0.1)).moment == FRAMES // 2


def test_the_legend_names_who_decided_and_what_the_world_adds(acted):
    options = SceneOptions(draw_field, 0.1, keys={"goal": "#009e73"})
    figure, _ = drawn(scene_animation(scene_of(decision=acted), options), 0)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [*DECIDERS[:3], "goal"]
    free, _ = drawn(scene_animation(scene_of(), SceneOptions(draw_field, 0.1)), 0)
    assert not free.legends


def test_the_strip_tells_the_present(acted):
    strip = strip_of(acted, safe=np.linspace(1, -1, FRAMES), never=np.full(FRAMES, np.nan))
    assert strip.rows == ["safe"]
    assert strip.height == 2
    animation = scene_animation(scene_of(decision=acted), SceneOptions(draw_field, 0.1, "run", strip=strip))
    before, early = drawn(animation, 0)
    assert {"guard acted", "safe", "+1.00", "0 of 4", "run", "0.0 s"} <= set(texts(before))
    assert {"-0.20", "3 of 4", "1.2 s"} <= set(texts(drawn(animation, 12)[0]))
    _, late = drawn(animation, FRAMES - 1)
    near = [np.abs(picture - (230, 159, 0)).max(2) < 12 for picture in (early, late)]
    orange = [mask[mask.shape[0] // 2 :].sum() for mask in near]
    assert orange[1] > 200 > 5 > orange[0]  # the future is veiled


def test_margins_have_their_units(acted):
    margins = {"safe": np.full(FRAMES, 0.25), "mixed": np.full(FRAMES, -0.004)}
    strip = Strip(TIMES, margins, acted.astype(np.int64), units={"safe": "m"})
    animation = scene_animation(scene_of(decision=acted), SceneOptions(draw_field, 0.1, strip=strip))
    assert {"+0.25 m", "+0.00"} <= set(texts(drawn(animation, 3)[0]))


def test_the_least_margins_are_kept_where_there_are_many(acted):
    margins = {f"r{k}": np.full(FRAMES, float(k)) for k in range(12)}
    assert strip_of(acted, **margins).rows == [f"r{k}" for k in range(MOST_ROWS)]
