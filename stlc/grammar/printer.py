"""Printer from syntax tree to canonical text with minimal parentheses: `parse(show(a)) == a`.

There is one blank around operators and none inside brackets; aliases (`G`, `&&`, `=>`) become the preferred
spellings. User-defined names get backticks where they would be read as something else.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from enum import IntEnum
from fractions import Fraction
from types import MappingProxyType
from typing import Any

from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.grammar.words import BUILT_IN, RESERVED

_IDENTIFIER = re.compile(r"[^\W\d¹²³⁰⁴-⁹][^\W¹²³⁰⁴-⁹]*")
_PLAIN_DIGITS = 16


class Level(IntEnum):
    """Precedence levels of expressions, from the connective that binds loosest to names and numbers.

    Each operator requires operands of at least a certain level. An operand below that level gets parentheses.
    """

    IFF = 0
    IMPLIES = 1
    OR = 2
    AND = 3
    UNTIL = 4
    PREFIX = 5
    COMPARE = 6
    SUM = 7
    PRODUCT = 8
    SIGN = 9
    POWER = 10
    POSTFIX = 11
    ATOM = 12


_LOGIC = {"<->": Level.IFF, "->": Level.IMPLIES, "or": Level.OR, "xor": Level.OR, "and": Level.AND}
_ARITHMETIC = {
    **{"+": Level.SUM, "-": Level.SUM, "*": Level.PRODUCT, "/": Level.PRODUCT, "%": Level.PRODUCT},
    "^": Level.POWER,
}


def show_at(expr: ast.Expr, least: Level) -> str:
    """Return the text of an expression, in parentheses if it binds more loosely than the level `least`."""
    text = show_expr(expr)
    level = _LEVELS.get(type(expr), Level.ATOM)
    if isinstance(expr, ast.Quantity) and expr.value < 0:
        level = Level.SIGN
    elif isinstance(expr, (ast.Logic, ast.Binary)):
        level = (_LOGIC | _ARITHMETIC)[expr.op]
    return text if level >= least else f"({text})"


def show_expr(expr: ast.Expr) -> str:
    """Return the text of an expression."""
    return _SHOWN[type(expr)](expr)


def _quantity(expr: ast.Quantity) -> str:
    unit = "step" if expr.unit == "steps" and expr.value == 1 else expr.unit
    return _number(expr.value) + (f" {unit}" if unit else "")


def _base(expr: ast.Expr) -> str:
    """Return the text of an expression that is followed by an index, a dot or an argument list.

    A number gets parentheses, and so does an expression that binds more loosely than an index.
    """
    return f"({show_expr(expr)})" if isinstance(expr, ast.Quantity) else show_at(expr, Level.POSTFIX)


def _binary(expr: ast.Binary) -> str:
    if expr.op == "^":
        measured = isinstance(expr.left, ast.Quantity) and bool(expr.left.unit)
        base = f"({show_expr(expr.left)})" if measured else show_at(expr.left, Level.POSTFIX)
        return f"{base}^{show_at(expr.right, Level.SIGN)}"
    level = _ARITHMETIC[expr.op]
    return f"{show_at(expr.left, level)} {expr.op} {show_at(expr.right, Level(level + 1))}"


def _compare(expr: ast.Compare) -> str:
    first, *rest = (show_at(operand, Level.SUM) for operand in expr.operands)
    return first + "".join(f" {op} {operand}" for op, operand in zip(expr.ops, rest, strict=True))


def _member(expr: ast.Member) -> str:
    region = expr.region
    place = show_set(region) if isinstance(region, ast.SetLiteral) else show_at(region, Level.SUM)
    return f"{show_at(expr.item, Level.SUM)} {'not in' if expr.negated else 'in'} {place}"


def _logic(expr: ast.Logic) -> str:
    level = _LOGIC[expr.op]
    left, right = (Level.OR, level) if expr.op == "->" else (level, Level(level + 1))
    return f"{show_at(expr.left, left)} {expr.op} {show_at(expr.right, right)}"


def _temporal(expr: ast.Temporal | ast.Until) -> str:
    """Return the text of a temporal operator with its operands.

    An operand that begins with a vector gets parentheses if it could be read as the interval.
    """
    interval = "" if expr.interval is None else show_interval(expr.interval)
    left = f"{show_at(expr.left, Level.PREFIX)} " if isinstance(expr, ast.Until) else ""
    body = show_at(expr.right if isinstance(expr, ast.Until) else expr.body, Level.PREFIX)
    return f"{left}{expr.op}{interval} {f'({body})' if body.startswith('[') and not interval else body}"


def show_interval(interval: ast.Interval) -> str:
    """Return the text of an interval, with `@` if it counts from the start of the mission."""
    clock = "@" if interval.clock == "start" else ""
    opening, closing = "(" if interval.lo_open else "[", ")" if interval.hi_open else "]"
    return f"{clock}{opening}{show_expr(interval.lo)}, {show_expr(interval.hi)}{closing}"


def _quantifier(expr: ast.Quantifier) -> str:
    if isinstance(expr.domain, ast.SetLiteral):
        domain = show_set(expr.domain)
    else:
        domain = "..".join(show_at(end, Level.SUM) for end in expr.domain)
    return f"{expr.kind} {own_name(expr.var)} in {domain}: {show_at(expr.body, Level.PREFIX)}"


def _freeze(expr: ast.Freeze) -> str:
    bound = ", ".join(f"{own_name(name)} = {show_at(value, Level.SUM)}" for name, value in expr.bindings)
    return f"freeze {bound} in {show_at(expr.body, Level.PREFIX)}"


def _if(expr: ast.IfThenElse) -> str:
    cond, yes = show_expr(expr.cond), show_expr(expr.yes)
    return f"if {cond} then {yes} else {show_at(expr.no, Level.PREFIX)}"


def show_args(args: tuple[ast.Arg, ...]) -> str:
    """Return the text of the arguments of a call, without the parentheses around them."""
    named = (f"{show_name(arg.name)} = " if arg.name is not None else "" for arg in args)
    return ", ".join(prefix + show_expr(arg.value) for prefix, arg in zip(named, args, strict=True))


def show_set(literal: ast.SetLiteral) -> str:
    """Return the text of a set, in braces."""
    return f"{{{show_list(literal.items)}}}"


def show_list(items: tuple[ast.Expr, ...]) -> str:
    """Return the text of expressions, separated by commas."""
    return ", ".join(map(show_expr, items))


_LEVELS: Mapping[type, Level] = MappingProxyType(
    {
        ast.Until: Level.UNTIL,
        **dict.fromkeys((ast.Not, ast.Temporal, ast.Quantifier, ast.Freeze, ast.IfThenElse), Level.PREFIX),
        **dict.fromkeys((ast.Compare, ast.Member), Level.COMPARE),
        ast.Neg: Level.SIGN,
        **dict.fromkeys((ast.Index, ast.Attr, ast.Call), Level.POSTFIX),
    }
)
"""Class of expressions -> precedence, if all of the class have the same; other classes are atoms."""

_SHOWN: Mapping[type, Callable[[Any], str]] = MappingProxyType(
    {
        ast.Quantity: _quantity,
        ast.String: lambda expr: f'"{expr.value}"',
        ast.Bool: lambda expr: "true" if expr.value else "false",
        ast.Inf: lambda _: "inf",
        ast.Name: lambda expr: own_name(expr.name) if expr.quoted else show_name(expr.name),
        ast.Vector: lambda expr: f"[{show_list(expr.items)}]",
        ast.Index: lambda expr: f"{_base(expr.base)}[{show_expr(expr.index)}]",
        ast.Attr: lambda expr: f"{_base(expr.base)}.{show_name(expr.name)}",
        ast.Call: lambda expr: f"{_base(expr.func)}({show_args(expr.args)})",
        ast.Neg: lambda expr: f"-{show_at(expr.operand, Level.SIGN)}",
        ast.Binary: _binary,
        ast.Compare: _compare,
        ast.Member: _member,
        ast.Not: lambda expr: f"not {show_at(expr.operand, Level.PREFIX)}",
        ast.Logic: _logic,
        **dict.fromkeys((ast.Temporal, ast.Until), _temporal),
        ast.Quantifier: _quantifier,
        ast.Freeze: _freeze,
        ast.IfThenElse: _if,
        ast.Extreme: lambda expr: f"{expr.op}{show_interval(expr.interval)}({show_expr(expr.body)})",
    }
)
"""Class of expressions -> function that returns the text of one."""


# ------------------------------------------------------------------ names, numbers


def show_name(name: str) -> str:
    """Return the text of a name in an expression: in backticks if it is reserved or not an identifier.

    `T`, `end` and `dt` get no backticks, because in an expression they are the built-in names.
    """
    return f"`{name}`" if name in RESERVED or not _IDENTIFIER.fullmatch(name) else name


def own_name(name: str) -> str:
    """Return the text of a name in its declaration, in backticks if needed.

    The names `T`, `end` and `dt` need backticks there. Without backticks, they are built-in names.
    """
    return f"`{name}`" if name in BUILT_IN else show_name(name)


def _number(value: Fraction) -> str:
    """Return the shortest decimal of a number, or `(numerator / denominator)` if there is no finite one."""
    twos, fives, rest = 0, 0, value.denominator
    while rest % 2 == 0:
        twos, rest = twos + 1, rest // 2
    while rest % 5 == 0:
        fives, rest = fives + 1, rest // 5
    if rest != 1:
        return f"({value.numerator} / {value.denominator})"
    places = max(twos, fives)
    digits = str(abs(value.numerator) * 10**places // value.denominator)
    sign = "-" if value < 0 else ""
    if places > _PLAIN_DIGITS:
        return f"{sign}{digits}e-{places}"
    if places:
        padded = digits.rjust(places + 1, "0")
        return f"{sign}{padded[:-places]}.{padded[-places:]}"
    short = digits.rstrip("0")
    zeros = len(digits) - len(short)
    return sign + (f"{short}e{zeros}" if len(digits) > _PLAIN_DIGITS and zeros > 2 else digits)


def show(node: ast.Node) -> str:
    """Return the text of a node: an expression, a declaration or a whole specification."""
    if isinstance(node, ast.Declaration):
        return _declaration(node)
    return (_PARTS.get(type(node)) or show_expr)(node)  # type: ignore[arg-type]


# ------------------------------------------------------------------- declarations


def _declaration(item: ast.Declaration) -> str:
    doc = "".join(f"## {line}".rstrip() + "\n" for line in item.doc.split("\n")) if item.doc else ""
    tags = "".join(f"{show(tag)}\n" for tag in item.tags)
    if type(item) not in _DECLARED:
        raise TypeError(f"{type(item).__name__} is no declaration of the language")
    return f"{doc}{tags}{_DECLARED[type(item)](item)}"


def _enum(item: ast.Enum) -> str:
    listed = ", ".join(f"{own_name(name)} = {value}" for name, value in item.members)
    return f"enum {own_name(item.name)} {{ {listed} }}"


def _def(item: ast.Def) -> str:
    arguments = f"({', '.join(map(show, item.formals))})" if item.formals else ""
    sort = "" if item.type is None else f": {_type(item.type)}"
    return f"def {own_name(item.name)}{arguments}{sort} = {show_expr(item.value)}"


def _typed(item: ast.Signal | ast.Const | ast.Param) -> str:
    """Return the text of the name, type and unit of a declaration."""
    sort = "" if item.type is None else f" : {_type(item.type)}"
    return f"{own_name(item.name)}{sort}" + (f" [{item.unit}]" if item.unit else "")


def _signal(item: ast.Signal) -> str:
    head = f"{item.role} signal" if item.role else "signal"
    limits = "" if item.domain is None else f" in {_domain(item.domain)}"
    source = "" if item.column is None else f' from "{item.column}"'
    return f"{head} {_typed(item)}{limits}{source}"


def _param(item: ast.Param) -> str:
    if isinstance(item.domain, tuple | ast.SetLiteral):
        return f"param {_typed(item)} in {_domain(item.domain)}"
    return f"param {_typed(item)} ~ {show_at(item.domain, Level.POSTFIX)}"


def _extern(item: ast.Extern) -> str:
    unit = f" [{item.unit}]" if item.unit else ""
    formals = ", ".join(map(show, item.formals))
    return f"extern fn {own_name(item.name)}({formals}) -> {_type(item.type)}{unit}"


def _type(written: ast.TypeRef) -> str:
    return show_name(written.name) + ("" if written.size is None else f"[{written.size}]")


def _domain(domain: tuple[ast.Expr, ast.Expr] | ast.SetLiteral) -> str:
    return show_set(domain) if isinstance(domain, ast.SetLiteral) else f"[{show_list(domain)}]"


def _import_line(item: ast.Import) -> str:
    target = f'"{item.target}"' if item.is_file else show_name(item.target)
    return f"import {target}" + (f" as {own_name(item.alias)}" if item.alias else "")


def _spec(spec: Spec) -> str:
    pragmas = [
        *([f"spec {show_name(spec.name)}"] if spec.name else []),
        *([f'system "{spec.system}"'] if spec.system is not None else []),
        *([f"time {spec.time_unit}"] if spec.time_unit else []),
        *map(_import_line, spec.imports),
    ]
    text = "\n".join(pragmas) + "\n" if pragmas else ""
    for before, item in zip((None, *spec.items), spec.items, strict=False):
        alike = type(before) is type(item) and not (item.doc or item.tags)
        text += "" if alike or not text else "\n"
        text += f"{_declaration(item)}\n"
    return text


def _tag(tag: ast.Tag) -> str:
    return f"@{show_name(tag.name)}" + (f"({show_args(tag.args)})" if tag.args else "")


def _formal(formal: ast.Formal) -> str:
    return own_name(formal.name) + ("" if formal.type is None else f": {_type(formal.type)}")


_DECLARED: Mapping[type, Callable[[Any], str]] = MappingProxyType(
    {
        ast.Signal: _signal,
        ast.Const: lambda item: f"const {_typed(item)} = {show_expr(item.value)}",
        ast.Param: _param,
        ast.Extern: _extern,
        ast.Enum: _enum,
        ast.Region: lambda item: f"region {own_name(item.name)} = {show_expr(item.value)}",
        ast.Def: _def,
        ast.Require: lambda item: f"require {own_name(item.name)}: {show_expr(item.formula)}",
        ast.Assume: lambda item: f"assume {own_name(item.name)}: {show_expr(item.formula)}",
    }
)
"""Class of declarations -> function that returns the text of one, without tags and comment."""

_PARTS: Mapping[type, Callable[[Any], str]] = MappingProxyType(
    {
        Spec: _spec,
        ast.Import: _import_line,
        ast.Tag: _tag,
        ast.TypeRef: _type,
        ast.Formal: _formal,
        ast.Arg: lambda arg: show_args((arg,)),
        ast.Interval: show_interval,
        ast.SetLiteral: show_set,
    }
)
"""Class of other nodes -> function that returns the text of one."""
