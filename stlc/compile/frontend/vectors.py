"""Arithmetic on numbers and vectors alike: signs, broadcasting, products and norms."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

from stlc.compile.frontend.algebra import apply, gap, negated
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.values import Number, Vector
from stlc.diagnostics import Diagnostic
from stlc.source import Span


def broadcast(name: str, args: Sequence[Number | Vector], span: Span, scope: Scope) -> Number | Vector:
    """`name` applied component by component; numbers stand for vectors of themselves."""
    lengths = {len(arg.items) for arg in args if isinstance(arg, Vector)}
    if not lengths:
        return apply(name, [arg for arg in args if isinstance(arg, Number)], span, scope)
    check_lengths(lengths, span, scope)
    size = lengths.pop()
    rows = [arg.items if isinstance(arg, Vector) else (arg,) * size for arg in args]
    return Vector(tuple(apply(name, row, span, scope) for row in zip(*rows, strict=True)), span)


def check_lengths(lengths: set[int], span: Span, scope: Scope) -> None:
    """Refuse vectors of different lengths (E205)."""
    if len(lengths) > 1:
        long, short = sorted(lengths, reverse=True)[:2]
        scope.fail(Diagnostic("E205", f"vectors of {short} and {long} components do not go together", span))


def negate(value: Number | Vector, span: Span) -> Number | Vector:
    """`-value`."""
    if isinstance(value, Number):
        return negated(value, span)
    return Vector(tuple(negated(item, span) for item in value.items), span)


def minus(left: Vector, right: Vector, span: Span, scope: Scope) -> Vector:
    """From one point to another, both of so many components. Raises Failed (E203, E205)."""
    check_lengths({len(left.items), len(right.items)}, span, scope)
    pairs = zip(left.items, right.items, strict=True)
    return Vector(tuple(gap(a, b, span, scope) for a, b in pairs), span)


def norm(vector: Vector, span: Span, scope: Scope) -> Number:
    """The Euclidean length."""
    return apply("norm", vector.items, span, scope)


def total(items: Sequence[Number], span: Span, scope: Scope) -> Number:
    """The sum of at least one number."""
    return reduce(lambda a, b: apply("add", (a, b), span, scope), items)


def dot(left: Vector, right: Vector, span: Span, scope: Scope) -> Number:
    """The inner product."""
    products = broadcast("mul", (left, right), span, scope)
    assert isinstance(products, Vector)
    return total(products.items, span, scope)


def cross(left: Vector, right: Vector, span: Span, scope: Scope) -> Number | Vector:
    """The cross product: a number in the plane, a vector in space."""

    def minor(i: int, j: int) -> Number:
        ahead = apply("mul", (left.items[i], right.items[j]), span, scope)
        back = apply("mul", (left.items[j], right.items[i]), span, scope)
        return apply("sub", (ahead, back), span, scope)

    match len(left.items), len(right.items):
        case 2, 2:
            return minor(0, 1)
        case 3, 3:
            return Vector((minor(1, 2), minor(2, 0), minor(0, 1)), span)
        case m, n:
            message = f"`cross` takes two vectors of 2 or of 3 components, these have {m} and {n}"
            return scope.fail(Diagnostic("E205", message, span))
