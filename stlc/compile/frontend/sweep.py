"""`sweep(p)`: signed distances of the straight segment from a point to its position at the next sample.

`sweep(p) in R` is the least signed distance along the segment, `sweep(p) not in R` the least signed distance
to the complement. Both are exact for balls, boxes, half-spaces and convex polygons; `in` of an intersection
and `not in` of a union are exact where their parts are, the other two are lower bounds. For a polygon that is
not convex the sign is exact, and so is the value where it is not negative.

A moving region is assumed to move in a straight line too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product

from stlc.compile.frontend.arithmetic import apply, cross, dot, gap, minus, negated, norm
from stlc.compile.frontend.regions import convex, dimension, signed_distance, to_segment
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.values import (
    Box,
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
from stlc.compile.ir.traverse import shifted
from stlc.diagnostics import Diagnostic
from stlc.source import Span

_SHORT = 1e-9
"""Length in SI units below which a segment counts as a point."""
_AHEAD = 1e-6
"""Parameter offset into a piece at which its active faces are determined."""

Pair = tuple[Number, Number]
"""A number at both ends of the segment; linear in between."""


def swept_distance(point: VectorValue, region: Region, span: Span, scope: Scope) -> Number:
    """Return the least signed distance along the segment that starts at `point` now.

    Raises:
        Failed: the point has another number of components, or another unit (E205, E203).
    """
    size = dimension(region)
    if size is not None and size != len(point.items):
        message = f"a point of {len(point.items)} components and a region of {size} do not go together"
        scope.fail(Diagnostic("E205", message, span))
    return _Sweep(point, span, scope).least(region)


class _Sweep:
    """Distance computations along one segment."""

    def __init__(self, point: VectorValue, span: Span, scope: Scope) -> None:
        self.ends = (point, _vector_later(point))
        self.span, self.scope = span, scope

    # -------------------------------------------------------------- least and greatest

    def least(self, region: Region) -> Number:
        """Least signed distance; for a convex region it is concave along the segment, so least at an end."""
        match region:
            case Combined(op, parts):
                return self.apply("max" if op == "union" else "min", *map(self.least, parts))
            case Dilated(inside, margin):
                return self.apply("add", self.least(inside), self.apply("min", *_both(margin)))
            case Complement(inside):
                return self.negative(self.greatest(inside))
            case Polygon(corners) if not convex(corners):
                return self.apply("min", *self.at_ends(region), *self._clearances(corners))
            case _:
                return self.apply("min", *self.at_ends(region))

    def greatest(self, region: Region) -> Number:
        """Greatest signed distance."""
        match region:
            case Combined(op, parts):
                return self.apply("max" if op == "union" else "min", *map(self.greatest, parts))
            case Dilated(inside, margin):
                return self.apply("add", self.greatest(inside), self.apply("max", *_both(margin)))
            case Complement(inside):
                return self.negative(self.least(inside))
            case NormBall(center, radius):
                return self.apply("sub", self.apply("max", *_both(radius)), self.past(center))
            case HalfSpace():
                return self.apply("max", *self.at_ends(region))
            case Box():
                return self._over_box(region)
            case Polygon(corners) if convex(corners):
                outside = [self.negative(self.past(corner)) for corner in corners]
                return self._over(self._edges(corners), (*self.at_ends(region), *outside))
            case Polygon(corners):
                crossed = [self.negative(gap) for gap in self._clearances(corners)]
                return self.apply("max", *self.at_ends(region), *crossed)

    # ------------------------------------------------------------------ convex regions

    def _over_box(self, box: Box) -> Number:
        faces = []
        for axis, sides in enumerate(zip(box.lower.items, box.upper.items, strict=True)):
            for side, sign in zip(sides, (1, -1), strict=True):
                room = [
                    gap(*(pair if sign > 0 else pair[::-1]), self.span, self.scope)
                    for pair in zip((end.items[axis] for end in self.ends), _both(side), strict=True)
                ]
                faces.append((room[0], room[1]))
        size = len(box.lower.items)
        outside: list[Number] = []
        if size == 2:
            corners = product(*zip(box.lower.items, box.upper.items, strict=True))
            outside = [self.negative(self.past(VectorValue(corner))) for corner in corners]
        elif size > 2:
            outside = self._approaches(faces)
        return self._over(faces, (*self.at_ends(box), *outside))

    def _over(self, faces: Sequence[Pair], outside: Sequence[Number]) -> Number:
        """Greatest depth of the segment between the faces, or its least distance where it stays outside."""
        depth = self._depth(faces)
        close = self.apply("max", *outside)
        return self._choose(ir.Predicate(depth.num), depth, close)

    def _depth(self, faces: Sequence[Pair]) -> Number:
        """Max along the segment of the min distance to a face; negative if the segment stays outside.

        By LP duality the min of: each face at its better end; two faces of opposite slope where they meet.
        """
        best = [self.apply("max", *face) for face in faces]
        slopes = [self.apply("sub", after, before) for before, after in faces]
        sizes = [self.apply("abs", slope) for slope in slopes]
        meetings = []
        for i, j in combinations(range(len(faces)), 2):
            total = self.apply("max", self.apply("add", sizes[i], sizes[j]), literal(_SHORT, self.span))
            weighed = (
                self.apply("mul", faces[i][0], sizes[j]),
                self.apply("mul", faces[j][0], sizes[i]),
            )
            there = self.apply("div", self.apply("add", *weighed), total)
            opposed = ir.Predicate(self.apply("mul", slopes[i], slopes[j]).num, -1, strict=True)
            long = ir.Predicate(self.apply("sub", total, literal(_SHORT, self.span)).num, strict=True)
            meetings.append(self._choose(ir.BoolOp("and", (opposed, long)), there, best[i]))
        return self.apply("min", *best, *meetings)

    def _approaches(self, faces: Sequence[Pair]) -> list[Number]:
        """Minus the distance to a box at each candidate for the closest point.

        The squared distance is convex and piecewise quadratic along the segment. Its minimum is that of one
        of the pieces, which start at the segment's start or where it crosses a face.
        """
        slopes = [self.apply("sub", after, before) for before, after in faces]
        starts = [literal(0, self.span), *(self._passing(face) for face in faces)]
        found = []
        for start in starts:
            there = [self._along(face, slope, start) for face, slope in zip(faces, slopes, strict=True)]
            pull, stiffness = [], []
            for room, slope in zip(there, slopes, strict=True):
                ahead = self.apply("add", room, self.apply("mul", slope, literal(_AHEAD, self.span)))
                active = Number(ir.Indicator(ir.Predicate(ahead.num, -1, strict=True)))
                pull.append(self.apply("mul", active, self.apply("mul", room, slope)))
                stiffness.append(self.apply("mul", active, self.apply("square", slope)))
            step = self._ratio(self._sum(pull), self._sum(stiffness))
            share = self._share(self.apply("sub", start, step))
            beyond = [
                self.apply("relu", self.negative(self._along(face, slope, share)))
                for face, slope in zip(faces, slopes, strict=True)
            ]
            found.append(self.negative(self.apply("norm", *beyond)))
        return found

    def _passing(self, face: Pair) -> Number:
        """Segment parameter in [0, 1] at which it crosses a face; arbitrary if it does not."""
        before, after = face
        slope = self.apply("sub", after, before)
        product_ = self.apply("mul", self.negative(before), slope)
        return self._share(self._ratio(product_, self.apply("square", slope)))

    def _along(self, face: Pair, slope: Number, share: Number) -> Number:
        return self.apply("add", face[0], self.apply("mul", slope, share))

    # ------------------------------------------------------------------------ polygons

    def _edges(self, corners: Sequence[VectorValue]) -> list[Pair]:
        """Signed distances of both ends of the segment to every edge, positive on the left."""
        found = []
        for start, stop in _cycle(corners):
            along = minus(stop, start, self.span, self.scope)
            length = norm(along, self.span, self.scope)
            sides = []
            for end in self.ends:
                turn = cross(along, minus(end, start, self.span, self.scope), self.span, self.scope)
                assert isinstance(turn, Number)
                sides.append(self.apply("div", turn, length))
            found.append((sides[0], sides[1]))
        return found

    def _clearances(self, corners: Sequence[VectorValue]) -> list[Number]:
        """Distance of the segment to every edge; negative crossing depth where they cross."""
        past = [self.past(corner) for corner in corners]
        turns = [self._turn(corner) for corner in corners]
        found = []
        for index, ((start, stop), sides) in enumerate(
            zip(_cycle(corners), self._edges(corners), strict=True)
        ):
            after = (index + 1) % len(corners)
            ends = [to_segment(end, start, stop, self.span, self.scope) for end in self.ends]
            gap = self.apply("min", *ends, past[index], past[after])
            between = ir.Predicate(self.apply("mul", *sides).num, -1, strict=True)
            astride = ir.Predicate(self.apply("mul", turns[index], turns[after]).num, -1, strict=True)
            crossing = ir.BoolOp("and", (between, astride))
            found.append(self._choose(crossing, self.negative(gap), gap))
        return found

    def _turn(self, corner: VectorValue) -> Number:
        """Side of the segment on which a corner lies, as the sign of a cross product."""
        now, then = self.ends
        along, ahead = minus(then, now, self.span, self.scope), minus(corner, now, self.span, self.scope)
        turn = cross(along, ahead, self.span, self.scope)
        assert isinstance(turn, Number)
        return turn

    # ---------------------------------------------------------------------- arithmetic

    def at_ends(self, region: Region) -> Pair:
        """Signed distance at both ends."""
        now, then = self.ends
        return (
            signed_distance(now, region, self.span, self.scope),
            signed_distance(then, _region_later(region), self.span, self.scope),
        )

    def past(self, place: VectorValue) -> Number:
        """Least distance of the segment to a point that may move in a straight line."""
        now, then = (
            minus(end, there, self.span, self.scope)
            for end, there in zip(self.ends, (place, _vector_later(place)), strict=True)
        )
        along = minus(then, now, self.span, self.scope)
        back = self.negative(dot(now, along, self.span, self.scope))
        share = self._share(self._ratio(back, dot(along, along, self.span, self.scope)))
        moved = tuple(
            self.apply("add", a, self.apply("mul", share, b))
            for a, b in zip(now.items, along.items, strict=True)
        )
        return norm(VectorValue(moved), self.span, self.scope)

    def _ratio(self, upper: Number, lower: Number) -> Number:
        """Quotient of squares, kept finite for a segment of length 0, where its value does not matter."""
        least = literal(_SHORT * _SHORT, self.span)
        return self.apply("div", upper, self.apply("max", lower, least))

    def _share(self, number: Number) -> Number:
        return self.apply("clip", number, literal(0, self.span), literal(1, self.span))

    def _sum(self, numbers: Sequence[Number]) -> Number:
        total = numbers[0]
        for number in numbers[1:]:
            total = self.apply("add", total, number)
        return total

    def _choose(self, cond: ir.Formula, yes: Number, no: Number) -> Number:
        return Number(ir.Where(cond, yes.num, no.num), no.unit, no.flexible, span=self.span)

    def apply(self, name: str, *args: Number) -> Number:
        """Apply a function of the table."""
        return apply(name, args, self.span, self.scope)

    def negative(self, number: Number) -> Number:
        """Return the negated number."""
        return negated(number, self.span)


def _cycle(corners: Sequence[VectorValue]) -> list[tuple[VectorValue, VectorValue]]:
    return list(zip(corners, (*corners[1:], corners[0]), strict=True))


def _both(number: Number) -> tuple[Number, ...]:
    """Return a number at both ends."""
    return number, _number_later(number)


def _number_later(number: Number) -> Number:
    return replace(number, num=shifted(number.num, 1, clamped=True))


def _vector_later(vector: VectorValue) -> VectorValue:
    return replace(vector, items=tuple(map(_number_later, vector.items)))


def _region_later(region: Region) -> Region:
    """Return the region at the next sample; at the last sample, the region there."""
    match region:
        case NormBall(center, radius):
            return replace(region, center=_vector_later(center), radius=_number_later(radius))
        case Box(lower, upper):
            return replace(region, lower=_vector_later(lower), upper=_vector_later(upper))
        case HalfSpace(normal, offset):
            return replace(region, normal=_vector_later(normal), offset=_number_later(offset))
        case Polygon():
            return region
        case Combined(_, parts):
            return replace(region, parts=tuple(map(_region_later, parts)))
        case Dilated(inside, margin):
            return replace(region, region=_region_later(inside), margin=_number_later(margin))
        case Complement(inside):
            return replace(region, region=_region_later(inside))
