"""The map: who is where when, red for what is violated, and the animation of it."""

import numpy as np
import pytest
from helpers.walks import SPEC, judged, walk
from PIL import Image

from stlc.rundir import RunDir
from stlc.view.animation import save_animation
from stlc.view.contents import read_contents
from stlc.view.recorded import map_section
from stlc.view.region_map import _clearest, draw_map, map_animation, map_of, plane_of, uses_text
from stlc.view.run_animation import animation_of
from stlc.view.style import RED, new_figure, picture_style


@pytest.fixture
def region_map():
    trace = walk()
    return map_of(*judged(trace), trace)


def test_who_violates_and_who_is_where(region_map):
    assert region_map.violated.tolist() == [False, False, True, True]
    assert region_map.first(2).tolist() == [2, 3]
    marsh, gate, *_ = region_map.plane.regions
    assert region_map.inside(marsh).any(1).tolist() == [False, False, True, True]
    assert region_map.inside(gate)[:, 20].tolist() == [True, True, True, False]
    assert region_map.color(marsh) == RED != region_map.color(gate)


def test_the_picture_says_what_it_shows(region_map, tmp_path):
    picture = draw_map(region_map)
    assert "4 traces, 2 of which satisfy" in picture.alt
    plot, *rows = picture.figure.axes
    assert [row.get_title(loc="left") for row in rows][:2] == ["in marsh (forbidden)", "in gate"]
    texts = {text.get_text() for text in plot.texts}
    assert {"marsh", "gate", "yard"} <= texts
    labels = [text.get_text() for text in plot.get_legend().get_texts()]
    assert labels == ["satisfied (2)", "violated (2)"]
    assert picture.save_png(tmp_path / "map.png").stat().st_size > 10_000


def test_a_name_stands_in_its_place_and_out_of_others():
    depth = 5.0 - np.abs(np.arange(11) - 5.0)[None, :]  # deepest in the middle, where another region is
    other = 2.0 - np.abs(np.arange(11) - 5.0)[None, :]
    _, column = _clearest(depth, [other])
    assert other[0, column] <= 0 < depth[0, column]
    assert _clearest(depth, []) == (0, 5)
    assert _clearest(depth, [np.full_like(depth, 9.0)]) == (0, 5)  # within another altogether


def test_presence_is_a_share_of_the_traces(region_map):
    gate = draw_map(region_map).figure.axes[2]
    now, so_far = (line.get_ydata() for line in gate.lines)
    assert now[20] == pytest.approx(0.75)
    assert now[-1] == 0.0
    assert so_far[-1] == pytest.approx(0.75)
    assert np.all(np.diff(so_far) >= 0)


def test_places_are_strong_while_they_matter(region_map):
    animation = map_animation(region_map, title="walk")
    with picture_style():
        figure = new_figure(*animation.size)
        turn = animation.begin(figure)
        gate = figure.axes[0].patches[1]
        seen = []
        for index in (0, 20, 40):
            turn(index)
            seen.append(gate.get_facecolor()[3])
    assert seen[0] == seen[2] < seen[1]


@pytest.mark.apart
def test_the_film_moves(region_map, tmp_path):
    path = tmp_path / "walk.gif"
    save_animation(map_animation(region_map), path, max_frames=3)
    with Image.open(path) as image:
        assert image.n_frames == 3


def test_a_run_whose_specification_names_places_shows_the_map(tmp_path):
    run = RunDir.create(tmp_path, "walk")
    trace = walk()
    run.update({"spec": "walk", "status": "finished"})
    trace.save(run.path / "trace.npz")
    animation = animation_of(run)
    assert animation is not None
    assert "regions" in animation.alt
    section = map_section(read_contents(run))
    assert section is not None
    assert section.picture is not None
    assert "dashed" in section.html


# ---------------------------------------------------------------------- test_places


def plane(text=SPEC):
    trace = walk(text=text)
    spec, verdict = judged(trace)
    return plane_of(spec, [judgement.rule for judgement in verdict], trace)


