"""Lint rules on the meaning of a specification: names and units are resolved, definitions are expanded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction
from itertools import pairwise
from types import MappingProxyType
from typing import TypeAlias

from stlc.compile.ir import typed
from stlc.compile.ir.warnings import in_range, truth
from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.source import Span

# ------------------------------------------------------------- the first sample only


class Extent(IntEnum):
    """Part of a recording that a formula reads when it is judged at the first sample.

    `FIRST` is that sample, read by predicates and past operators; `START` is also that sample, but asked for
    by a window such as `always[0 s, 0 s]`. `AHEAD` is a bounded window, and `REST` extends to the end.
    """

    NOTHING = 0
    FIRST = 1
    START = 2
    AHEAD = 3
    REST = 4


def extent(formula: typed.Formula) -> Extent:
    """Return the part of a recording that a formula reads when it is judged at the first sample."""
    inner = max(map(extent, formula.operands), default=Extent.NOTHING)
    if isinstance(formula, typed.Predicate):
        return Extent.FIRST
    window = formula.ahead
    if window is None:
        return inner
    if window.hi is None:
        return Extent.REST
    return max(inner, Extent.START if window.is_now else Extent.AHEAD)


def judged_once(spec: typed.Spec) -> Iterator[Diagnostic]:
    """Yield W311 for requirements, and operands of `and` in them, that read predicates at one sample only.

    An implication is reported if its left side is read at the first sample only, and its right side nowhere
    beyond a bounded window. Requirements that mention `T` are judged at every sample.
    """
    for rule in spec.requirements:
        if not rule.formula.mentions_horizon:
            for part in _conjuncts(rule.formula):
                first = _first_only(part)
                if first is not None:
                    name = f"`{rule.name}`" if first is rule.formula else f"a part of `{rule.name}`"
                    yield _once(name, rule.written.span, part, first)


def _conjuncts(formula: typed.Formula) -> Iterator[typed.Formula]:
    items = formula.joined_by("and")
    if items and extent(formula) > Extent.FIRST:
        for item in items:
            yield from _conjuncts(item)
    else:
        yield formula


def _first_only(formula: typed.Formula) -> typed.Formula | None:
    """Return the part of a formula that is read at the first sample only, or None if that is no mistake."""
    parts = list(_outermost(formula))
    extents = {extent(part) for part in parts}
    if Extent.FIRST not in extents or extents & {Extent.START, Extent.REST}:
        return None
    if Extent.AHEAD not in extents:
        return formula
    return next(part for part in parts if extent(part) is Extent.FIRST)


def _outermost(formula: typed.Formula) -> Iterator[typed.Formula]:
    """Yield the operands of the connectives of a formula: predicates and temporal formulas."""
    if formula.pointwise:
        if extent(formula) is Extent.FIRST:
            yield formula
        else:
            for part in formula.operands:
                yield from _outermost(part)
    else:
        yield formula


def _once(what: str, whole: Span, part: typed.Formula, first: typed.Formula) -> Diagnostic:
    place = part.span
    if not _within(place, whole):
        place = whole
    text = " ".join(place.text.split())
    shown = f"({text})" if len(text) <= 40 and "#" not in text and "//" not in text else "(…)"
    source = place.source
    edits = ((source.span(place.start, place.start), "always ("), (source.span(place.end, place.end), ")"))
    return Diagnostic(
        "W311",
        f"{what} is judged at the first sample only",
        first.span if _within(first.span, whole) else place,
        "read at the first sample, and nowhere else",
        fix=Fix(edits, f"write `always {shown}`", same=False),
        help=(f"write `always[0 s, 0 s] {shown}` for a condition on the start",),
    )


# ------------------------------------------------------------- declared ranges


def beyond_ranges(spec: typed.Spec) -> Iterator[Diagnostic]:
    """Yield W313 for predicates that the declared ranges of their signals decide.

    Those that enforced ranges decide are left to W503. Definitions with arguments are left out, since their
    predicates may matter with other arguments.
    """
    general = [item.span for item in spec.source_ast.items if isinstance(item, ast.Def) and item.formals]
    ranges, facts = spec.signature.nominal, spec.signature.enforced
    reported: set[Span] = set()
    for rule in spec.requirements:
        for node in rule.formula.predicates():
            if node.span in reported:
                continue
            if node.span.source is not spec.source_ast.source or any(_within(node.span, d) for d in general):
                continue
            decided = truth(node, ranges)
            if decided is not None and node.num.columns and truth(node, facts) is None:
                reported.add(node.span)
                names = sorted(node.num.columns & ranges.keys())
                known = ", ".join(in_range(name, spec.signature, ranges) for name in names)
                word = "true" if decided else "false"
                yield Diagnostic(
                    "W313",
                    f"this is {word} throughout the declared range: {known}",
                    node.span,
                    f"always {word}",
                    help=("correct the constant, its unit, or the range",),
                )


def _within(span: Span, whole: Span) -> bool:
    return span.source is whole.source and whole.start <= span.start <= span.end <= whole.end


# ------------------------------------------------------------- bare numbers


@dataclass(frozen=True, slots=True)
class _Rival:
    """Unit that is as common as another of its dimension; numbers from `least` on suggest the rival."""

    unit: str
    least: Fraction


_RIVALS: Mapping[str, _Rival] = MappingProxyType(
    {
        "rad": _Rival("deg", Fraction("3.15")),
        "rad/s": _Rival("deg/s", Fraction("6.3")),
        "m/s": _Rival("km/h", Fraction(10)),
    }
)
"""Unit -> the other common unit of its dimension."""


def bare_numbers(spec: typed.Spec) -> Iterator[Diagnostic]:
    """Yield W314 for numbers without a unit beside a unit for which another is common, where they suggest it.

    `angle < 30` is read in radians if `angle` is; it is likely that degrees are meant.
    """
    units = {node.span: node.written for rule in spec.requirements for node in rule.formula.predicates()}
    plain = {item.name: item.value for item in spec.source_ast.constants if not item.unit}
    for compared in _compared(spec.source_ast):
        unit = units.get(compared.span)
        rival = None if unit is None else _RIVALS.get(unit.text)
        if unit is None or rival is None:
            continue
        for number, other in ((compared.left, compared.right), (compared.right, compared.left)):
            value = plain.get(number.name) if isinstance(number, ast.Name) else number
            amount = None if value is None else _bare(value)
            if value is None or amount is None or amount < rival.least:
                continue
            if any(isinstance(node, ast.Quantity) and node.unit for node in other.walk()):
                continue
            text = value.span.text
            yield Diagnostic(
                "W314",
                f"`{number.span.text}` has no unit, and is read as {text} {unit.text}",
                number.span,
                f"{unit.text}, or {rival.unit}?",
                help=(f"write `{text} {unit.text}` or `{text} {rival.unit}`",),
            )


@dataclass(frozen=True, slots=True)
class _Compared:
    """Two sides of a comparison, and the location of its predicate."""

    span: Span
    left: ast.Expr
    right: ast.Expr


def _compared(spec: Spec) -> Iterator[_Compared]:
    for node in spec.walk():
        if isinstance(node, ast.Compare):
            for left, right in pairwise(node.operands):
                yield _Compared(node.span if len(node.ops) == 1 else left.span.to(right.span), left, right)
        elif isinstance(node, ast.Member) and isinstance(node.region, ast.Vector):
            yield from (_Compared(node.span, node.item, end) for end in node.region.items)


def _bare(expr: ast.Expr) -> Fraction | None:
    """Return the magnitude of a number that is written without a unit, such as `-30`; None for others."""
    match expr:
        case ast.Neg(_, inner):
            return _bare(inner)
        case ast.Quantity(_, value, ""):
            return abs(value)
        case _:
            return None


TypedCheck: TypeAlias = Callable[[typed.Spec], Iterator[Diagnostic]]


@dataclass(frozen=True, slots=True)
class TypedRule:
    """A lint rule on the resolved specification, which yields warnings of one code.

    Attributes:
        check: function that returns the findings.
        plans: whether the rule also concerns specifications of plans, which are judged at every instant.
    """

    check: TypedCheck
    plans: bool = True


TYPED_RULES: Mapping[str, TypedRule] = MappingProxyType(
    {
        "W311": TypedRule(judged_once, plans=False),
        "W313": TypedRule(beyond_ranges),
        "W314": TypedRule(bare_numbers),
    }
)
"""Code -> rule."""
