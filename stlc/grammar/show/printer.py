"""AST -> canonical text, with no parentheses but those that are needed. Law: `parse(show(a)) == a`.

One blank around operators, none inside brackets; aliases and other spellings (`G`, `&&`, `=>`) become the
names that the language prefers. Names of one's own get backticks where they would be read as something else.
"""

from __future__ import annotations

from typing import assert_never

from stlc.grammar import ast
from stlc.grammar.show.expressions import (
    Level,
    own_name,
    show_args,
    show_at,
    show_expr,
    show_interval,
    show_list,
    show_name,
    show_set,
)


def show(node: ast.Node) -> str:
    """The text of a node: an expression, a declaration or a whole specification."""
    match node:
        case ast.Spec():
            return _spec(node)
        case ast.Import():
            return _import(node)
        case ast.Declaration():
            return _declaration(node)
        case ast.Tag(name=name, args=args):
            return f"@{show_name(name)}" + (f"({show_args(args)})" if args else "")
        case ast.TypeRef():
            return _type(node)
        case ast.Formal(name=name, type=written):
            return own_name(name) + ("" if written is None else f": {_type(written)}")
        case ast.Arg():
            return show_args((node,))
        case ast.Interval():
            return show_interval(node)
        case ast.SetLiteral():
            return show_set(node)
    return show_expr(node)  # type: ignore[arg-type]


# ------------------------------------------------------------------- declarations


def _declaration(item: ast.Declaration) -> str:
    doc = "".join(f"## {line}".rstrip() + "\n" for line in item.doc.split("\n")) if item.doc else ""
    tags = "".join(f"{show(tag)}\n" for tag in item.tags)
    match item:
        case ast.Signal() | ast.Const() | ast.Param() | ast.Extern():
            text = _typed(item)
        case ast.Enum(members=members):
            listed = ", ".join(f"{own_name(name)} = {value}" for name, value in members)
            text = f"enum {own_name(item.name)} {{ {listed} }}"
        case ast.Region(value=value):
            text = f"region {own_name(item.name)} = {show_expr(value)}"
        case ast.Def(formals=formals, type=written, value=value):
            arguments = f"({', '.join(map(show, formals))})" if formals else ""
            sort = "" if written is None else f": {_type(written)}"
            text = f"def {own_name(item.name)}{arguments}{sort} = {show_expr(value)}"
        case ast.Require(formula=formula):
            text = f"require {own_name(item.name)}: {show_expr(formula)}"
        case ast.Assume(formula=formula):
            text = f"assume {own_name(item.name)}: {show_expr(formula)}"
        case _:
            raise TypeError(f"{type(item).__name__} is no declaration of the language")
    return f"{doc}{tags}{text}"


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


def _import(item: ast.Import) -> str:
    target = f'"{item.target}"' if item.is_file else show_name(item.target)
    return f"import {target}" + (f" as {own_name(item.alias)}" if item.alias else "")


def _spec(spec: ast.Spec) -> str:
    pragmas = [
        *([f"spec {show_name(spec.name)}"] if spec.name else []),
        *([f'system "{spec.system}"'] if spec.system is not None else []),
        *([f"time {spec.time_unit}"] if spec.time_unit else []),
        *map(_import, spec.imports),
    ]
    text = "\n".join(pragmas) + "\n" if pragmas else ""
    for before, item in zip((None, *spec.items), spec.items, strict=False):
        alike = type(before) is type(item) and not (item.doc or item.tags)
        text += "" if alike or not text else "\n"
        text += f"{_declaration(item)}\n"
    return text
