"""Tags of requirements: `@safety`, `@weight(2)`, `@id("R1")`, and the divisor of `@scale(auto)`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from stlc.compile.frontend.arithmetic import refuse_point
from stlc.compile.frontend.coerce import Expectation, as_number
from stlc.compile.frontend.evaluate import evaluate
from stlc.compile.frontend.scope import Failed, Scope
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.functions import Bounds
from stlc.compile.ir.ranges import bounds
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.similar import closest
from stlc.source import Span
from stlc.units import Unit


def reach_of_formula(
    formula: typed.Formula, ranges: Mapping[str, Bounds], place: Span, scope: Scope
) -> float:
    """Return the greatest magnitude that the margin of any predicate in a formula can have.

    The margins are computed over the ranges of the signals by interval arithmetic. `place` is the source
    location for the error.

    Raises:
        Failed: the range of a signal is unknown, or no predicate varies (E205).
    """
    known, found = dict(ranges), []
    for node in formula.walk():
        if isinstance(node, typed.Predicate):
            found.append(reach_of_number(node.num, known, place, scope))
        elif isinstance(node, typed.Freeze):
            bound = {name: bounds(num, known) for name, num in node.bindings}
            known.update({name: ends for name, ends in bound.items() if ends is not None})
    if not found:
        scope.fail(Diagnostic("E205", "this has no predicate that varies", place))
    return max(found)


def reach_of_number(num: ir.Num, ranges: Mapping[str, Bounds], place: Span, scope: Scope) -> float:
    """Return the greatest magnitude that a number can have within the ranges of its signals.

    `place` is the source location for the error.

    Raises:
        Failed: the range of a signal is unknown (E205).
    """
    ends = bounds(num, ranges)
    if ends is not None and all(map(math.isfinite, ends)) and ends != (0.0, 0.0):
        return max(map(abs, ends))
    missing = sorted(num.columns - ranges.keys())
    help_: tuple[str, ...] = ("say it: `@scale(10)`",)
    message = "how far this reaches is not known"
    if missing:
        listed = ", ".join(f"`{name}`" for name in missing)
        message += f": {listed} declares no range"
        help_ = (f"signal {missing[0]} in [low, high]", *help_)
    return scope.fail(Diagnostic("E205", message, place, help=help_))


MARKS = ("safety", "liveness")
_SHOWN = '@safety @liveness @weight(x) @id("…") @group(name) @scale(x) @scale(auto) @product'
_KNOWN = (*MARKS, "weight", "id", "group", "scale", "product")


@dataclass(frozen=True, slots=True)
class Tags:
    """Evaluated tags of one requirement; see `typed.Requirement`.

    Attributes:
        marks: names of tags without arguments (`safety`, `liveness`).
        weight: factor of the robustness.
        scale: argument of `@scale`, by which the robustness is divided. If the argument depends on signals,
            the divisor is the greatest magnitude that the argument can have. None stands for `@scale(auto)`:
            the divisor is the greatest magnitude of the predicates' margins.
        scale_span: source location of `@scale`.
        product: whether `x in [lo, hi]` has the robustness `(x - lo) (hi - x)`.
        id: text of `@id("…")`; "" without this tag.
        group: name in `@group(name)`; "" without this tag.
    """

    marks: frozenset[str] = frozenset()
    weight: float = 1.0
    scale: ir.Num | None = ir.Const(1.0)  # noqa: RUF009 - frozen
    scale_span: Span | None = None
    product: bool = False
    id: str = ""
    group: str = ""


def read_tags(tags: Sequence[ast.Tag], scope: Scope) -> Tags:
    """Return the evaluated tags of a requirement.

    Findings (E501, E205) go to `scope`; an invalid tag is left out.
    """
    found = Tags()
    seen: set[str] = set()
    for tag in tags:
        try:
            if tag.name in seen:
                scope.fail(Diagnostic("E501", f"`@{tag.name}` is given twice", tag.span))
            seen.add(tag.name)
            found = _with(found, tag, scope)
        except Failed:
            continue
    return found


BETWEEN = ("hold", "linear", "angle")
"""Tags of signals: their values between recorded samples."""


def age_of(tag: ast.Tag) -> float | None:
    """Return the age in seconds after which a held value is unknown, as in `@hold(0.5 s)`; None: never.

    Raises:
        ValueError: the argument is no time above 0, or the tag takes none.
    """
    if not tag.args:
        return None
    age = tag.args[0].value
    if tag.name == "hold" and len(tag.args) == 1 and isinstance(age, ast.Quantity) and age.unit:
        unit = Unit.written(age.unit)
        if unit.same_dims(Unit.SYMBOLS["s"]) and age.value > 0:
            return float(age.value) * unit.scale
    raise ValueError(f"`@{tag.name}` does not take this argument")


def require_between(tags: Sequence[ast.Tag], scope: Scope) -> None:
    """Report the error E501 for tags of a signal other than `BETWEEN`, and for wrong arguments of these."""
    refuse_tags([tag for tag in tags if tag.name not in BETWEEN], "a `signal`", scope)
    found = [tag for tag in tags if tag.name in BETWEEN]
    for tag in found[1:]:
        scope.report(Diagnostic("E501", "a signal has one value between its samples", tag.span))
    for tag in found:
        try:
            age_of(tag)
        except ValueError as error:
            help_ = ("@hold(0.5 s)  says after which time a value is unknown",)
            scope.report(Diagnostic("E501", str(error), tag.span, help=help_))


def refuse_tags(tags: Sequence[ast.Tag], what: str, scope: Scope) -> None:
    """Report the error E501 for tags on a declaration that takes none; `what` describes the declaration."""
    for tag in tags:
        message = f"`@{tag.name}` says nothing about {what}"
        scope.report(Diagnostic("E501", message, tag.span, help=("tags stand before `require`",)))


def _with(found: Tags, tag: ast.Tag, scope: Scope) -> Tags:
    match tag.name:
        case "safety" | "liveness":
            if tag.args:
                scope.fail(Diagnostic("E501", f"`@{tag.name}` takes no argument", tag.span))
            return replace(found, marks=found.marks | {tag.name})
        case "weight":
            weight = _number(tag, scope)
            if not isinstance(weight, ir.Const):
                scope.fail(Diagnostic("E205", f"`@{tag.name}` takes a positive constant", tag.args[0].span))
            return replace(found, weight=weight.value)
        case "scale":
            scale = None if _word(tag) == "auto" else _number(tag, scope)
            return replace(found, scale=scale, scale_span=tag.span)
        case "id":
            return replace(found, id=_text(tag, scope))
        case "group":
            return replace(found, group=_word(tag) or _text(tag, scope))
        case "product":
            if tag.args:
                scope.fail(Diagnostic("E501", "`@product` takes no argument", tag.span))
            return replace(found, product=True)
        case _:
            near = closest(tag.name, _KNOWN)
            hint = f"did you mean `@{near}`?  " if near is not None else ""
            help_ = (f"{hint}tags: {_SHOWN}",)
            return scope.fail(Diagnostic("E501", f"unknown tag `@{tag.name}`", tag.span, help=help_))


def _only(tag: ast.Tag) -> ast.Expr | None:
    """Return the argument of a tag that has exactly one, unnamed argument; else None."""
    return tag.args[0].value if len(tag.args) == 1 and tag.args[0].name is None else None


def _word(tag: ast.Tag) -> str:
    value = _only(tag)
    return value.name if isinstance(value, ast.Name) else ""


def _text(tag: ast.Tag, scope: Scope) -> str:
    value = _only(tag)
    if isinstance(value, ast.String):
        return value.value
    return scope.fail(Diagnostic("E501", f'`@{tag.name}` takes one text: `@{tag.name}("…")`', tag.span))


def _number(tag: ast.Tag, scope: Scope) -> ir.Num:
    """Return the number that is the argument of a tag.

    Raises:
        Failed: the tag has another argument (E501), or the number is constant and not positive (E205).
    """
    expr = _only(tag)
    if expr is None:
        scope.fail(Diagnostic("E501", f"`@{tag.name}` takes one number: `@{tag.name}(2)`", tag.span))
    number = as_number(evaluate(expr, scope), expr, Expectation(f"`@{tag.name}` takes a number"), scope)
    refuse_point(f"`@{tag.name}`", number, expr.span, scope)
    if number.constant is not None and number.constant <= 0:
        scope.fail(Diagnostic("E205", f"`@{tag.name}` takes a positive constant", expr.span))
    return number.num
