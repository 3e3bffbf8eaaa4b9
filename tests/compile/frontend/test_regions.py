from __future__ import annotations

import math

import pytest
from helpers import reference
from helpers.resolving import margin, state
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from stlc.compile.frontend.regions import area, simple
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import SpecError

L_SHAPE = ((0.0, 0.0), (4.0, 0.0), (4.0, 1.0), (1.0, 1.0), (1.0, 3.0), (0.0, 3.0))
SQUARE = ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0))
STAR = tuple(
    ((3 if i % 2 else 1) * math.cos(i * math.pi / 5), (3 if i % 2 else 1) * math.sin(i * math.pi / 5))
    for i in range(10)
)

coordinate = st.floats(-5, 5).map(lambda value: round(value, 3))
points = st.tuples(coordinate, coordinate)


def distance(region: str, point) -> float:
    num = _CACHE.get(region)
    if num is None:
        num = _CACHE[region] = margin(f"sdist({'q' if len(point) == 3 else 'p'}, {region})")
    names = "q" if len(point) == 3 else "p"
    return reference.number(num, {f"{names}[{i}]": value for i, value in enumerate(point)})


_CACHE: dict[str, ir.Num] = {}


def _polygon(corners) -> str:
    return f"polygon({', '.join(f'[{x!r}, {y!r}]' for x, y in corners)})".replace("e-", "e-")


def _segment(p, a, b) -> float:
    along = (b[0] - a[0], b[1] - a[1])
    share = ((p[0] - a[0]) * along[0] + (p[1] - a[1]) * along[1]) / (along[0] ** 2 + along[1] ** 2)
    share = min(max(share, 0.0), 1.0)
    return math.hypot(p[0] - a[0] - share * along[0], p[1] - a[1] - share * along[1])


def _inside(p, corners) -> bool:
    """Even-odd rule."""
    found = False
    for a, b in zip(corners, (*corners[1:], corners[0]), strict=True):
        if (a[1] > p[1]) != (b[1] > p[1]) and p[0] < a[0] + (p[1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0]):
            found = not found
    return found


@pytest.mark.parametrize(
    "corners", [SQUARE, L_SHAPE, STAR, L_SHAPE[::-1]], ids=["square", "L", "star", "clockwise"]
)
@settings(max_examples=18)
@given(p=points)
def test_a_polygon_is_its_euclidean_distance(corners, p) -> None:
    edges = zip(corners, (*corners[1:], corners[0]), strict=True)
    nearest = min(_segment(p, a, b) for a, b in edges)
    found = distance(_polygon(corners), p)
    assert abs(found) == pytest.approx(nearest, abs=1e-9)
    assume(nearest > 1e-9)
    assert (found > 0) == _inside(p, corners)


@settings(max_examples=18)
@given(points)
def test_a_box_is_the_polygon_of_its_corners(p) -> None:
    assert distance("box(lower = [0, 0], upper = [2, 2])", p) == pytest.approx(
        distance(_polygon(SQUARE), p), abs=1e-9
    )


@settings(max_examples=12)
@given(st.tuples(coordinate, coordinate, coordinate))
def test_a_box_in_space(p) -> None:
    low, high = (-1.0, -2.0, 0.0), (1.0, 2.0, 3.0)
    room = [min(x - a, b - x) for x, a, b in zip(p, low, high, strict=True)]
    outside = math.sqrt(sum(min(r, 0.0) ** 2 for r in room))
    wanted = min(room) if min(room) > 0 else -outside
    assert distance("box([-1, -2, 0], [1, 2, 3])", p) == pytest.approx(wanted, abs=1e-12)


@settings(max_examples=12)
@given(points)
def test_simple_regions(p) -> None:
    assert distance("circle(center = [1, 2], radius = 3)", p) == pytest.approx(
        3 - math.hypot(p[0] - 1, p[1] - 2)
    )
    assert distance("halfspace([3, 4], 10)", p) == pytest.approx((10 - 3 * p[0] - 4 * p[1]) / 5, abs=1e-12)


@settings(max_examples=12)
@given(points)
def test_combinations(p) -> None:
    a, b = "circle([0, 0], 2)", "box([0, 0], [3, 3])"
    first, second = distance(a, p), distance(b, p)
    assert distance(f"union({a}, {b})", p) == max(first, second)
    assert distance(f"intersect({a}, {b})", p) == min(first, second)
    assert distance(f"complement({a})", p) == -first
    assert distance(f"dilate({a}, 0.5)", p) == pytest.approx(first + 0.5, abs=1e-12)
    assert distance(f"dilate({b}, -0.5)", p) == pytest.approx(second - 0.5, abs=1e-12)


def test_an_obstacle_may_move() -> None:
    num = margin("sdist(p, hole)", "region hole = circle([x, y], 1 m)")
    row = {"p[0]": 3.0, "p[1]": 0.0, "x": 1.0, "y": 0.0}
    assert reference.number(num, row) == -1.0


def test_orientation_and_crossing() -> None:
    assert area(SQUARE) == 4.0
    assert area(SQUARE[::-1]) == -4.0
    assert simple(L_SHAPE)
    assert simple(STAR)
    assert not simple(((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)))
    assert not simple(((0.0, 0.0), (0.0, 0.0), (1.0, 0.0)))


def test_a_bare_bound_of_a_box_is_read_in_the_unit_of_the_point() -> None:
    region = "[z, z] in box([5, 5], [10 cm, 10 cm])"
    assert state(region, "signal z [cm]")
    with pytest.raises(SpecError, match="this box is empty"):
        state(region, "signal z [m]")
