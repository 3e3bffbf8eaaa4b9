"""Plane polygons with known corners: orientation, simplicity, triangles."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from stlc.compile.frontend.values import Vector

Point = tuple[float, float]


def points(corners: Sequence[Vector]) -> tuple[Point, ...] | None:
    """The corners as floats in SI units, or None where one is not a known point of the plane."""
    found: list[Point] = []
    for corner in corners:
        values = [item.constant for item in corner.items]
        if len(values) != 2 or values[0] is None or values[1] is None:
            return None
        found.append((values[0], values[1]))
    return tuple(found)


def turn(a: Point, b: Point, c: Point) -> float:
    """Twice the signed area of a triangle: positive where `c` lies left of `a -> b`."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def area(corners: Sequence[Point]) -> float:
    """The signed area: positive where the corners run counter-clockwise."""
    pairs = zip(corners, (*corners[1:], corners[0]), strict=True)
    return sum(a[0] * b[1] - a[1] * b[0] for a, b in pairs) / 2


def simple(corners: Sequence[Point]) -> bool:
    """Whether no two edges cross and no two neighbours coincide."""
    edges = list(zip(corners, (*corners[1:], corners[0]), strict=True))
    if any(a == b for a, b in edges):
        return False
    return not any(_cross(first, second) for first, second in combinations(edges, 2))


def _cross(first: tuple[Point, Point], second: tuple[Point, Point]) -> bool:
    (a, b), (c, d) = first, second
    return turn(a, b, c) * turn(a, b, d) < 0 and turn(c, d, a) * turn(c, d, b) < 0


def convex(corners: Sequence[Vector]) -> bool:
    """Whether a simple polygon with known, counter-clockwise corners is convex."""
    plain = points(corners)
    assert plain is not None
    return all(turn(plain[i - 2], plain[i - 1], plain[i]) >= 0 for i in range(len(plain)))


def triangles(corners: Sequence[Vector]) -> list[tuple[Vector, ...]]:
    """A convex polygon as it is, any other cut into triangles by clipping ears.

    Args:
        corners: of a simple polygon, known, counter-clockwise.
    """
    plain = points(corners)
    assert plain is not None
    left = list(range(len(corners)))
    if convex(corners):
        return [tuple(corners)]
    cut: list[tuple[Vector, ...]] = []
    while len(left) > 3:
        ear = next((k for k in range(len(left)) if _is_ear(plain, left, k)), 0)
        a, b, c = left[ear - 1], left[ear], left[(ear + 1) % len(left)]
        if turn(plain[a], plain[b], plain[c]) > 0:
            cut.append((corners[a], corners[b], corners[c]))
        del left[ear]
    cut.append(tuple(corners[i] for i in left))
    return cut


def _is_ear(plain: Sequence[Point], left: Sequence[int], k: int) -> bool:
    """Whether corner `k` can be cut off: it is convex and its triangle holds no other corner."""
    a, b, c = (plain[left[i % len(left)]] for i in (k - 1, k, k + 1))
    if turn(a, b, c) <= 0:
        return False
    others = [plain[i] for i in left if plain[i] not in (a, b, c)]
    return not any(turn(a, b, p) >= 0 and turn(b, c, p) >= 0 and turn(c, a, p) >= 0 for p in others)
