"""Conversion of parsed expressions to the syntax tree: one function per rule of `stl.lark`.

A function takes the converted children of its parse-tree node: nodes of the syntax tree, `TerminalToken`s,
and None for an omitted optional part. Every rule needs a function. Errors that the grammar does not detect,
such as an unknown unit, are collected in `BuildContext.findings`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from types import MappingProxyType
from typing import Any, TypeAlias

from stlc.diagnostics import Diagnostic, Fix
from stlc.grammar import ast
from stlc.grammar.errors.units import unit_advice
from stlc.grammar.words import BUILT_IN, OPERATORS, SPACE
from stlc.source import Source, Span
from stlc.units import Unit

MAX_DIGITS = 400
_UNIT_LENGTH = 60
_LARGEST = Fraction(1.7976931348623157e308)
_MANTISSA = re.compile(r"([^eE]*)(?:[eE]([+-]?\d+))?")
_LETTERS = re.compile(r"[A-Za-z]+")


@dataclass(frozen=True, slots=True)
class TerminalToken:
    """Token of the text: name of its terminal in the grammar (`kind`), its text and its source location."""

    kind: str
    text: str
    span: Span


@dataclass(slots=True)
class BuildContext:
    """State of the conversion of one text to the syntax tree.

    Attributes:
        source: the whole text.
        findings: errors that the grammar does not detect, such as a number too large or an unknown unit.
        documented: offset in the text. The `##` comments before it already belong to a declaration.
    """

    source: Source
    findings: list[Diagnostic] = field(default_factory=list)
    documented: int = 0


def name_of(leaf: TerminalToken) -> str:
    """Return the name that a NAME token denotes, without backticks."""
    return leaf.text[1:-1] if leaf.text.startswith("`") else leaf.text


def own_name(context: BuildContext, leaf: TerminalToken) -> str:
    """Return the name that a declaration introduces, from its NAME token.

    An error (E010) is added to the context for `T`, `end` and `dt`, because these names can be declared only
    in backticks.
    """
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
    """Return the text of the unit in a UNIT or UNIT_BRACKET token; "" for None.

    An error (E101) is added to the context for an unknown unit.
    """
    if leaf is None:
        return ""
    text = re.sub(SPACE, "", leaf.text.strip("[]"))
    if text in ("step", "steps"):
        return "steps"
    try:
        if len(text) > _UNIT_LENGTH:
            raise ValueError("this is too long for a unit")
        Unit.parse(text)
    except ValueError as error:
        context.findings.append(_bad_unit(leaf, text, str(error)))
    return text


def _bad_unit(leaf: TerminalToken, text: str, reason: str) -> Diagnostic:
    if "," in text:
        advice: tuple[str, ...] = (f"a range is written `in {leaf.text}`",)
    else:
        advice = Unit.celsius_advice(text.strip("[] "))
        advice = advice or next(filter(None, map(unit_advice, _LETTERS.findall(text))), ())
    return Diagnostic(
        "E101", reason, leaf.span, help=advice, note=("a unit is a product of powers: [m/s^2], [1/s], [%]",)
    )


def number_of(context: BuildContext, leaf: TerminalToken) -> Fraction:
    """Return the exact value of a NUMBER token.

    For a number that exceeds the range of double precision an error (E005) is added to the context, and 0 is
    returned.
    """
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


BuildRule: TypeAlias = Callable[[BuildContext, Span, Sequence[Any]], Any]


def node(kind: Callable[..., Any]) -> BuildRule:
    """Return a function that converts parse-tree nodes of one rule to syntax-tree nodes of class `kind`.

    The converted children become the fields of the node, in order.
    """
    return lambda _, span, children: kind(span, *children)


def several(_: BuildContext, __: Span, children: Sequence[Any]) -> tuple[Any, ...]:
    """Convert a grammar rule for a list: return the converted children as a tuple."""
    return tuple(children)


def _quantity(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Quantity:
    number, unit = children
    return ast.Quantity(span, number_of(context, number), unit_of(context, unit))


def _name(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Name:
    (leaf,) = children
    return ast.Name(span, name_of(leaf), quoted=leaf.text.startswith("`"))


def _attr(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Attr:
    base, leaf = children
    return ast.Attr(span, base, name_of(leaf))


def _call(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Call:
    func, args = children
    return ast.Call(span, func, args or ())


def _arg(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Arg:
    leaf, value = children
    return ast.Arg(span, None if leaf is None else name_of(leaf), value)


def _binary(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Binary:
    left, op, right = children
    return ast.Binary(span, op.text, left, right)


_LOGIC: Mapping[str, Any] = MappingProxyType(
    {
        **{"&": "and", "&&": "and", "and": "and", "|": "or", "||": "or", "or": "or", "xor": "xor"},
        **{"->": "->", "=>": "->", "implies": "->", "<->": "<->", "<=>": "<->", "iff": "<->"},
    }
)


def _logic(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Logic:
    left, op, right = children
    return ast.Logic(span, _LOGIC[op.text], left, right)


def _operator(token: TerminalToken, written: Sequence[ast.Interval]) -> tuple[str, ast.Interval | None, str]:
    """Return (name, interval or None, alias) of a temporal operator; `token` is its word in the source.

    `written` holds the interval, if there is one. The alias is the spelling in the source, such as `G`. It is
    "" if the source uses the preferred name.
    """
    match = _LETTERS.match(token.text)
    assert match is not None
    op = OPERATORS[match[0]].name
    interval = written[0] if written else None
    if interval is not None and token.kind.endswith("_AT"):
        interval = replace(interval, clock="start")
    return op, interval, "" if op == match[0] else match[0]


def _temporal(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Temporal:
    token, *written, body = children
    op, interval, alias = _operator(token, written)
    return ast.Temporal(span, op, interval, body, alias)


def _until(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Until:
    left, token, *written, right = children
    op, interval, alias = _operator(token, written)
    return ast.Until(span, op, interval, left, right, alias)


def _quantifier(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Quantifier:
    kind, name, domain, body = children
    return ast.Quantifier(span, kind.text, own_name(context, name), domain, body)


def _binding(context: BuildContext, _: Span, children: Sequence[Any]) -> tuple[str, ast.Expr]:
    name, value = children
    return own_name(context, name), value


EXPRESSIONS: Mapping[str, BuildRule] = MappingProxyType(
    {
        "quantity": _quantity,
        "string": lambda _, span, children: ast.String(span, children[0].text[1:-1]),
        "true": node(partial(ast.Bool, value=True)),
        "false": node(partial(ast.Bool, value=False)),
        "inf": node(ast.Inf),
        "name": _name,
        "vector": lambda _, span, children: ast.Vector(span, tuple(filter(None, children))),
        "set_literal": lambda _, span, children: ast.SetLiteral(span, tuple(children)),
        "index": node(ast.Index),
        "attr": _attr,
        "call": _call,
        "args": several,
        "arg": _arg,
        "negative": lambda _, span, children: ast.Neg(span, children[-1]),
        "binary": _binary,
        "compare": lambda _, span, children: ast.Compare(
            span, tuple(children[::2]), tuple(op.text for op in children[1::2])
        ),
        "member_of": node(ast.Member),
        "not_member_of": node(partial(ast.Member, negated=True)),
        "logic": _logic,
        "not_": node(ast.Not),
        "closed_closed": node(ast.Interval),
        "closed_open": node(partial(ast.Interval, hi_open=True)),
        "open_closed": node(partial(ast.Interval, lo_open=True)),
        "open_open": node(partial(ast.Interval, lo_open=True, hi_open=True)),
        **dict.fromkeys(("temporal", "temporal_unbounded"), _temporal),
        **dict.fromkeys(("until", "until_unbounded"), _until),
        "quantifier": _quantifier,
        **dict.fromkeys(("range_domain", "span_domain"), several),
        "freeze": lambda _, span, children: ast.Freeze(span, tuple(children[:-1]), children[-1]),
        "binding": _binding,
        "if_then_else": node(ast.IfThenElse),
        "extreme": lambda _, span, children: ast.Extreme(span, children[0].text, *children[1:]),
    }
)
"""Rule of the grammar -> function that converts its parse-tree nodes."""