def region(name, text=SPEC):
    return next(found for found in plane(text).regions if found.name == name)


def test_every_region_of_the_plane_once_in_the_order_of_the_text():
    found = plane()
    assert found.axes == ("x", "y")
    names = [region.name for region in found.regions]
    assert names == ["marsh", "gate", "yard", "circle([-3 m, -3 m], 1 m)"]
    assert [region.role for region in found.regions] == ["avoid", "reach", "reach", "avoid"]


def test_when_they_matter():
    assert region("marsh").windows == ()
    assert region("gate").windows == ((1.0, 3.0),)
    assert region("gate").visited
    assert not region("yard").visited
    assert [region("yard").active(t) for t in (4.9, 5.0, 6.0, 6.1)] == [False, True, True, False]
    assert region("marsh").active(17.0)
    assert uses_text(region("gate").uses) == "pass_gate 1 to 3 s"


def test_windows_of_nested_operators_add_up_and_those_of_plans_slide():
    nested = SPEC.replace("eventually@[1 s, 3 s] ", "eventually[1 s, 2 s] always[0.5 s, 1 s] ")
    assert region("gate", nested).windows == ((1.5, 3.0),)
    sliding = SPEC.replace("eventually@[1 s, 3 s] ", "eventually[0, end] always[0, 1 s] ")
    assert region("gate", sliding).windows == ((0.0, 1.0),)


def test_depth_is_the_signed_distance():
    trace = walk()
    xs, ys, depth = plane().sampled(region("gate"), trace, ((2.0, 6.0), (-2.0, 2.0)), count=41)
    across, up = np.meshgrid(xs, ys)
    np.testing.assert_allclose(depth, 1.0 - np.hypot(across - 4, up), atol=1e-12)


@pytest.mark.parametrize(
    ("written", "role"),
    [
        ("not [x, y] in gate", "avoid"),
        ("sweep([x, y]) not in gate", "avoid"),
        ("sweep([x, y]) in gate", "reach"),
        ("[x, y] in gate -> v < 1 m/s", "avoid"),
        ("[x, y] in gate <-> [x, y] in gate", "reach"),
    ],
)
def test_the_role_follows_negations(written, role):
    text = SPEC.replace("eventually@[1 s, 3 s] [x, y] in gate", f"always[0 s, 1 s] ({written})")
    assert region("gate", text).role == role


def test_a_region_that_is_reached_and_avoided_is_mixed():
    text = SPEC + "require later: always@[4 s, 5 s] [x, y] not in gate\n"
    assert region("gate", text).role == "mixed"
    assert region("gate", text).windows == ((1.0, 3.0), (4.0, 5.0))


def test_a_region_without_a_name_does_not_cover_the_picture():
    text = SPEC + "require far: always ([x, y] not in box([-9, -9], [-8.5, -8.25]))\n"
    titles = [found.title for found in plane(text).regions]
    assert titles[:3] == ["marsh", "gate", "yard"]
    assert max(map(len, titles)) == 26
    assert titles[-1].endswith("…")


def test_moving_regions_are_left_out_and_no_places_are_no_plane():
    moving = SPEC.replace("circle([4 m, 0 m], 1 m)", "circle([4 m + v * 1 s, 0 m], 1 m)")
    assert "gate" not in [found.name for found in plane(moving).regions]
    text = "spec walk\nstate signal x [m]\nrequire low: always x < 9 m\n"
    trace = walk(text=text)
    spec, verdict = judged(trace)
    assert plane_of(spec, [judgement.rule for judgement in verdict], trace) is None


def test_the_window_holds_paths_and_bounded_places():
    text = SPEC.replace("not ([x, y] in circle([-3 m, -3 m], 1 m)", "not ([x, y] in halfspace([1, 0], -90)")
    (left, right), (low, high) = plane(text).window(walk())
    assert -2.0 < left < -0.9
    assert 5.0 < right < 6.0
    assert -2.0 < low < -0.9
    assert 4.9 < high < 6.0
