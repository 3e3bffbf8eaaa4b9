"""Conversion of parse trees to syntax trees, bottom-up and without recursion, so no text exhausts the stack.

A long chain such as `a and b and …` becomes a balanced tree: it is no deep nesting, and no pass over the tree
needs to know of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from lark import Token, Tree

from stlc.diagnostics import Diagnostic
from stlc.grammar.builder import EXPRESSIONS, BuildContext, BuildRule, TerminalToken
from stlc.grammar.declarations import DECLARATIONS
from stlc.grammar.scan import Lexeme
from stlc.source import Span

MAX_DEPTH = 150
LONG_CHAIN = 32
"""Operands of the longest chain that is not balanced."""

_RULES: Mapping[str, BuildRule] = MappingProxyType({**EXPRESSIONS, **DECLARATIONS})
_RANKS = (("and", "&", "&&"), ("or", "|", "||"), ("+", "-"), ("*", "/"))
"""Operators that may stand in one chain."""
_INVERSE = ("-", "/")


class PieceError(Exception):
    """Syntax error in one declaration or expression."""

    def __init__(self, finding: Diagnostic) -> None:
        self.finding = finding


def fold(tree: Tree[Token], context: BuildContext, base: int) -> Any:
    """Convert a parse tree to the syntax tree; `base` is the offset of the parsed piece in the text.

    Raises:
        PieceError: the tree is too deep (E005).
    """
    built: dict[int, _Built | _Chain] = {}

    def child_of(child: Tree[Token] | Token | None) -> _Built:
        if child is None:
            return _Built(None)
        if isinstance(child, Token):
            assert child.start_pos is not None
            assert child.end_pos is not None
            span = context.source.span(base + child.start_pos, base + child.end_pos)
            return _Built(TerminalToken(child.type, str(child), span))
        found = built.pop(id(child))
        return found if isinstance(found, _Built) else found.tree(context, 0, len(found.operands))

    for node in tree.iter_subtrees():
        meta = node.meta
        start, end = (0, 0) if meta.empty else (meta.start_pos, meta.end_pos)
        span = context.source.span(base + start, base + end)
        chained = node.data in ("logic", "binary")
        rank = next((rank for rank in _RANKS if chained and node.children[1] in rank), ())
        if rank:
            left, operator, right = node.children
            chain = built.pop(id(left), None)
            if not isinstance(chain, _Chain) or chain.rank != rank:
                built[id(left)] = chain if chain is not None else child_of(left)
                chain = _Chain(_RULES[node.data], rank, span.start, [child_of(left)])
            chain.operators.append(child_of(operator).value)
            chain.operands.append(child_of(right))
            chain.ends.append(span.end)
            built[id(node)] = chain
            continue
        children = [child_of(child) for child in node.children]
        value = _RULES[node.data](context, span, [child.value for child in children])
        built[id(node)] = _Built(value, _depth(children, span))
        if node.data.endswith("_decl") or node.data.startswith("param_"):
            context.documented = span.end
    return child_of(tree).value


@dataclass(frozen=True, slots=True)
class _Built:
    """Converted node of the parse tree (`value`), and how deep it is nested."""

    value: Any
    depth: int = 0


@dataclass(slots=True)
class _Chain:
    """Chain of operands and operators of one rank, such as `a + b - c`, that is being converted.

    Attributes:
        rule: conversion of an operator with its two operands.
        rank: operators that may stand in the chain.
        start: offset of the chain.
        operands: operands of the chain.
        operators: operators; the first stands before the second operand.
        ends: offset behind each operand and its brackets, but the first.
    """

    rule: BuildRule
    rank: tuple[str, ...]
    start: int
    operands: list[_Built]
    operators: list[TerminalToken] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)

    def tree(self, context: BuildContext, low: int, high: int) -> _Built:
        """Return the operands with indices from `low` to `high` (exclusive) as one node.

        Raises:
            PieceError: the node is nested too deeply.
        """
        start = self.start
        if low:
            start = next(Lexeme.scan(context.source.text, self.operators[low - 1].span.end)).start

        def joined(left: _Built, right: _Built, middle: int, end: int) -> _Built:
            span = context.source.span(start, self.ends[end - 2])
            value = self.rule(context, span, [left.value, self.operators[middle - 1], right.value])
            return _Built(value, _depth((left, right), span))

        middle = low
        if high - low > LONG_CHAIN:  # split at the associative operator nearest to the middle
            half = (low + high) // 2
            near = (at for step in range(high - low) for at in (half - step, half + step) if low < at < high)
            middle = next((at for at in near if self.operators[at - 1].text not in _INVERSE), low)
        if middle > low:
            return joined(self.tree(context, low, middle), self.tree(context, middle, high), middle, high)
        found = self.operands[low]
        for index in range(low + 1, high):
            found = joined(found, self.operands[index], index, index + 1)
        return found


def _depth(parts: Iterable[_Built], span: Span) -> int:
    """Return the nesting depth of a node with these parts. Raises PieceError (E005) if it is too deep."""
    depth = 1 + max((part.depth for part in parts), default=0)
    if depth > MAX_DEPTH:
        first_line = span.source.span(span.start, min(span.end, span.start + 40))
        advice = ("name its inner parts with `def`",)
        message = f"this is nested more than {MAX_DEPTH} deep"
        raise PieceError(Diagnostic("E005", message, first_line, help=advice))
    return depth
