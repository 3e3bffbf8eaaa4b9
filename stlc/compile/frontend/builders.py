"""Calls that make regions: `circle(center, radius)`, `box(lower, upper)`, `union(…)` and their like."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from stlc.compile.frontend.algebra import absolute
from stlc.compile.frontend.polygons import area, points, simple
from stlc.compile.frontend.regions import dimension
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.sorts import Need, as_number, as_vector
from stlc.compile.frontend.values import (
    REGION_TYPES,
    Ball,
    Box,
    Combined,
    Complement,
    Dilated,
    HalfSpace,
    Polygon,
    Region,
    Value,
    noun,
)
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast

FORMALS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "circle": ("center", "radius"),
        "ball": ("center", "radius"),
        "box": ("lower", "upper"),
        "halfspace": ("normal", "offset"),
        "complement": ("region",),
        "dilate": ("region", "margin"),
    }
)
"""Names of the arguments; `polygon`, `union` and `intersect` take any number of them without names."""


def region(name: str, call: ast.Call, values: Sequence[Value], scope: Scope) -> Region:
    """The region that a call makes. Raises Failed (E105 arguments, E205 sorts)."""
    if name not in FORMALS:
        for arg in call.args:
            if arg.name is not None:
                scope.fail(Diagnostic("E105", f"`{name}` has no argument called `{arg.name}`", arg.span))
        pairs = [(arg.value, value) for arg, value in zip(call.args, values, strict=True)]
        return _polygon(call, pairs, scope) if name == "polygon" else _combined(name, call, pairs, scope)
    given = _bound(name, call, values, scope)
    match name:
        case "circle" | "ball":
            return _ball(name, call, given, scope)
        case "box":
            return _box(call, given, scope)
        case "halfspace":
            normal = as_vector(
                given[0][1], given[0][0], Need("the normal of a half-space is a vector"), scope
            )
            offset = as_number(
                given[1][1], given[1][0], Need("the offset of a half-space is a number"), scope
            )
            return HalfSpace(normal, offset, call.span)
        case "complement":
            return Complement(_region(name, *given[0], scope), call.span)
        case _:
            margin = as_number(given[1][1], given[1][0], Need("`dilate` grows by a length"), scope)
            return Dilated(_region(name, *given[0], scope), margin, call.span)


def _bound(
    name: str, call: ast.Call, values: Sequence[Value], scope: Scope
) -> tuple[tuple[ast.Expr, Value], ...]:
    """Arguments in the order of the formals, whether they were named or not."""
    formals = FORMALS[name]
    found: dict[str, tuple[ast.Expr, Value]] = {}
    shape = f"{name}({', '.join(formals)})"
    for index, (arg, value) in enumerate(zip(call.args, values, strict=True)):
        formal = arg.name if arg.name is not None else (formals[index] if index < len(formals) else "")
        if formal not in formals or formal in found:
            scope.fail(Diagnostic("E105", f"`{name}` does not take this argument", arg.span, help=(shape,)))
        found[formal] = (arg.value, value)
    missing = [formal for formal in formals if formal not in found]
    if missing:
        scope.fail(Diagnostic("E105", f"`{name}` needs `{missing[0]}`", call.span, help=(shape,)))
    return tuple(found[formal] for formal in formals)


def _region(name: str, expr: ast.Expr, value: Value, scope: Scope) -> Region:
    if isinstance(value, REGION_TYPES):
        return value
    return scope.fail(Diagnostic("E205", f"`{name}` takes regions, this is {noun(value)}", expr.span))


def _ball(name: str, call: ast.Call, given: Sequence[tuple[ast.Expr, Value]], scope: Scope) -> Ball:
    center = as_vector(given[0][1], given[0][0], Need(f"the center of a {name} is a vector"), scope)
    radius = as_number(given[1][1], given[1][0], Need(f"the radius of a {name} is a number"), scope)
    if name == "circle" and len(center.items) != 2:
        message = f"a circle lies in the plane, this center has {len(center.items)} components"
        scope.fail(
            Diagnostic("E205", message, given[0][0].span, help=("`ball` takes any number of components",))
        )
    if radius.constant is not None and radius.constant < 0:
        scope.fail(Diagnostic("E205", "a radius is not negative", given[1][0].span))
    return Ball(center, radius, call.span)


def _box(call: ast.Call, given: Sequence[tuple[ast.Expr, Value]], scope: Scope) -> Box:
    lower, upper = (
        as_vector(value, expr, Need("a corner of a box is a vector"), scope) for expr, value in given
    )
    if len(lower.items) != len(upper.items):
        message = f"corners of {len(lower.items)} and {len(upper.items)} components do not span a box"
        scope.fail(Diagnostic("E205", message, call.span))
    for low, high in zip(lower.items, upper.items, strict=True):
        if low.bare is not high.bare:
            continue  # the point that is asked for says the unit of the bare one
        if not low.bare:
            low, high = absolute(low), absolute(high)
        if low.constant is not None and high.constant is not None and low.constant > high.constant:
            scope.fail(
                Diagnostic("E205", "this box is empty: a lower bound is above the upper one", call.span)
            )
    return Box(lower, upper, call.span)


def _polygon(call: ast.Call, pairs: Sequence[tuple[ast.Expr, Value]], scope: Scope) -> Polygon:
    need = Need("a corner of a polygon is a vector")
    corners = tuple(as_vector(value, expr, need, scope) for expr, value in pairs)
    known = points(corners)
    if len(corners) < 3:
        scope.fail(Diagnostic("E105", "a polygon has at least 3 corners", call.span))
    if known is None:
        message = "the corners of a polygon are constant points of the plane"
        scope.fail(
            Diagnostic("E205", message, call.span, help=("a moving obstacle can be a `circle` or a `box`",))
        )
    if not simple(known) or area(known) == 0:
        scope.fail(Diagnostic("E205", "this polygon has no inside, or crosses itself", call.span))
    return Polygon(corners if area(known) > 0 else corners[::-1], call.span)


def _combined(name: str, call: ast.Call, pairs: Sequence[tuple[ast.Expr, Value]], scope: Scope) -> Combined:
    if not pairs:
        scope.fail(Diagnostic("E105", f"`{name}` needs at least one region", call.span))
    parts = tuple(_region(name, expr, value, scope) for expr, value in pairs)
    sizes = {size for part in parts if (size := dimension(part)) is not None}
    if len(sizes) > 1:
        message = f"regions of {' and '.join(map(str, sorted(sizes)))} dimensions do not go together"
        scope.fail(Diagnostic("E205", message, call.span))
    return Combined("union" if name == "union" else "intersect", parts, call.span)
