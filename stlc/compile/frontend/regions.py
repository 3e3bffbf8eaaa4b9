"""Regions and their signed distance, positive inside.

Ball, box, half-space and polygon are exact Euclidean distances. A union is the max of its parts, an
intersection the min: exact in sign, a lower bound of the distance inside a union or outside an intersection.
"""

from __future__ import annotations

from collections.abc import Sequence

from stlc.compile.frontend.algebra import agree, apply, gap, negated
from stlc.compile.frontend.polygons import triangles
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.values import (
    Ball,
    Box,
    Combined,
    Complement,
    Dilated,
    HalfSpace,
    Number,
    Polygon,
    Region,
    Vector,
    literal,
)
from stlc.compile.frontend.vectors import cross, dot, minus, norm
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import Diagnostic
from stlc.source import Span


def dimension(region: Region) -> int | None:
    """How many components its points have; None where any will do."""
    match region:
        case Ball(center):
            return len(center.items)
        case Box(lower):
            return len(lower.items)
        case HalfSpace(normal):
            return len(normal.items)
        case Polygon():
            return 2
        case Combined(_, parts):
            return dimension(parts[0])
        case Dilated(inner) | Complement(inner):
            return dimension(inner)


def signed_distance(point: Vector, region: Region, span: Span, scope: Scope) -> Number:
    """How far `point` is inside `region` (negative: outside), in SI units.

    Raises:
        Failed: the point has another number of components, or another unit (E205, E203).
    """
    size = dimension(region)
    if size is not None and size != len(point.items):
        message = f"a point of {len(point.items)} components and a region of {size} do not go together"
        scope.fail(Diagnostic("E205", message, span))
    match region:
        case Ball(center, radius):
            away = norm(minus(point, center, span, scope), span, scope)
            return apply("sub", (radius, away), span, scope)
        case Box(lower, upper):
            return _box(point, lower, upper, span, scope)
        case HalfSpace(normal, offset):
            room = gap(offset, dot(normal, point, span, scope), span, scope)
            return apply("div", (room, norm(normal, span, scope)), span, scope)
        case Polygon(corners):
            return _polygon(point, corners, span, scope)
        case Combined(op, parts):
            inner = [signed_distance(point, part, span, scope) for part in parts]
            return apply("max" if op == "union" else "min", inner, span, scope)
        case Dilated(inside, margin):
            return apply("add", (signed_distance(point, inside, span, scope), margin), span, scope)
        case Complement(inside):
            return negated(signed_distance(point, inside, span, scope), span)


def _box(point: Vector, lower: Vector, upper: Vector, span: Span, scope: Scope) -> Number:
    """Min of the room to each face inside; minus the Euclidean distance outside."""
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


def _polygon(point: Vector, corners: Sequence[Vector], span: Span, scope: Scope) -> Number:
    """The distance to the nearest edge, positive where a triangle of the polygon holds the point."""
    edges = zip(corners, (*corners[1:], corners[0]), strict=True)
    nearest = apply("min", [to_segment(point, a, b, span, scope) for a, b in edges], span, scope)
    parts = [_left_of_all(point, triangle, span, scope) for triangle in triangles(corners)]
    inside = parts[0] if len(parts) == 1 else ir.BoolOp("or", tuple(parts), span)
    return Number(
        ir.Where(inside, nearest.num, negated(nearest, span).num), nearest.unit, nearest.flexible, span=span
    )


def to_segment(point: Vector, start: Vector, end: Vector, span: Span, scope: Scope) -> Number:
    """The distance of a point to the segment between two others."""
    along, ahead = minus(end, start, span, scope), minus(point, start, span, scope)
    share = apply("div", (dot(ahead, along, span, scope), dot(along, along, span, scope)), span, scope)
    share = apply("clip", (share, literal(0, span), literal(1, span)), span, scope)
    foot = Vector(tuple(apply("mul", (share, item), span, scope) for item in along.items), span)
    return norm(minus(ahead, foot, span, scope), span, scope)


def _left_of_all(point: Vector, corners: Sequence[Vector], span: Span, scope: Scope) -> ir.Formula:
    """Whether the point lies left of every edge of a convex, counter-clockwise polygon."""
    atoms = []
    for start, end in zip(corners, (*corners[1:], corners[0]), strict=True):
        turn = cross(minus(end, start, span, scope), minus(point, start, span, scope), span, scope)
        assert isinstance(turn, Number)
        atoms.append(ir.Predicate(turn.num, span=span))
    return ir.BoolOp("and", tuple(atoms), span)
