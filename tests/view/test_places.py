"""Places are where the monitor says they are, and matter when the specification says so."""

import numpy as np
import pytest
from walks import SPEC, judged, walk

from stlc.view.places import labelled, plane_of


def plane(text=SPEC):
    trace = walk(text=text)
    spec, verdict = judged(trace)
    return plane_of(spec, [judgement.rule for judgement in verdict], trace)


def place(name, text=SPEC):
    return next(found for found in plane(text).places if found.name == name)


def test_every_region_of_the_plane_once_in_the_order_of_the_text():
    found = plane()
    assert found.axes == ("x", "y")
    names = [place.name for place in found.places]
    assert names == ["marsh", "gate", "yard", "circle([-3 m, -3 m], 1 m)"]
    assert [place.role for place in found.places] == ["avoid", "reach", "reach", "avoid"]


def test_when_they_matter():
    assert place("marsh").windows == ()
    assert place("gate").windows == ((1.0, 3.0),)
    assert place("gate").visited
    assert not place("yard").visited
    assert [place("yard").active(t) for t in (4.9, 5.0, 6.0, 6.1)] == [False, True, True, False]
    assert place("marsh").active(17.0)
    assert labelled(place("gate").uses) == "pass_gate 1 to 3 s"


def test_windows_of_nested_operators_add_up_and_those_of_plans_slide():
    nested = SPEC.replace("eventually@[1 s, 3 s] ", "eventually[1 s, 2 s] always[0.5 s, 1 s] ")
    assert place("gate", nested).windows == ((1.5, 3.0),)
    sliding = SPEC.replace("eventually@[1 s, 3 s] ", "eventually[0, end] always[0, 1 s] ")
    assert place("gate", sliding).windows == ((0.0, 1.0),)


def test_depth_is_the_signed_distance():
    trace = walk()
    xs, ys, depth = plane().sampled(place("gate"), trace, ((2.0, 6.0), (-2.0, 2.0)), count=41)
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
    assert place("gate", text).role == role


def test_a_region_that_is_reached_and_avoided_is_mixed():
    text = SPEC + "require later: always@[4 s, 5 s] [x, y] not in gate\n"
    assert place("gate", text).role == "mixed"
    assert place("gate", text).windows == ((1.0, 3.0), (4.0, 5.0))


def test_a_region_without_a_name_does_not_cover_the_picture():
    text = SPEC + "require far: always ([x, y] not in box([-9, -9], [-8.5, -8.25]))\n"
    titles = [found.title for found in plane(text).places]
    assert titles[:3] == ["marsh", "gate", "yard"]
    assert max(map(len, titles)) == 26
    assert titles[-1].endswith("…")


def test_moving_regions_are_left_out_and_no_places_are_no_plane():
    moving = SPEC.replace("circle([4 m, 0 m], 1 m)", "circle([4 m + v * 1 s, 0 m], 1 m)")
    assert "gate" not in [found.name for found in plane(moving).places]
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
