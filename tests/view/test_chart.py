"""The map: who is where when, red for what is violated, and the film of it."""

import numpy as np
import pytest
from PIL import Image
from walks import judged, walk

from stlc.rundir import RunDir
from stlc.trace import save_trace
from stlc.view.animate import film_of
from stlc.view.chart import _clearest, chart_film, chart_of, draw_chart
from stlc.view.driven import map_section
from stlc.view.film import save_film
from stlc.view.material import gather
from stlc.view.style import RED, look, new_figure


@pytest.fixture
def chart():
    trace = walk()
    return chart_of(*judged(trace), trace)


def test_who_violates_and_who_is_where(chart):
    assert chart.violated.tolist() == [False, False, True, True]
    assert chart.first(2).tolist() == [2, 3]
    marsh, gate, *_ = chart.plane.places
    assert chart.inside(marsh).any(1).tolist() == [False, False, True, True]
    assert chart.inside(gate)[:, 20].tolist() == [True, True, True, False]
    assert chart.color(marsh) == RED != chart.color(gate)


def test_the_picture_says_what_it_shows(chart, tmp_path):
    picture = draw_chart(chart)
    assert "4 traces, 2 of which satisfy" in picture.alt
    plot, *rows = picture.figure.axes
    assert [row.get_title(loc="left") for row in rows][:2] == ["not in marsh", "in gate"]
    texts = {text.get_text() for text in plot.texts}
    assert {"marsh", "gate", "yard"} <= texts
    labels = [text.get_text() for text in plot.get_legend().get_texts()]
    assert labels == ["satisfied (2)", "violated (2)"]
    assert picture.save_png(tmp_path / "map.png").stat().st_size > 10_000


def test_a_name_stands_in_its_place_and_out_of_others():
    depth = 5.0 - np.abs(np.arange(11) - 5.0)[None, :]  # deepest in the middle, where another place is
    other = 2.0 - np.abs(np.arange(11) - 5.0)[None, :]
    _, column = _clearest(depth, [other])
    assert other[0, column] <= 0 < depth[0, column]
    assert _clearest(depth, []) == (0, 5)
    assert _clearest(depth, [np.full_like(depth, 9.0)]) == (0, 5)  # within another altogether


def test_presence_is_a_share_of_the_traces(chart):
    gate = draw_chart(chart).figure.axes[2]
    now, so_far = (line.get_ydata() for line in gate.lines)
    assert now[20] == pytest.approx(0.75)
    assert now[-1] == 0.0
    assert so_far[-1] == pytest.approx(0.75)
    assert np.all(np.diff(so_far) >= 0)


def test_places_are_strong_while_they_matter(chart):
    film = chart_film(chart, title="walk")
    with look():
        figure = new_figure(*film.size)
        turn = film.begin(figure)
        gate = figure.axes[0].patches[1]
        seen = []
        for index in (0, 20, 40):
            turn(index)
            seen.append(gate.get_facecolor()[3])
    assert seen[0] == seen[2] < seen[1]


def test_the_film_moves(chart, tmp_path):
    path = tmp_path / "walk.gif"
    save_film(chart_film(chart), path, max_frames=3)
    with Image.open(path) as image:
        assert image.n_frames == 3


def test_a_run_whose_specification_names_places_shows_the_map(tmp_path):
    run = RunDir.create(tmp_path, "walk")
    trace = walk()
    run.update({"spec": "walk", "status": "finished"})
    save_trace(run.path / "trace.npz", trace)
    film = film_of(run)
    assert film is not None
    assert "places" in film.alt
    section = map_section(gather(run))
    assert section is not None
    assert section.picture is not None
    assert "dashed" in section.html
