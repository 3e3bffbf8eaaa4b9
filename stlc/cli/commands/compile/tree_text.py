"""Syntax trees as indented text, as values for JSON, and as a graph for Graphviz."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import fields
from fractions import Fraction
from typing import Any

from stlc.escape import visible
from stlc.grammar import ast
from stlc.grammar.spec import Spec
from stlc.jsontext import dumps

_HIDDEN = frozenset({"span", "name_span", "system_span", "source", "quoted"})
_ODD = re.compile(r"[\s\"\\=]")


def as_tree(spec: Spec) -> str:
    """Text with one line per node of a syntax tree; children are indented below their parent."""
    lines: list[str] = []
    stack: list[tuple[int, ast.Node]] = [(0, spec)]
    while stack:
        depth, node = stack.pop()
        lines.append("  " * depth + " ".join([type(node).__name__, *_facts(node)]))
        stack.extend((depth + 1, child) for child in reversed(list(node.children())))
    return "\n".join(lines)


def _facts(node: ast.Node) -> Iterator[str]:
    """Yield the attributes of a node as texts, without its children."""
    for name, value in _own(node):
        if name == "clock" and value == "now":
            continue
        text = _short(value)
        yield text if name in ("name", "op", "kind", "value", "var", "target") else f"{name}={text}"


def _own(node: ast.Node) -> Iterator[tuple[str, Any]]:
    for part in fields(node):
        value = getattr(node, part.name)
        if part.name in _HIDDEN or isinstance(value, ast.Node) or value in (None, "", (), False):
            continue
        plain = [item for item in value if not _holds_nodes(item)] if isinstance(value, tuple) else value
        if plain != []:
            yield part.name, plain


def _holds_nodes(value: object) -> bool:
    if isinstance(value, tuple):
        return any(map(_holds_nodes, value))
    return isinstance(value, ast.Node)


def _short(value: object) -> str:
    match value:
        case list():
            return " ".join(map(_short, value))
        case tuple():
            return "=".join(map(_short, value))
        case Fraction():
            return str(value.numerator) if value.denominator == 1 else f"{float(value):.12g}"
        case str() if _ODD.search(value):
            return dumps(value.replace("\n", " / "))
        case _:
            return str(value)


def as_values(node: ast.Node) -> dict[str, Any]:
    """JSON record of a syntax tree: class, line and column of the node, and its fields."""
    values: Any = {"node": type(node).__name__, "line": node.span.line, "column": node.span.column}
    for part in fields(node):
        if part.name not in _HIDDEN:
            values[part.name] = _value(getattr(node, part.name))
    record: dict[str, Any] = values
    return record


def _value(value: object) -> Any:
    match value:
        case ast.Node():
            return as_values(value)
        case tuple():
            return [_value(item) for item in value]
        case Fraction():
            return int(value) if value.denominator == 1 else float(value)
        case _:
            return value


def as_dot(specs: Sequence[Spec]) -> str:
    """Text of a directed graph for Graphviz, in which every node of the trees is a node."""
    lines = ["digraph stlc {", '  node [shape=box, fontname="monospace"];']
    count = 0
    stack: list[tuple[int | None, ast.Node]] = [(None, spec) for spec in reversed(specs)]
    while stack:
        parent, node = stack.pop()
        label = dot(" ".join([type(node).__name__, *_facts(node)]))
        lines.append(f"  n{count} [label={label}];")
        if parent is not None:
            lines.append(f"  n{parent} -> n{count};")
        own, count = count, count + 1
        stack.extend((own, child) for child in reversed(list(node.children())))
    return "\n".join([*lines, "}"])


def dot(text: str) -> str:
    """Return a text as a string in double quotes for the graph language of Graphviz."""
    return '"' + visible(text).replace("\\", "\\\\").replace('"', '\\"') + '"'
