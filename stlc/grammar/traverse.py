"""Traversal of a syntax tree, outermost node first, without recursion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields

from stlc.grammar import ast


def children(node: ast.Node) -> Iterator[ast.Node]:
    """Yield the nodes directly below a node, in source order."""
    for part in fields(node):
        yield from _within(getattr(node, part.name))


def descendants(node: ast.Node) -> Iterator[ast.Node]:
    """Yield a node and all nodes below it, in source order."""
    stack = [node]
    while stack:
        top = stack.pop()
        yield top
        stack.extend(reversed(list(children(top))))


def _within(value: object) -> Iterator[ast.Node]:
    if isinstance(value, ast.Node):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from _within(item)
