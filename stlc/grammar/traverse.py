"""The nodes of a syntax tree, outermost first, without recursion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields

from stlc.grammar import ast


def children(node: ast.Node) -> Iterator[ast.Node]:
    """The nodes directly below a node, in the order of the text."""
    for part in fields(node):
        yield from _within(getattr(node, part.name))


def descendants(node: ast.Node) -> Iterator[ast.Node]:
    """A node and everything below it, in the order of the text."""
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
