"""Comparisons and membership: from numbers to predicates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from stlc.compile.frontend.arithmetic import agree, apply, gap, half, in_unit
from stlc.compile.frontend.coerce import Expectation, as_formula, as_number, loose_number
from stlc.compile.frontend.regions import signed_distance
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.sweep import swept_distance
from stlc.compile.frontend.values import (
    REGION_TYPES,
    BoxRegion,
    Complement,
    Number,
    Operand,
    Region,
    Swept,
    Value,
    VectorValue,
    is_formula,
    noun,
)
from stlc.compile.frontend.values import EnumMember as Member
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.source import Span
from stlc.units import Unit


def comparison(expr: ast.Compare, values: Sequence[Value], scope: Scope) -> typed.Formula:
    """Return the formula of a comparison; a chain such as `a <= b < c` is a conjunction."""
    pairs = []
    for index, op in enumerate(expr.ops):
        left, right = expr.operands[index], expr.operands[index + 1]
        whole = expr.span if len(expr.ops) == 1 else left.span.to(right.span)
        place = sign_span(op, left.span, right.span)
        pairs.append(
            _pair(op, Operand(left, values[index]), Operand(right, values[index + 1]), whole, place, scope)
        )
    return pairs[0] if len(pairs) == 1 else typed.Logic(expr.span, "and", tuple(pairs))


def sign_span(sign: str, left: Span, right: Span) -> Span:
    """Return the source location of the operator `sign` between its operands."""
    gap = left.source.text[left.end : right.start]
    at = gap.find(sign)
    if at < 0:
        return left.to(right)
    return left.source.span(left.end + at, left.end + at + len(sign))


def _pair(
    op: str,
    left: Operand,
    right: Operand,
    whole: Span,
    place: Span,
    scope: Scope,
) -> typed.Formula:
    if op in ("==", "!="):
        equal = _equality(left, right, whole, place, scope)
        return equal if op == "==" else typed.Not(whole, equal)
    _refuse_vectors(left, right, op, scope)
    need = f"`{op}` compares numbers"
    a = as_number(left.value, left.expr, Expectation(need, "the left side"), scope)
    b = as_number(right.value, right.expr, Expectation(need, "the right side"), scope)
    if "enum" in (a.kind, b.kind):
        help_ = ("use `==`, `!=` or `in {…}`",)
        scope.fail(
            Diagnostic(
                "E205",
                f"the members of an enum have no order, so `{op}` cannot compare them",
                place,
                help=help_,
            )
        )
    (a, b), _ = agree((a, b), "compare", place, scope)
    big, small = (a, b) if op in (">", ">=") else (b, a)
    return _above(big, small, op in ("<", ">"), whole, scope)


def _above(big: Number, small: Number, strict: bool, span: Span, scope: Scope) -> typed.Predicate:
    """Return the predicate `big > small` (`strict`) or `big >= small`.

    Between integers, `a > b` becomes `a - 1/2 >= b`, and `a >= b` becomes `a + 1/2 >= b`. The threshold is
    then halfway between two whole numbers. So rounding errors do not matter, and the margin agrees with that
    of `==`. Robustness is reported in the unit of the first side that has one and varies, or else of the
    first that has one.
    """
    measured = [side for side in (big, small) if side.unit.text] or [big, small]
    written = next((side.unit for side in measured if side.constant is None), measured[0].unit)
    if (big.kind, small.kind) == ("int", "int"):
        step = half(span)
        step = in_unit(step, big.unit.interval, scope) if big.unit.offset else step
        big = apply("sub" if strict else "add", (big, step), span, scope)
    return _pred(span, gap(big, small, span, scope), strict=strict, written=written)


def _pred(
    span: Span, margin: Number, *, strict: bool = False, written: Unit | None = None
) -> typed.Predicate:
    unit = (margin.unit if written is None else written).interval
    return typed.Predicate(span, margin.num, strict, unit=unit.si, written=unit)


def _refuse_vectors(left: Operand, right: Operand, op: str, scope: Scope) -> None:
    for expr, value in (left, right):
        if isinstance(value, VectorValue):
            help_ = (f"`norm({expr.span.text})`, one component, or `in` with a region",)
            scope.fail(
                Diagnostic("E205", f"`{op}` does not compare vectors", expr.span, noun(value)[2:], help=help_)
            )


def _equality(left: Operand, right: Operand, whole: Span, place: Span, scope: Scope) -> typed.Formula:
    """Return `left == right` for integers, bools or enums, with margin 1/2 - |left - right|.

    Between formulas, `==` means `<->`, and has the margin of `<->`.

    Raises:
        Failed: a side is real (E204) or has another type (E205).
    """
    _refuse_vectors(left, right, "==", scope)
    if any(is_formula(value) for _, value in (left, right)):
        need = Expectation("`==` between truth values", "the other side")
        sides = [as_formula(value, expr, need, scope) for expr, value in (left, right)]
        return typed.Logic(whole, "<->", (sides[0], sides[1]))
    a, b = _meet(left, right, scope), _meet(right, left, scope)
    if a.kind == "real" or b.kind == "real":
        scope.fail(_real_equality(a, b, left.expr, right.expr, place))
    _check_labels(a, b, place, scope)
    plain = [replace(side, kind="real", labels=()) for side in (a, b)]
    apart = apply("abs", (gap(plain[0], plain[1], whole, scope),), whole, scope)
    return typed.Predicate(whole, apply("sub", (half(whole), apart), whole, scope).num, strict=False)


def _meet(side: Operand, other: Operand, scope: Scope) -> Number:
    """Return `side`, one side of `==`, as a number.

    If `side` is a member of an enum, it becomes the number of this member in the enum of `other`, the other
    side.
    """
    expr, value = side
    labels = other.value.labels if isinstance(other.value, Number) else ()
    if isinstance(value, Member) and labels:
        if value.name not in dict(labels):
            names = ", ".join(f"`{name}`" for name, _ in labels)
            message = f"`{value.name}` is not a member of the enum of `{other.expr.span.text}`"
            scope.fail(Diagnostic("E205", message, expr.span, help=(f"its members are {names}",)))
        return Number(ir.Const(dict(labels)[value.name]), kind="enum", labels=labels, span=expr.span)
    return loose_number(value, expr, Expectation("`==` compares numbers", "one side"), scope)


def _real_equality(a: Number, b: Number, left: ast.Expr, right: ast.Expr, place: Span) -> Diagnostic:
    first, second = left.span.text, right.span.text
    unit = next((n.unit for n in (a, b) if not n.unit.dimensionless), None)
    if unit is not None and unit.offset:
        first, second = (f"{n} {unit}" if m.bare else n for n, m in ((first, a), (second, b)))
    apart = f"{first} - {second}"
    away = first if b.constant == 0 and (unit is None or not unit.offset) else apart
    tolerance = "0.05" if unit is None else f"0.05 {unit.interval}"
    label = f"its robustness is -|{apart}|: at best 0, so it can never hold with a margin"
    return Diagnostic(
        "E204",
        "`==` between reals is never robustly true",
        place,
        label,
        help=(f"abs({away}) <= {tolerance}",),
        note=("`==` is exact and allowed on whole numbers, truth values and enums",),
    )


def _check_labels(a: Number, b: Number, place: Span, scope: Scope) -> None:
    """Check that `a` and `b` can be compared if one or both of them have an enum type.

    If both have an enum type, it must be the same enum. If only one has, the other must be a constant that
    stands for a member of the enum.

    Raises:
        Failed: the enums differ, or no member has this number (E205).
    """
    if a.labels and b.labels:
        if a.labels != b.labels:
            scope.fail(Diagnostic("E205", "these are members of different enums", place))
        return
    for side, other in ((a, b), (b, a)):
        if not side.labels or other.constant in [value for _, value in side.labels]:
            continue
        names = ", ".join(f"`{name}` ({value:g})" for name, value in side.labels)
        help_ = (f"its members are {names}",)
        scope.fail(
            Diagnostic(
                "E205", "an enum is compared with something that is none of its members", place, help=help_
            )
        )


def in_set(item: Operand, members: Sequence[Operand], span: Span, scope: Scope) -> typed.Formula:
    """Return the formula `item in {m, n}`, which means `item == m or item == n`."""
    equals = tuple(_equality(item, member, span, span, scope) for member in members)
    return equals[0] if len(equals) == 1 else typed.Logic(span, "or", equals)


def in_range(item: Operand, ends: Sequence[Operand], span: Span, scope: Scope) -> typed.Formula:
    """Return `x in [lo, hi]`: `lo <= x and x <= hi` or, under `@product`, `(x - lo) (hi - x) >= 0`."""
    need = "`in [lo, hi]` compares numbers"
    x = as_number(item.value, item.expr, Expectation(need, "the left side"), scope)
    low, high = (as_number(value, expr, Expectation(need, "a bound"), scope) for expr, value in ends)
    (x, low, high), _ = agree((x, low, high), "compare", span, scope)
    if low.constant is not None and high.constant is not None and low.constant > high.constant:
        scope.fail(
            Diagnostic(
                "E205",
                "this range is empty: its lower end is above its upper end",
                ends[0].expr.span.to(ends[1].expr.span),
            )
        )
    if scope.product and x.kind != "int":
        sides = gap(x, low, span, scope), gap(high, x, span, scope)
        return _pred(span, apply("mul", sides, span, scope))
    above = _above(x, low, False, span, scope)
    below = _above(high, x, False, span, scope)
    return typed.Logic(span, "and", (above, below))


def sweeps(expr: ast.Member, segment: Swept, region: Sequence[Operand], scope: Scope) -> typed.Formula:
    """Return `sweep(p) in R`: the whole segment from p to its next sample is in the region.

    `sweep(p) not in R` requires that no point of the segment is in the region; this is stronger than the
    negation of `sweep(p) in R`.
    """
    if isinstance(expr.region, ast.SetLiteral):
        help_ = ("write a range `[lo, hi]`, or a region like `circle(center, radius)`",)
        scope.fail(
            Diagnostic("E205", "a segment lies in a region, not in a set", expr.region.span, help=help_)
        )
    if len(region) == 2:
        ends = [
            as_number(value, end, Expectation("`in [lo, hi]` compares numbers", "a bound"), scope)
            for end, value in region
        ]
        place: Region = BoxRegion(VectorValue((ends[0],)), VectorValue((ends[1],)), span=expr.region.span)
    elif isinstance(region[0].value, REGION_TYPES):
        place = region[0].value
    else:
        message = f"`in` needs a region, this is {noun(region[0].value)}"
        scope.fail(Diagnostic("E205", message, region[0].expr.span))
    place = Complement(place) if expr.negated else place
    return _pred(expr.span, swept_distance(segment.point, place, expr.span, scope))


def in_region(item: Operand, region: Operand, span: Span, scope: Scope) -> typed.Formula:
    """Return `p in R`: the signed distance of the point to the region, positive inside, is >= 0."""
    (point_expr, point), (region_expr, place) = item, region
    if not isinstance(place, REGION_TYPES):
        help_ = ("write a range `[lo, hi]`, a set `{a, b}`, or a region like `circle(center, radius)`",)
        scope.fail(
            Diagnostic("E205", f"`in` needs a region, this is {noun(place)}", region_expr.span, help=help_)
        )
    if not isinstance(point, VectorValue):
        message = f"`in` asks where a point is, this is {noun(point)}"
        scope.fail(
            Diagnostic("E205", message, point_expr.span, help=("write the point as a vector: `[x, y]`",))
        )
    return _pred(span, signed_distance(point, place, span, scope))
