"""Regions and the signed distance of a point to a region, positive inside.

Distances to balls, boxes, half-spaces and polygons are Euclidean and exact. The distance to a union is the
greatest of the distances to its parts. The distance to an intersection is the least of them. The sign of
these distances is exact; inside a union and outside an intersection their magnitude is a lower bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import TypeVar

from stlc.compile.frontend.arithmetic import agree, apply, cross, dot, gap, minus, negated, norm
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.values import (
    BoxRegion,
    Combined,
    Complement,
    Dilated,
    HalfSpace,
    NormBall,
    Number,
    Polygon,
    Region,
    VectorValue,
    literal,
)
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import Diagnostic
from stlc.source import Span

PlanePoint = tuple[float, float]
T = TypeVar("T")


def points(corners: Sequence[VectorValue]) -> tuple[PlanePoint, ...] | None:
    """Return the corners as floats in SI units.

    The result is None if a corner varies or is not a point of the plane.
    """
    found: list[PlanePoint] = []
    for corner in corners:
        values = [item.constant for item in corner.items]
        if len(values) != 2 or values[0] is None or values[1] is None:
            return None
        found.append((values[0], values[1]))
    return tuple(found)


def edges(corners: Sequence[T]) -> list[tuple[T, T]]:
    """Return the edges of a polygon, as pairs of adjacent corners."""
    return list(zip(corners, (*corners[1:], corners[0]), strict=True))


def turn(a: PlanePoint, b: PlanePoint, c: PlanePoint) -> float:
    """Return twice the signed area of a triangle: positive where `c` lies left of `a -> b`."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def area(corners: Sequence[PlanePoint]) -> float:
    """Return the signed area of a polygon: positive for counter-clockwise corners."""
    return sum(a[0] * b[1] - a[1] * b[0] for a, b in edges(corners)) / 2


def simple(corners: Sequence[PlanePoint]) -> bool:
    """True if a polygon is simple: no two edges cross, and no adjacent corners coincide."""
    return all(a != b for a, b in edges(corners)) and not any(
        turn(a, b, c) * turn(a, b, d) < 0 and turn(c, d, a) * turn(c, d, b) < 0
        for (a, b), (c, d) in combinations(edges(corners), 2)
    )


def convex(corners: Sequence[VectorValue]) -> bool:
    """True if a simple polygon with constant, counter-clockwise corners is convex."""
    plain = points(corners)
    assert plain is not None
    return all(turn(plain[i - 2], plain[i - 1], plain[i]) >= 0 for i in range(len(plain)))


def triangles(corners: Sequence[VectorValue]) -> list[tuple[VectorValue, ...]]:
    """Return convex parts of a polygon: triangles from ear clipping, or the polygon itself if it is convex.

    Args:
        corners: corners of a simple polygon, constant and counter-clockwise.
    """
    plain = points(corners)
    assert plain is not None
    left = list(range(len(corners)))
    if convex(corners):
        return [tuple(corners)]
    cut: list[tuple[VectorValue, ...]] = []
    while len(left) > 3:
        ear = next((k for k in range(len(left)) if _is_ear(plain, left, k)), 0)
        a, b, c = left[ear - 1], left[ear], left[(ear + 1) % len(left)]
        if turn(plain[a], plain[b], plain[c]) > 0:
            cut.append((corners[a], corners[b], corners[c]))
        del left[ear]
    cut.append(tuple(corners[i] for i in left))
    return cut


def _is_ear(plain: Sequence[PlanePoint], left: Sequence[int], k: int) -> bool:
    """True if a corner of a polygon can be cut off: the corner with the number `left[k]`.

    The polygon must be convex at this corner, and the triangle cut off must contain no other corner. `plain`
    are all corners of the original polygon. `left` are the numbers of the corners not yet cut off.
    """
    a, b, c = (plain[left[i % len(left)]] for i in (k - 1, k, k + 1))
    if turn(a, b, c) <= 0:
        return False
    others = [plain[i] for i in left if plain[i] not in (a, b, c)]
    return not any(turn(a, b, p) >= 0 and turn(b, c, p) >= 0 and turn(c, a, p) >= 0 for p in others)


def dimension(region: Region) -> int:
    """Return the number of coordinates of the points of a region."""
    match region:
        case NormBall(vector) | BoxRegion(vector) | HalfSpace(vector):
            return len(vector.items)
        case Polygon():
            return 2
        case Combined(_, (part, *_)) | Dilated(part) | Complement(part):
            return dimension(part)
    raise AssertionError("a combination has at least one part")


def check_dimension(point: VectorValue, region: Region, span: Span, scope: Scope) -> None:
    """Raise Failed (E205) for a point with another number of components than the region."""
    size = dimension(region)
    if size != len(point.items):
        message = f"a point of {len(point.items)} components and a region of {size} do not go together"
        scope.fail(Diagnostic("E205", message, span))


