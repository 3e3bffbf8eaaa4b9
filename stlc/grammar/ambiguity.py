"""Detection of formulas without parentheses that other STL tools parse differently.

Precedence in other tools, from their grammars (temporal words are operators such as `always`):

    RTAMT      `or` binds tighter than `and`, temporal words bind loosest, `->` is left-associative
    MoonLight  `->` binds tighter than `or`, `or` than `and`, temporal words loosest; `->` is left-associative
    STLRom     `and`, `or` and `=>` have one rank, temporal words bind tightest
    FalCAuN    `&&`, `||` and `->` have one rank, left-associative; `!` and temporal words bind loosest
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

from stlc.grammar import ast
from stlc.grammar.scan import Lexeme
from stlc.grammar.spec import Spec
from stlc.source import Span

AmbiguityKind: TypeAlias = Literal["scope", "mixed", "chain", "until", "implication"]


@dataclass(frozen=True, slots=True)
class Ambiguity:
    """Part of a formula that should be in parentheses, since other STL tools can parse it differently.

    Attributes:
        span: location of the part in the source.
        kind: reason. "scope": a temporal operator whose operand extends further in other tools; "mixed":
            `and` next to `or`; "chain": consecutive implications; "until": `until` next to another
            connective; "implication": `and` or `or` next to `->`, which most tools parse as stlc does.
        outer: the connective that has the part as an operand.
    """

    span: Span
    kind: AmbiguityKind
    outer: str


def ambiguities(spec: Spec, *, implications: bool = False) -> Iterator[Ambiguity]:
    """Yield the parts of formulas that other tools parse differently, in source order.

    Args:
        spec: syntax tree of the specification.
        implications: whether to include the kind "implication".
    """
    words = _Words(spec)
    pairs = [node for node in spec.walk() if isinstance(node, ast.Logic | ast.Until)]
    clashes = [
        Ambiguity(operand.span, kind, node.op)
        for node in pairs
        for operand, left in ((node.left, True), (node.right, False))
        if not words.closed(operand, left=left) and (kind := _clash(node, operand, left=left)) is not None
    ]
    unclear = [part for part in clashes if implications or part.kind != "implication"]
    words.parenthesised.update((part.span.start, part.span.end) for part in unclear)
    found = [*unclear, *(part for node in pairs for part in _scope(node, words))]
    unique = {(part.span.start, part.span.end): part for part in reversed(found)}
    yield from sorted(unique.values(), key=lambda part: (part.span.start, -part.span.end))


class _Words:
    """Words and signs of a source text, used to find out which operands are in parentheses.

    `parenthesised` has the (start, end) offsets of operands that were reported before because they have no
    parentheses.
    """

    def __init__(self, spec: Spec) -> None:
        self.items: list[Lexeme] = list(Lexeme.scan(spec.source.text))
        self.starts = [item.start for item in self.items]
        self.parenthesised: set[tuple[int, int]] = set()

    def closed(self, node: ast.Node, *, left: bool) -> bool:
        """True if the operand `node` has parentheses, or was reported before because it has none.

        `left` is True if `node` is the left operand of its connective.
        """
        if (node.span.start, node.span.end) in self.parenthesised:
            return True
        at = bisect_left(self.starts, node.span.end if left else node.span.start)
        if left:
            return at < len(self.items) and self.items[at].text == ")"
        return at > 0 and self.items[at - 1].text == "("


def _clash(node: ast.Logic | ast.Until, operand: ast.Expr, *, left: bool) -> AmbiguityKind | None:
    if isinstance(operand, ast.Until):
        return "until"
    if not isinstance(operand, ast.Logic):
        return None
    juncts = ("and", "or", "xor")
    if node.op in juncts and operand.op in juncts and node.op != operand.op:
        return "mixed"
    if node.op == "->" and operand.op == "->" and not left:
        return "chain"
    return "implication" if node.op == "->" and operand.op in juncts else None


def _scope(node: ast.Logic | ast.Until, words: _Words) -> Iterator[Ambiguity]:
    """Yield the temporal operator that ends the left operand of the connective `node`, if there is one.

    The temporal operator has no parentheses. In other tools, its operand extends beyond the connective: they
    parse `always p and q` as `always (p and q)`.
    """
    part: ast.Node = node.left
    governed: ast.Node | None = None
    while not words.closed(part, left=True):
        if isinstance(part, ast.Temporal):
            yield Ambiguity((governed or part).span, "scope", node.op)
            return
        *_, last = (None, *part.children())
        if last is None or last.span.end < part.span.end:
            return
        governed = None if isinstance(part, ast.Logic | ast.Until) else governed or part
        part = last
