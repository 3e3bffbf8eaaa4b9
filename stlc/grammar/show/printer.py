"""Printer from AST to canonical text with minimal parentheses. Invariant: `parse(show(a)) == a`.

One blank around operators, none inside brackets; aliases (`G`, `&&`, `=>`) become the preferred spellings.
User-defined names get backticks where they would be read as something else.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from enum import IntEnum
from fractions import Fraction
from types import MappingProxyType
from typing import Any, assert_never

from stlc.grammar import ast
from stlc.grammar.words import BUILT_IN, RESERVED

_IDENTIFIER = re.compile(r"[^\W\d¹²³⁰⁴-⁹][^\W¹²³⁰⁴-⁹]*")
_PLAIN_DIGITS = 16


class Level(IntEnum):
    """Precedence levels, loosest first; an operand needs at least the level of its place."""

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


def _level(expr: ast.Expr) -> Level:
    if isinstance(expr, ast.Quantity) and expr.value < 0:
        return Level.SIGN
    if isinstance(expr, (ast.Logic, ast.Binary)):
        return (_LOGIC | _ARITHMETIC)[expr.op]
    return _LEVELS.get(type(expr), Level.ATOM)


def show_at(expr: ast.Expr, least: Level) -> str:
    """Return the expression, in parentheses if its precedence is below `least`."""
    text = show_expr(expr)
    return text if _level(expr) >= least else f"({text})"


def show_expr(expr: ast.Expr) -> str:
    """Return the text of an expression."""
    return _SHOWN[type(expr)](expr)


def _atom(expr: ast.Quantity | ast.String | ast.Bool | ast.Inf | ast.Name) -> str:
    match expr:
        case ast.Quantity(value=value, unit=unit):
            written = "step" if unit == "steps" and value == 1 else unit
            return _number(value) + (f" {written}" if written else "")
        case ast.String(value=text):
            return f'"{text}"'
        case ast.Bool(value=truth):
            return "true" if truth else "false"
        case ast.Inf():
            return "inf"
        case ast.Name(name=name, quoted=quoted):
            return f"`{name}`" if quoted and name in BUILT_IN else show_name(name)
        case _:
            assert_never(expr)


def _postfix(expr: ast.Index | ast.Attr | ast.Call) -> str:
    match expr:
        case ast.Index(base=base, index=index):
            return f"{_base(base)}[{show_expr(index)}]"
        case ast.Attr(base=base, name=name):
            return f"{_base(base)}.{show_name(name)}"
        case ast.Call(func=func, args=args):
            return f"{_base(func)}({show_args(args)})"
        case _:
            assert_never(expr)


def _base(expr: ast.Expr) -> str:
    """Return the operand before an index, a dot or an argument list; a number needs parentheses."""
    return f"({show_expr(expr)})" if isinstance(expr, ast.Quantity) else show_at(expr, Level.POSTFIX)


def _has_unit(expr: ast.Expr) -> bool:
    return isinstance(expr, ast.Quantity) and bool(expr.unit)


def _arithmetic(expr: ast.Neg | ast.Binary | ast.Compare | ast.Member) -> str:
    match expr:
        case ast.Neg(operand=operand):
            return f"-{show_at(operand, Level.SIGN)}"
        case ast.Binary(op="^", left=left, right=right):
            base = f"({show_expr(left)})" if _has_unit(left) else show_at(left, Level.POSTFIX)
            return f"{base}^{show_at(right, Level.SIGN)}"
        case ast.Binary(op=op, left=left, right=right):
            level = _ARITHMETIC[op]
            return f"{show_at(left, level)} {op} {show_at(right, Level(level + 1))}"
        case ast.Compare(operands=operands, ops=ops):
            first, *rest = (show_at(operand, Level.SUM) for operand in operands)
            return first + "".join(f" {op} {operand}" for op, operand in zip(ops, rest, strict=True))
        case ast.Member(item=item, region=region, negated=negated):
            place = show_set(region) if isinstance(region, ast.SetLiteral) else show_at(region, Level.SUM)
            return f"{show_at(item, Level.SUM)} {'not in' if negated else 'in'} {place}"
        case _:
            assert_never(expr)


def _logic(expr: ast.Not | ast.Logic) -> str:
    match expr:
        case ast.Not(operand=operand):
            return f"not {show_at(operand, Level.PREFIX)}"
        case ast.Logic(op="->", left=left, right=right):
            return f"{show_at(left, Level.OR)} -> {show_at(right, Level.IMPLIES)}"
        case ast.Logic(op=op, left=left, right=right):
            level = _LOGIC[op]
            return f"{show_at(left, level)} {op} {show_at(right, Level(level + 1))}"
        case _:
            assert_never(expr)


def _temporal(expr: ast.Temporal | ast.Until) -> str:
    interval = "" if expr.interval is None else show_interval(expr.interval)
    match expr:
        case ast.Temporal(op=op, body=body):
            return f"{op}{interval} {_body(body, interval)}"
        case ast.Until(op=op, left=left, right=right):
            return f"{show_at(left, Level.PREFIX)} {op}{interval} {_body(right, interval)}"
        case _:
            assert_never(expr)


def _body(expr: ast.Expr, interval: str) -> str:
    """Return the operand of a temporal operator; a vector gets parentheses: `[a, b]` is an interval."""
    text = show_at(expr, Level.PREFIX)
    return f"({text})" if text.startswith("[") and not interval else text


def show_interval(interval: ast.Interval) -> str:
    """Return the text of an interval, with its `@`."""
    clock = "@" if interval.clock == "start" else ""
    opening, closing = "(" if interval.lo_open else "[", ")" if interval.hi_open else "]"
    return f"{clock}{opening}{show_expr(interval.lo)}, {show_expr(interval.hi)}{closing}"


def _binder(expr: ast.Quantifier | ast.Freeze | ast.IfThenElse) -> str:
    match expr:
        case ast.Quantifier(kind=kind, var=var, domain=domain, body=body):
            return f"{kind} {own_name(var)} in {_span(domain)}: {show_at(body, Level.PREFIX)}"
        case ast.Freeze(bindings=bindings, body=body):
            bound = ", ".join(f"{own_name(name)} = {show_at(value, Level.SUM)}" for name, value in bindings)
            return f"freeze {bound} in {show_at(body, Level.PREFIX)}"
        case ast.IfThenElse(cond=cond, yes=yes, no=no):
            return f"if {show_expr(cond)} then {show_expr(yes)} else {show_at(no, Level.PREFIX)}"
        case _:
            assert_never(expr)


def _span(domain: tuple[ast.Expr, ast.Expr] | ast.SetLiteral) -> str:
    if isinstance(domain, ast.SetLiteral):
        return show_set(domain)
    low, high = domain
    return f"{show_at(low, Level.SUM)}..{show_at(high, Level.SUM)}"


def show_args(args: tuple[ast.Arg, ...]) -> str:
    """Arguments, without the parentheses around them."""
    named = (f"{show_name(arg.name)} = " if arg.name is not None else "" for arg in args)
    return ", ".join(prefix + show_expr(arg.value) for prefix, arg in zip(named, args, strict=True))


def show_set(literal: ast.SetLiteral) -> str:
    """A set in braces."""
    return f"{{{show_list(literal.items)}}}"


def show_list(items: tuple[ast.Expr, ...]) -> str:
    """Expressions with commas between them."""
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
"""Expression class -> precedence, where it is constant; other classes are atoms."""

_SHOWN: Mapping[type, Callable[[Any], str]] = MappingProxyType(
    {
        **dict.fromkeys((ast.Quantity, ast.String, ast.Bool, ast.Inf, ast.Name), _atom),
        ast.Vector: lambda expr: f"[{show_list(expr.items)}]",
        **dict.fromkeys((ast.Index, ast.Attr, ast.Call), _postfix),
        **dict.fromkeys((ast.Neg, ast.Binary, ast.Compare, ast.Member), _arithmetic),
        **dict.fromkeys((ast.Not, ast.Logic), _logic),
        **dict.fromkeys((ast.Temporal, ast.Until), _temporal),
        **dict.fromkeys((ast.Quantifier, ast.Freeze, ast.IfThenElse), _binder),
    }
)
"""Class of expressions -> its text."""


# ------------------------------------------------------------------ names, numbers


def show_name(name: str) -> str:
    """Return a name in an expression, where bare `T`, `end` and `dt` are built in."""
    return f"`{name}`" if name in RESERVED or not _IDENTIFIER.fullmatch(name) else name


def own_name(name: str) -> str:
    """Return a name as its declaration writes it, quoted if it has to be."""
    return f"`{name}`" if name in BUILT_IN else show_name(name)


def _number(value: Fraction) -> str:
    """Return the shortest decimal; a fraction without one is a quotient in parentheses."""
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
    if places:
        return sign + _decimal(digits, places)
    short = digits.rstrip("0")
    zeros = len(digits) - len(short)
    return sign + (f"{short}e{zeros}" if len(digits) > _PLAIN_DIGITS and zeros > 2 else digits)


def _decimal(digits: str, places: int) -> str:
    if places > _PLAIN_DIGITS:
        return f"{digits}e-{places}"
    padded = digits.rjust(places + 1, "0")
    return f"{padded[:-places]}.{padded[-places:]}"


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


def _typed(item: ast.Signal | ast.Const | ast.Param | ast.Extern) -> str:
    name, unit = own_name(item.name), f" [{item.unit}]" if item.unit else ""
    sort = "" if item.type is None else f" : {_type(item.type)}"
    match item:
        case ast.Signal(role=role, domain=domain, column=column):
            head = f"{role} signal" if role else "signal"
            limits = "" if domain is None else f" in {_domain(domain)}"
            source = "" if column is None else f' from "{column}"'
            return f"{head} {name}{sort}{unit}{limits}{source}"
        case ast.Const(value=value):
            return f"const {name}{sort}{unit} = {show_expr(value)}"
        case ast.Param(domain=domain):
            drawn = isinstance(domain, tuple | ast.SetLiteral)
            limits = f"in {_domain(domain)}" if drawn else f"~ {show_at(domain, Level.POSTFIX)}"  # type: ignore[arg-type]
            return f"param {name}{sort}{unit} {limits}"
        case ast.Extern(formals=formals, type=written):
            return f"extern fn {name}({', '.join(map(show, formals))}) -> {_type(written)}{unit}"
        case _:
            assert_never(item)


def _type(written: ast.TypeRef) -> str:
    return show_name(written.name) + ("" if written.size is None else f"[{written.size}]")


def _domain(domain: tuple[ast.Expr, ast.Expr] | ast.SetLiteral) -> str:
    return show_set(domain) if isinstance(domain, ast.SetLiteral) else f"[{show_list(domain)}]"


def _import_line(item: ast.Import) -> str:
    target = f'"{item.target}"' if item.is_file else show_name(item.target)
    return f"import {target}" + (f" as {own_name(item.alias)}" if item.alias else "")


def _spec(spec: ast.Spec) -> str:
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
        **dict.fromkeys((ast.Signal, ast.Const, ast.Param, ast.Extern), _typed),
        ast.Enum: _enum,
        ast.Region: lambda item: f"region {own_name(item.name)} = {show_expr(item.value)}",
        ast.Def: _def,
        ast.Require: lambda item: f"require {own_name(item.name)}: {show_expr(item.formula)}",
        ast.Assume: lambda item: f"assume {own_name(item.name)}: {show_expr(item.formula)}",
    }
)
"""Class of declarations -> its text, without tags and comment."""

_PARTS: Mapping[type, Callable[[Any], str]] = MappingProxyType(
    {
        ast.Spec: _spec,
        ast.Import: _import_line,
        ast.Tag: _tag,
        ast.TypeRef: _type,
        ast.Formal: _formal,
        ast.Arg: lambda arg: show_args((arg,)),
        ast.Interval: show_interval,
        ast.SetLiteral: show_set,
    }
)
"""Class of other nodes -> its text."""
