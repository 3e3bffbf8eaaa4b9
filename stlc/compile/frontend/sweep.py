"""`sweep(p)`: signed distances of the straight segment from a point to its position at the next sample.

`sweep(p) in R` is the least signed distance along the segment to the region R; `sweep(p) not in R` is the
least signed distance to its complement. Both are exact for balls, boxes, half-spaces and convex polygons. For
other polygons, the sign is exact, and so is a value that is positive or 0.

For an intersection of regions with exact distances, `in` is exact and `not in` is a lower bound. For a union
of such regions, `not in` is exact and `in` is a lower bound.

A region that moves is assumed to move in a straight line too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import combinations, product
from typing import Literal, TypeVar

from stlc.compile.frontend.arithmetic import apply, dot, gap, minus, negated, norm, total
from stlc.compile.frontend.regions import (
    check_dimension,
    composed,
    convex,
    edges,
    side,
    signed_distance,
    to_segment,
)
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.values import (
    REGION_TYPES,
    BoxRegion,
    Combined,
    Complement,
    Dilated,
    NormBall,
    Number,
    Polygon,
    Region,
    VectorValue,
    literal,
    shifted,
)
from stlc.compile.ir import nodes as ir
from stlc.source import Span

_SHORT = 1e-9
"""Length in SI units below which a segment counts as a point."""
_AHEAD = 1e-6
"""Distance into a piece, as a share of the segment, at which its active faces are determined."""

Pair = tuple[Number, Number]
"""Values of a number at both ends of the segment; it is linear in between."""
T = TypeVar("T")


def swept_distance(point: VectorValue, region: Region, span: Span, scope: Scope) -> Number:
    """Return the least signed distance to `region` along the path of `point` to the next sample.

    The path is the straight segment between the positions of the point at the two samples.

    Raises:
        Failed: the point has another number of components (E205) or another unit (E203) than the region.
    """
    check_dimension(point, region, span, scope)
    return _Sweep(point, span, scope).extreme(region, "min")


class _Sweep:
    """Calculator of signed distances between a segment and regions.

    The segment is the straight line from a point to the position of the point at the next sample.
    """

    def __init__(self, point: VectorValue, span: Span, scope: Scope) -> None:
        self.ends = (point, _later(point))
        self.span, self.scope = span, scope

    def extreme(self, region: Region, which: Literal["min", "max"]) -> Number:
        """Return the least or greatest (`which`) signed distance to a region along the segment.

        The distance is positive inside the region. The signed distance to a convex region is concave along
        the segment, so its least value is at one of the two ends.
        """
        match region:
            case Combined() | Dilated() | Complement():
                same = partial(self.extreme, which=which)
                opposite = partial(self.extreme, which="max" if which == "min" else "min")
                return composed(
                    region,
                    same,
                    opposite,
                    lambda margin: self.apply(which, margin, _later(margin)),
                    self.span,
                    self.scope,
                )
            case Polygon(corners) if not convex(corners):
                clearances = self._clearances(corners)
                if which == "max":
                    clearances = list(map(self.negative, clearances))
                return self.apply(which, *self.at_ends(region), *clearances)
            case NormBall(center, radius) if which == "max":
                return self.apply("sub", self.apply("max", radius, _later(radius)), self.past(center))
            case BoxRegion() if which == "max":
                return self._over_box(region)
            case Polygon(corners) if which == "max":
                outside = [self.negative(self.past(corner)) for corner in corners]
                return self._over(self._edges(corners), (*self.at_ends(region), *outside))
            case _:
                return self.apply(which, *self.at_ends(region))

    # ------------------------------------------------------------------ convex regions

    def _over_box(self, box: BoxRegion) -> Number:
        faces = []
        for axis, sides in enumerate(zip(box.lower.items, box.upper.items, strict=True)):
            for face, sign in zip(sides, (1, -1), strict=True):
                room = [
                    gap(*(pair if sign > 0 else pair[::-1]), self.span, self.scope)
                    for pair in zip((end.items[axis] for end in self.ends), (face, _later(face)), strict=True)
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
        """Return the greatest signed distance of the segment to a convex region, positive inside.

        If the segment enters the region, the result is the greatest depth of the segment in the region
        (`_depth`). Otherwise, the result is the greatest number in `outside`.

        Args:
            faces: for each face of the region, the signed distances of both ends of the segment to the face,
                positive inside.
            outside: lower bounds on the result for a segment that stays outside the region, such as the
                signed distances of its two ends. The greatest of these bounds must be exact.
        """
        depth = self._depth(faces)
        close = self.apply("max", *outside)
        return self._choose(ir.Predicate(depth.num), depth, close)

    def _depth(self, faces: Sequence[Pair]) -> Number:
        """Return the greatest depth of the segment in a convex region, negative if the segment stays outside.

        `faces` are the signed distances of the start and the end of the segment to each face, positive
        inside. The depth of a point is its least distance to a face. By duality of linear programs, the
        greatest depth is the least of the following values:

        - for each face, the greater of its signed distances to the two ends of the segment;
        - for each pair of faces whose distances change in opposite directions along the segment, the
          distance at the point that is equally far from both faces.
        """
        best = [self.apply("max", *face) for face in faces]
        slopes = [self.apply("sub", after, before) for before, after in faces]
        sizes = [self.apply("abs", slope) for slope in slopes]
        meetings = []
        for i, j in combinations(range(len(faces)), 2):
            steep = self.apply("max", self.apply("add", sizes[i], sizes[j]), literal(_SHORT, self.span))
            weighed = (
                self.apply("mul", faces[i][0], sizes[j]),
                self.apply("mul", faces[j][0], sizes[i]),
            )
            there = self.apply("div", self.apply("add", *weighed), steep)
            opposed = ir.Predicate(self.apply("mul", slopes[i], slopes[j]).num, -1, strict=True)
            long = ir.Predicate(self.apply("sub", steep, literal(_SHORT, self.span)).num, strict=True)
            meetings.append(self._choose(opposed & long, there, best[i]))
        return self.apply("min", *best, *meetings)

    def _approaches(self, faces: Sequence[Pair]) -> list[Number]:
        """Return the negated distance to a box at each point of the segment that may be closest to the box.

        `faces` are the signed distances of the start and the end of the segment to each face, positive
        inside. The squared distance is convex and piecewise quadratic along the segment, and its minimum is
        the minimum of one of the pieces. A piece begins at the start of the segment or where the segment
        crosses a face.
        """
        slopes = [self.apply("sub", after, before) for before, after in faces]
        starts = [literal(0, self.span), *(self._passing(face) for face in faces)]
        found = []
        for start in starts:
            there = [self._along(face, slope, start) for face, slope in zip(faces, slopes, strict=True)]
            pull, stiffness = [], []
            for room, slope in zip(there, slopes, strict=True):
                ahead = self.apply("add", room, self.apply("mul", slope, literal(_AHEAD, self.span)))
                active = Number(ir.Predicate(ahead.num, -1, strict=True).indicator())
                pull.append(self.apply("mul", active, self.apply("mul", room, slope)))
                stiffness.append(self.apply("mul", active, self.apply("square", slope)))
            step = self._ratio(*(total(items, self.span, self.scope) for items in (pull, stiffness)))
            share = self._share(self.apply("sub", start, step))
            beyond = [
                self.apply("relu", self.negative(self._along(face, slope, share)))
                for face, slope in zip(faces, slopes, strict=True)
            ]
            found.append(self.negative(self.apply("norm", *beyond)))
        return found

    def _passing(self, face: Pair) -> Number:
        """Return the position in [0, 1] at which the segment crosses a face; arbitrary if it does not.

        `face`: signed distances of the start and the end of the segment to the face.
        """
        before, after = face
        slope = self.apply("sub", after, before)
        product_ = self.apply("mul", self.negative(before), slope)
        return self._share(self._ratio(product_, self.apply("square", slope)))

    def _along(self, face: Pair, slope: Number, share: Number) -> Number:
        return self.apply("add", face[0], self.apply("mul", slope, share))

    # ------------------------------------------------------------------------ polygons

    def _edges(self, corners: Sequence[VectorValue]) -> list[Pair]:
        """Return, for each edge of a polygon, the signed distances of the segment's two ends to the edge.

        A pair contains the distance of the start of the segment, then that of its end. An edge runs from one
        of the `corners` to the next; distances are positive to the left of the edge.
        """
        found = []
        for start, stop in edges(corners):
            length = norm(minus(stop, start, self.span, self.scope), self.span, self.scope)
            before, after = (
                self.apply("div", side(end, start, stop, self.span, self.scope), length) for end in self.ends
            )
            found.append((before, after))
        return found

    def _clearances(self, corners: Sequence[VectorValue]) -> list[Number]:
        """Return the distance of the segment to each edge of a polygon, negative if the two cross.

        The magnitude is the least of the distances from the ends of the segment to the edge and from the ends
        of the edge to the segment.
        """
        now, then = self.ends
        past = edges([self.past(corner) for corner in corners])
        turns = edges([side(corner, now, then, self.span, self.scope) for corner in corners])
        found = []
        for (start, stop), sides, near, around in zip(
            edges(corners), self._edges(corners), past, turns, strict=True
        ):
            ends = [to_segment(end, start, stop, self.span, self.scope) for end in self.ends]
            gap = self.apply("min", *ends, *near)
            between, astride = (
                ir.Predicate(self.apply("mul", *signs).num, -1, strict=True) for signs in (sides, around)
            )
            crossing = between & astride
            found.append(self._choose(crossing, self.negative(gap), gap))
        return found

    # ---------------------------------------------------------------------- arithmetic

    def at_ends(self, region: Region) -> Pair:
        """Return the signed distances of the start and the end of the segment to a region."""
        now, then = self.ends
        return (
            signed_distance(now, region, self.span, self.scope),
            signed_distance(then, _later(region), self.span, self.scope),
        )

    def past(self, place: VectorValue) -> Number:
        """Return the least distance of the segment to the point `place`.

        The point itself may move in a straight line from its present position to that at the next sample.
        """
        now, then = (
            minus(end, there, self.span, self.scope)
            for end, there in zip(self.ends, (place, _later(place)), strict=True)
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
        """Return `upper / lower`, with the denominator kept away from 0 for a segment of length 0.

        For such a segment the result does not matter.
        """
        least = literal(_SHORT * _SHORT, self.span)
        return self.apply("div", upper, self.apply("max", lower, least))

    def _share(self, number: Number) -> Number:
        return self.apply("clip", number, literal(0, self.span), literal(1, self.span))

    def _choose(self, cond: ir.Formula, yes: Number, no: Number) -> Number:
        return Number(cond.select(yes.num, no.num), no.unit, no.flexible, span=self.span)

    def apply(self, name: str, *args: Number) -> Number:
        """Return the function `name` applied to `args`; see `stlc.compile.ir.functions.FUNCTIONS`."""
        return apply(name, args, self.span, self.scope)

    def negative(self, number: Number) -> Number:
        """Return the negated number."""
        return negated(number, self.span)


def _later(value: T) -> T:
    """Return `value`, a number, vector or region, at the next sample.

    At the last sample of a trace, which has no next sample, the value is that of the last sample.
    """
    match value:
        case Number():
            return replace(value, num=shifted(value.num, 1, clamped=True))
        case tuple():
            return type(value)(map(_later, value))
        case _ if isinstance(value, (VectorValue, *REGION_TYPES)):
            return replace(value, **{each.name: _later(getattr(value, each.name)) for each in fields(value)})
        case _:
            return value