def signed_distance(point: VectorValue, region: Region, span: Span, scope: Scope) -> Number:
    """Return the signed distance of `point` to the boundary of `region`, in SI units; positive inside.

    Raises:
        Failed: the point has another number of components, or another unit (E205, E203).
    """
    check_dimension(point, region, span, scope)
    match region:
        case NormBall(center, radius):
            away = norm(minus(point, center, span, scope), span, scope)
            return apply("sub", (radius, away), span, scope)
        case BoxRegion(lower, upper):
            return _box(point, lower, upper, span, scope)
        case HalfSpace(normal, offset):
            room = gap(offset, dot(normal, point, span, scope), span, scope)
            return apply("div", (room, norm(normal, span, scope)), span, scope)
        case Polygon(corners):
            return _polygon(point, corners, span, scope)
        case _:

            def of_part(part: Region) -> Number:
                return signed_distance(point, part, span, scope)

            return composed(region, of_part, of_part, lambda margin: margin, span, scope)


def composed(
    region: Combined | Dilated | Complement,
    inner: Callable[[Region], Number],
    opposite: Callable[[Region], Number],
    margin: Callable[[Number], Number],
    span: Span,
    scope: Scope,
) -> Number:
    """Return the signed distance to a union, intersection, dilation or complement of other regions.

    Args:
        region: the composed region.
        inner: function that returns the signed distance to a part of a union, intersection or dilation.
        opposite: function that returns the signed distance to the region of which a complement is taken; the
            sign is reversed afterwards. If `inner` returns the least distance along a segment, `opposite`
            returns the greatest, and vice versa.
        margin: function that returns the number to add to the distance if a region is dilated; its argument
            is the margin of the dilation.
        span: source location of the expression.
        scope: receives findings.
    """
    match region:
        case Combined(op, parts):
            return apply("max" if op == "union" else "min", list(map(inner, parts)), span, scope)
        case Dilated(part, extra):
            return apply("add", (inner(part), margin(extra)), span, scope)
        case Complement(part):
            return negated(opposite(part), span)


def _box(point: VectorValue, lower: VectorValue, upper: VectorValue, span: Span, scope: Scope) -> Number:
    """Return the signed distance to a box.

    For a point inside the box, the result is the distance to the nearest face. For a point outside, the
    result is minus the Euclidean distance to the box.
    """
    for p, low, high in zip(point.items, lower.items, upper.items, strict=True):
        if low.bare is not high.bare:
            (_, low, high), _ = agree((p, low, high), "compare", span, scope)
            if low.constant is not None and high.constant is not None and low.constant > high.constant:
                message = "this box is empty: a lower bound is above the upper one"
                scope.fail(Diagnostic("E205", message, span))
    room = [
        apply("min", (gap(p, low, span, scope), gap(high, p, span, scope)), span, scope)
        for p, low, high in zip(point.items, lower.items, upper.items, strict=True)
    ]
    least = apply("min", room, span, scope)
    beyond = [apply("relu", (negated(side, span),), span, scope) for side in room]
    inside = apply("relu", (least,), span, scope)
    return apply("sub", (inside, apply("norm", beyond, span, scope)), span, scope)


def _polygon(point: VectorValue, corners: Sequence[VectorValue], span: Span, scope: Scope) -> Number:
    """Return the signed distance to a polygon: the distance to the nearest edge, negative outside."""
    nearest = apply("min", [to_segment(point, a, b, span, scope) for a, b in edges(corners)], span, scope)
    parts = []
    for triangle in triangles(corners):
        sides = (side(point, start, end, span, scope) for start, end in edges(triangle))
        left_of_all = tuple(ir.Predicate(each.num, span=span) for each in sides)
        parts.append(ir.BoolOp("and", left_of_all, span))
    inside = parts[0] if len(parts) == 1 else ir.BoolOp("or", tuple(parts), span)
    return Number(
        inside.select(nearest.num, negated(nearest, span).num), nearest.unit, nearest.flexible, span=span
    )


def to_segment(point: VectorValue, start: VectorValue, end: VectorValue, span: Span, scope: Scope) -> Number:
    """Return the distance of a point to a segment."""
    along, ahead = minus(end, start, span, scope), minus(point, start, span, scope)
    share = apply("div", (dot(ahead, along, span, scope), dot(along, along, span, scope)), span, scope)
    share = apply("clip", (share, literal(0, span), literal(1, span)), span, scope)
    foot = VectorValue(tuple(apply("mul", (share, item), span, scope) for item in along.items), span=span)
    return norm(minus(ahead, foot, span, scope), span, scope)


def side(point: VectorValue, start: VectorValue, end: VectorValue, span: Span, scope: Scope) -> Number:
    """Return twice the signed area of the triangle `start`, `end`, `point`.

    Unlike in `turn`, the points may depend on signals. The area is positive if `point` is left of the edge
    from `start` to `end`.
    """
    found = cross(minus(end, start, span, scope), minus(point, start, span, scope), span, scope)
    assert isinstance(found, Number)
    return found
