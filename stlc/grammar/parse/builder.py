"""Parse tree to AST, expressions: one function per rule of `stl.lark`.

A function takes the built children of its node: AST nodes, `TerminalToken`s, None for an omitted optional
part. A rule without a function is an error. Tokens become names, units and numbers; errors in well-formed
text are reported.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from types import MappingProxyType
from typing import Any, TypeAlias

from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar import ast
from stlc.grammar.words import BINARY_TEMPORAL, BUILT_IN, UNARY_TEMPORAL, UNIT_NAMES
from stlc.registry import closest
from stlc.source import Source, Span
from stlc.units import CELSIUS, SYMBOLS, means_celsius, parse_unit

MAX_DIGITS = 400
_UNIT_LENGTH = 60
_LARGEST = Fraction(1.7976931348623157e308)
_MANTISSA = re.compile(r"([^eE]*)(?:[eE]([+-]?\d+))?")
_LETTERS = re.compile(r"[A-Za-z]+")


@dataclass(frozen=True, slots=True)
class TerminalToken:
    """Token with its terminal, text and span."""

    kind: str
    text: str
    span: Span


@dataclass(slots=True)
class BuildContext:
    """Context of a rule besides its children.

    Attributes:
        source: the whole text.
        findings: errors in well-formed text (a number too large, an unknown unit).
        documented: offset up to which `##` comments are already assigned.
    """

    source: Source
    findings: list[Diagnostic] = field(default_factory=list)
    documented: int = 0


def name_of(leaf: TerminalToken) -> str:
    """Return the name in a NAME token, without backticks."""
    return leaf.text[1:-1] if leaf.text.startswith("`") else leaf.text


def own_name(context: BuildContext, leaf: TerminalToken) -> str:
    """Return the declared name; `T`, `end` and `dt` need backticks."""
    if leaf.text in BUILT_IN:
        context.findings.append(
            Diagnostic(
                "E010",
                f"`{leaf.text}` is {BUILT_IN[leaf.text]}, not a name of your own",
                leaf.span,
                help=(f"choose another name, or write it in backticks: `` `{leaf.text}` ``",),
                fix=Fix(((leaf.span, f"`{leaf.text}`"),)),
            )
        )
    return name_of(leaf)


def unit_of(context: BuildContext, leaf: TerminalToken | None) -> str:
    """Return the unit in a UNIT or UNIT_BRACKET token; "" without one."""
    if leaf is None:
        return ""
    text = re.sub(r"\s+", "", leaf.text.strip("[]"))
    if text in ("step", "steps"):
        return "steps"
    try:
        if len(text) > _UNIT_LENGTH:
            raise ValueError("this is too long for a unit")
        parse_unit(text)
    except ValueError as error:
        context.findings.append(_bad_unit(leaf, text, str(error)))
    return text


def _bad_unit(leaf: TerminalToken, text: str, reason: str) -> Diagnostic:
    if "," in text:
        advice: tuple[str, ...] = (f"a range is written `in {leaf.text}`",)
    elif means_celsius(text.strip("[] ")):
        advice = (CELSIUS,)
    else:
        near = next((found for word in _LETTERS.findall(text) if (found := near_unit(word))), None)
        advice = (f"did you mean `{near}`?",) if near else ()
    return Diagnostic(
        "E101", reason, leaf.span, help=advice, note=("a unit is a product of powers: [m/s^2], [1/s], [%]",)
    )


def near_unit(word: str) -> str | None:
    """Return the unit closest to an unknown unit `word`."""
    return (
        None
        if word in SYMBOLS or means_celsius(word)
        else UNIT_NAMES.get(word.lower()) or closest(word, SYMBOLS)
    )


def number_of(context: BuildContext, leaf: TerminalToken) -> Fraction:
    """Return the exact value of a NUMBER token; 0 and E005 beyond double precision."""
    match = _MANTISSA.fullmatch(leaf.text)
    assert match is not None
    digits, exponent = match[1].replace("_", ""), match[2] or "0"
    if len(digits) <= MAX_DIGITS and len(exponent) <= 4 and abs(int(exponent)) <= MAX_DIGITS:
        value = Fraction(digits.rstrip(".") or "0") * Fraction(10) ** int(exponent)
        if value <= _LARGEST:
            return value
    context.findings.append(
        Diagnostic(
            "E005",
            "this number is beyond double precision",
            leaf.span,
            note=("the largest is about 1.8e308",),
        )
    )
    return Fraction(0)


_WORD = re.compile(r"[A-Za-z]+")

BuildRule: TypeAlias = Callable[[BuildContext, Span, Sequence[Any]], Any]


# -------------------------------------------------------------------------- atoms


def _quantity(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Quantity:
    number, unit = children
    return ast.Quantity(span, number_of(context, number), unit_of(context, unit))


def _string(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.String:
    return ast.String(span, children[0].text[1:-1])


def _true(_: BuildContext, span: Span, __: Sequence[Any]) -> ast.Bool:
    return ast.Bool(span, True)


def _false(_: BuildContext, span: Span, __: Sequence[Any]) -> ast.Bool:
    return ast.Bool(span, False)


def _inf(_: BuildContext, span: Span, __: Sequence[Any]) -> ast.Inf:
    return ast.Inf(span)


def _name(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Name:
    (leaf,) = children
    return ast.Name(span, name_of(leaf), quoted=leaf.text.startswith("`"))


def _vector(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Vector:
    return ast.Vector(span, tuple(item for item in children if item is not None))


def _set_literal(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.SetLiteral:
    return ast.SetLiteral(span, tuple(children))


# ------------------------------------------------------------ postfix, arithmetic


def _index(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Index:
    base, index = children
    return ast.Index(span, base, index)


def _attr(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Attr:
    base, leaf = children
    return ast.Attr(span, base, name_of(leaf))


def _call(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Call:
    func, args = children
    return ast.Call(span, func, args or ())


def _args(_: BuildContext, __: Span, children: Sequence[Any]) -> tuple[ast.Arg, ...]:
    return tuple(children)


def _arg(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Arg:
    leaf, value = children
    return ast.Arg(span, None if leaf is None else name_of(leaf), value)


def _negative(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Neg:
    return ast.Neg(span, children[-1])


def _binary(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Binary:
    left, op, right = children
    return ast.Binary(span, op.text, left, right)


def _compare(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Compare:
    return ast.Compare(span, tuple(children[::2]), tuple(op.text for op in children[1::2]))


def _member_of(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Member:
    item, region = children
    return ast.Member(span, item, region)


def _not_member_of(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Member:
    item, region = children
    return ast.Member(span, item, region, negated=True)


# ----------------------------------------------------------------- logic and time

_LOGIC: Mapping[str, Any] = MappingProxyType(
    {
        **{"&": "and", "&&": "and", "and": "and", "|": "or", "||": "or", "or": "or", "xor": "xor"},
        **{"->": "->", "=>": "->", "implies": "->", "<->": "<->", "<=>": "<->", "iff": "<->"},
    }
)


def _logic(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Logic:
    left, op, right = children
    return ast.Logic(span, _LOGIC[op.text], left, right)


def _not(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Not:
    return ast.Not(span, children[0])


def _interval(*, lo_open: bool, hi_open: bool) -> BuildRule:
    def build(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Interval:
        lo, hi = children
        return ast.Interval(span, lo, hi, lo_open, hi_open)

    return build


def _clocked(operator: TerminalToken, interval: ast.Interval) -> ast.Interval:
    if not operator.kind.endswith("_AT"):
        return interval
    return ast.Interval(interval.span, interval.lo, interval.hi, interval.lo_open, interval.hi_open, "start")


def _spelled(operator: TerminalToken, table: Mapping[str, str]) -> tuple[Any, str]:
    """Return the operator's name, and the alias by which it is written, if any."""
    match = _WORD.match(operator.text)
    assert match is not None
    word = match[0]
    return table[word], "" if table[word] == word else word


