"""Parse tree to AST, declarations and pragmas: one function per rule of `stl.lark`, as in `builder.py`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeAlias

from stlc.diagnostics import Diagnostic, Label
from stlc.grammar import ast
from stlc.grammar.parse.builder import (
    BuildContext,
    BuildRule,
    TerminalToken,
    name_of,
    number_of,
    own_name,
    unit_of,
)
from stlc.source import Source, Span

_SIZE_DIGITS = 4
_DOC = re.compile(r"^[ \t]*##(?!#)[ \t]?(.*?)[^\S\n]*$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Pragma:
    """`spec NAME`, `system "path"` or `time unit`."""

    kind: str
    value: str
    span: Span


Item: TypeAlias = Pragma | ast.Import | ast.Item | tuple[ast.Item, ...]

# ------------------------------------------------------------------------ pragmas


def _spec_name(_: BuildContext, span: Span, children: Sequence[Any]) -> Pragma:
    return Pragma("spec", name_of(children[0]), span)


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


# ---------------------------------------------------------------- parts of several


def _several(_: BuildContext, __: Span, children: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(children)


def _tag(_: BuildContext, span: Span, children: Sequence[Any]) -> ast.Tag:
    leaf, args = children
    return ast.Tag(span, name_of(leaf), args or ())


def _type(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.TypeRef:
    leaf, size = children
    return ast.TypeRef(span, name_of(leaf), None if size is None else _size(context, size))


def _size(context: BuildContext, leaf: TerminalToken) -> int:
    digits = leaf.text.strip("[] \t\r\n")
    if len(digits) <= _SIZE_DIGITS:
        return int(digits)
    context.findings.append(Diagnostic("E005", "a vector of that size is too large", leaf.span))
    return 1


def _sort(context: BuildContext, _: Span, children: Sequence[Any]) -> tuple[ast.TypeRef | None, str]:
    written, unit = children
    return written, unit_of(context, unit)


def _formal(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Formal:
    leaf, written = children
    return ast.Formal(span, own_name(context, leaf), written)


def _doc(context: BuildContext, end: int) -> str:
    """Return the `##` lines from the last declaration up to `end`."""
    lines = [match[1] for match in _DOC.finditer(context.source.text, context.documented, end)]
    return "\n".join(lines)


def _head(
    context: BuildContext, span: Span, leaf: TerminalToken, tags: tuple[ast.Tag, ...]
) -> dict[str, Any]:
    """Return the fields common to all declarations."""
    (head,) = _heads(context, span, (leaf,), tags)
    return head


def _heads(
    context: BuildContext, span: Span, names: Sequence[TerminalToken], tags: tuple[ast.Tag, ...]
) -> list[dict[str, Any]]:
    """Return the common fields for each name of a declaration."""
    shared = {"span": span, "tags": tags, "doc": _doc(context, names[0].span.start)}
    return [{**shared, "name": own_name(context, leaf), "name_span": leaf.span} for leaf in names]


# ------------------------------------------------------------------- declarations


def _signals(context: BuildContext, span: Span, children: Sequence[Any]) -> tuple[ast.Signal, ...]:
    tags, role, names, (written, unit), domain, column = children
    if column is not None and len(names) > 1:
        context.findings.append(
            Diagnostic(
                "E010",
                f"`from` names one column, but this declares {len(names)} signals",
                column.span,
                labels=(Label(names[0].span.to(names[-1].span), "the signals"),),
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


def _const(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Const:
    tags, leaf, (written, unit), value = children
    return ast.Const(**_head(context, span, leaf, tags), type=written, unit=unit, value=value)


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


def _member(_: BuildContext, __: Span, children: Sequence[Any]) -> tuple[TerminalToken, int | None]:
    leaf, value = children
    return leaf, value


def _enum(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Enum:
    tags, leaf, *written = children
    members: list[tuple[str, int]] = []
    for name, value in written:
        after = members[-1][1] + 1 if members else 0
        members.append((own_name(context, name), after if value is None else value))
    return ast.Enum(**_head(context, span, leaf, tags), members=tuple(members))


def _region(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Region:
    tags, leaf, value = children
    return ast.Region(**_head(context, span, leaf, tags), value=value)


def _def(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Def:
    tags, leaf, formals, written, value = children
    return ast.Def(**_head(context, span, leaf, tags), formals=formals or (), type=written, value=value)


def _extern(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Extern:
    tags, leaf, formals, written, unit = children
    head = _head(context, span, leaf, tags)
    return ast.Extern(**head, formals=formals or (), type=written, unit=unit_of(context, unit))


def _require(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Require:
    tags, leaf, formula = children
    return ast.Require(**_head(context, span, leaf, tags), formula=formula)


def _assume(context: BuildContext, span: Span, children: Sequence[Any]) -> ast.Assume:
    tags, leaf, formula = children
    return ast.Assume(**_head(context, span, leaf, tags), formula=formula)


DECLARATIONS: Mapping[str, BuildRule] = MappingProxyType(
    {
        "start": _several,
        "spec_name": _spec_name,
        "system_ref": _system_ref,
        "time_unit": _time_unit,
        "import_": _import,
        "tags": _several,
        "tag": _tag,
        "names": _several,
        "sort": _sort,
        "type": _type,
        "formals": _several,
        "formal": _formal,
        "whole": _whole,
        "member": _member,
        "signal_decl": _signals,
        "const_decl": _const,
        "param_in": _params,
        "param_from": _params,
        "enum_decl": _enum,
        "region_decl": _region,
        "def_decl": _def,
        "extern_decl": _extern,
        "require_decl": _require,
        "assume_decl": _assume,
    }
)

# ---------------------------------------------------------------------- the whole


def assemble(source: Source, items: Sequence[Item], findings: list[Diagnostic]) -> ast.Spec:
    """Return the specification of these items; a repeated pragma is a finding."""
    pragmas: dict[str, Pragma] = {}
    imports: list[ast.Import] = []
    declared: list[ast.Item] = []
    for item in items:
        match item:
            case Pragma(kind, _, span):
                if kind in pragmas:
                    findings.append(_twice(pragmas[kind], span))
                pragmas.setdefault(kind, item)
            case ast.Import():
                imports.append(item)
            case tuple():
                declared.extend(item)
            case _:
                declared.append(item)
    system = pragmas.get("system")
    return ast.Spec(
        source.span(0, len(source.text)),
        name=pragmas["spec"].value if "spec" in pragmas else "",
        system=None if system is None else system.value,
        system_span=None if system is None else system.span,
        time_unit=pragmas["time"].value if "time" in pragmas else "",
        imports=tuple(imports),
        items=tuple(declared),
        source=source,
    )


def _twice(first: Pragma, span: Span) -> Diagnostic:
    return Diagnostic(
        "E102",
        f"`{first.kind}` is given twice",
        span,
        label="again",
        labels=(Label(first.span, "first"),),
        help=("keep one of them",),
    )
