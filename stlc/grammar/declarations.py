"""Conversion of parsed declarations and pragmas to the syntax tree: one function per grammar rule.

The rules are those of `stl.lark`; expressions are converted in `builder.py`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, TypeAlias

from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.grammar.builder import (
    BuildContext,
    BuildRule,
    TerminalToken,
    name_of,
    number_of,
    own_name,
    several,
    unit_of,
)
from stlc.source import Span

_SIZE_DIGITS = 4
_DOC = re.compile(r"^[ \t]*##(?!#)[ \t]?(.*?)[^\S\n]*$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Pragma:
    """Line with a property of the whole file: `spec NAME`, `system "path"` or `time unit`."""

    kind: str
    value: str
    span: Span


Item: TypeAlias = Pragma | ast.Import | ast.Declaration | tuple[ast.Declaration, ...]


def _system_ref(_: BuildContext, __: Span, children: Sequence[Any]) -> Pragma:
    (leaf,) = children
    return Pragma("system", leaf.text[1:-1], leaf.span)


def _time_unit(_: BuildContext, span: Span, children: Sequence[Any]) -> Pragma:
    text = children[0].text
    return Pragma("time", "steps" if text == "step" else text, span)


def _import(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Import:
    target, alias = children
    is_file = target.kind == "STRING"
    path = target.text[1:-1] if is_file else name_of(target)
    return ast.Import(span, path, is_file, None if alias is None else own_name(context, alias))


def _tag(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Tag:
    leaf, args = children
    return ast.Tag(span, name_of(leaf), args or ())


def _type(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.TypeRef:
    leaf, written = children
    digits = "" if written is None else written.text.strip("[] \t\r\n")
    if len(digits) > _SIZE_DIGITS:
        context.findings.append(Diagnostic("E005", "a vector of that size is too large", written.span))
        digits = "1"
    return ast.TypeRef(span, name_of(leaf), int(digits) if digits else None)


def _sort(context: BuildContext, _: Span, children: Sequence[Any]) -> tuple[ast.TypeRef | None, str]:
    written, unit = children
    return written, unit_of(context, unit)


def _formal(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Formal:
    leaf, written = children
    return ast.Formal(span, own_name(context, leaf), written)


def _heads(
    context: BuildContext, span: Span, names: Sequence[TerminalToken], tags: tuple[ast.Tag, ...]
) -> list[dict[str, Any]]:
    """Return the fields that every declaration has, as one mapping (field name -> value) per declared name.

    The `##` lines before the first name become the field `doc`.
    """
    lines = _DOC.finditer(context.source.text, context.documented, names[0].span.start)
    shared = {"span": span, "tags": tags, "doc": "\n".join(match[1] for match in lines)}
    return [{**shared, "name": own_name(context, leaf), "name_span": leaf.span} for leaf in names]


def _declaration(kind: Callable[..., ast.Declaration], *parts: str) -> BuildRule:
    """Return a function that converts declarations with one name to nodes of class `kind`.

    The converted children of a declaration are its tags, its name, and one value for each field in `parts`,
    in order. The entry `sort` in `parts` stands for the two fields `type` and `unit`.
    """

    def build(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Declaration:
        tags, leaf, *values = children
        (head,) = _heads(context, span, (leaf,), tags)
        own = dict(zip(parts, values, strict=True))
        if "sort" in own:
            own["type"], own["unit"] = own.pop("sort")
        if "formals" in own:
            own["formals"] = own["formals"] or ()
        return kind(**head, **own)

    return build


def _signals(context: BuildContext, span: Span, children: Sequence[Any]) -> tuple[ast.Signal, ...]:
    tags, role, names, (written, unit), domain, column = children
    if column is not None and len(names) > 1:
        context.findings.append(
            Diagnostic(
                "E010",
                f"`from` names one column, but this declares {len(names)} signals",
                column.span,
                labels=(names[0].span.to(names[-1].span).label("the signals"),),
                help=("declare them one by one",),
            )
        )
    own = {
        "role": None if role is None else role.text,
        "type": written,
        "unit": unit,
        "domain": domain,
        "column": None if column is None else column.text[1:-1],
    }
    return tuple(ast.Signal(**head, **own) for head in _heads(context, span, names, tags))


def _params(context: BuildContext, span: Span, children: Sequence[Any]) -> tuple[ast.Param, ...]:
    tags, names, (written, unit), domain = children
    own = {"type": written, "unit": unit, "domain": domain}
    return tuple(ast.Param(**head, **own) for head in _heads(context, span, names, tags))


def _whole(context: BuildContext, span: Span, children: Sequence[Any]) -> int:
    minus, leaf = children
    value = number_of(context, leaf)
    if value.denominator != 1:
        context.findings.append(Diagnostic("E010", "the value of an enum member is a whole number", span))
    return -int(value) if minus is not None else int(value)


def _enum(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Enum:
    tags, leaf, *written = children
    members: list[tuple[str, int]] = []
    for name, value in written:
        after = members[-1][1] + 1 if members else 0
        members.append((own_name(context, name), after if value is None else value))
    (head,) = _heads(context, span, (leaf,), tags)
    return ast.Enum(**head, members=tuple(members))


def _extern(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Declaration:
    *before, unit = children
    build = _declaration(partial(ast.Extern, unit=unit_of(context, unit)), "formals", "type")
    extern: ast.Extern = build(context, span, before)
    return extern


DECLARATIONS: Mapping[str, BuildRule] = MappingProxyType(
    {
        **dict.fromkeys(("start", "tags", "names", "formals", "member"), several),
        "spec_name": lambda _, span, children: Pragma("spec", name_of(children[0]), span),
        "system_ref": _system_ref,
        "time_unit": _time_unit,
        "import_": _import,
        "tag": _tag,
        "sort": _sort,
        "type": _type,
        "formal": _formal,
        "whole": _whole,
        "signal_decl": _signals,
        "const_decl": _declaration(ast.Const, "sort", "value"),
        **dict.fromkeys(("param_in", "param_from"), _params),
        "enum_decl": _enum,
        "region_decl": _declaration(ast.Region, "value"),
        "def_decl": _declaration(ast.Def, "formals", "type", "value"),
        "extern_decl": _extern,
        "require_decl": _declaration(ast.Require, "formula"),
        "assume_decl": _declaration(ast.Assume, "formula"),
    }
)
"""Rule of the grammar -> function that converts its parse-tree nodes."""