def _temporal(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Temporal:
    operator, interval, body = children
    op, alias = _spelled(operator, UNARY_TEMPORAL)
    return ast.Temporal(span, op, _clocked(operator, interval), body, alias)


def _temporal_unbounded(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Temporal:
    operator, body = children
    op, alias = _spelled(operator, UNARY_TEMPORAL)
    return ast.Temporal(span, op, None, body, alias)


def _until(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Until:
    left, operator, interval, right = children
    op, alias = _spelled(operator, BINARY_TEMPORAL)
    return ast.Until(span, op, _clocked(operator, interval), left, right, alias)


def _until_unbounded(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Until:
    left, operator, right = children
    op, alias = _spelled(operator, BINARY_TEMPORAL)
    return ast.Until(span, op, None, left, right, alias)


# ------------------------------------------------------------------------ binders


def _quantifier(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Quantifier:
    kind, name, domain, body = children
    return ast.Quantifier(span, kind.text, own_name(context, name), domain, body)


def _pair(_: BuildContext, __: Span, children: Sequence[Any]) -> tuple[ast.Expr, ast.Expr]:
    low, high = children
    return low, high


def _freeze(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Freeze:
    *bindings, body = children
    return ast.Freeze(span, tuple(bindings), body)


def _binding(context: BuildContext, _: Span, children: Sequence[Any]) -> tuple[str, ast.Expr]:
    name, value = children
    return own_name(context, name), value


def _if_then_else(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.IfThenElse:
    cond, yes, no = children
    return ast.IfThenElse(span, cond, yes, no)


EXPRESSIONS: Mapping[str, BuildRule] = MappingProxyType(
    {
        "quantity": _quantity,
        "string": _string,
        "true": _true,
        "false": _false,
        "inf": _inf,
        "name": _name,
        "vector": _vector,
        "set_literal": _set_literal,
        "index": _index,
        "attr": _attr,
        "call": _call,
        "args": _args,
        "arg": _arg,
        "negative": _negative,
        "binary": _binary,
        "compare": _compare,
        "member_of": _member_of,
        "not_member_of": _not_member_of,
        "logic": _logic,
        "not_": _not,
        "closed_closed": _interval(lo_open=False, hi_open=False),
        "closed_open": _interval(lo_open=False, hi_open=True),
        "open_closed": _interval(lo_open=True, hi_open=False),
        "open_open": _interval(lo_open=True, hi_open=True),
        "temporal": _temporal,
        "temporal_unbounded": _temporal_unbounded,
        "until": _until,
        "until_unbounded": _until_unbounded,
        "quantifier": _quantifier,
        "range_domain": _pair,
        "span_domain": _pair,
        "freeze": _freeze,
        "binding": _binding,
        "if_then_else": _if_then_else,
    }
)
