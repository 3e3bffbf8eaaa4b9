"""Parser from text to syntax tree, based on Lark.

A text is split before each declaration and the pieces are parsed separately, so that one run reports all
independent errors. Parse trees are converted bottom-up without recursion, so that no text exhausts the stack.
Only the modules of `stlc.grammar.parse` use Lark.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from itertools import islice
from types import MappingProxyType
from typing import Any

from lark import Token, Tree, UnexpectedInput

from stlc.diagnostics import Diagnostic, SpecError
from stlc.grammar import ast
from stlc.grammar.errors import hints
from stlc.grammar.errors.failure import Piece
from stlc.grammar.errors.unicode import unseen_characters
from stlc.grammar.parse.builder import EXPRESSIONS, BuildContext, BuildRule, TerminalToken
from stlc.grammar.parse.declarations import DECLARATIONS, Item, assemble
from stlc.grammar.parse.tables import load_parser
from stlc.grammar.scan import declaration_starts, lexemes
from stlc.source import Source

MAX_ERRORS = 20
MAX_DEPTH = 150
MAX_TEXT = 1_000_000
MAX_LEXEMES = 30_000
_SHARED_TEXT = 32_768
"""Characters of the longest text whose trees are shared: they keep the text in memory."""

_RULES: Mapping[str, BuildRule] = MappingProxyType({**EXPRESSIONS, **DECLARATIONS})


def parse(source: Source) -> ast.Spec:
    """Return the syntax tree of a specification.

    Raises:
        SpecError: the text has errors; of the independent ones, the first `MAX_ERRORS` are reported.
    """
    _check_text(source, 0, len(source.text))
    context = BuildContext(source)
    items: list[Item] = []
    starts = declaration_starts(source.text)
    skip_line = 0
    for start, end in zip(starts, [*starts[1:], len(source.text)], strict=True):
        if skip_line and source.position(start)[0] == skip_line:
            continue
        skip_line = 0
        piece = Piece(source, start, end, "start")
        try:
            items.extend(_build(piece, context))
        except _PieceError as error:
            context.findings.append(error.finding)
            skip_line = source.position(max(start, end - 1))[0]
        if len(context.findings) >= MAX_ERRORS:
            break
    spec = assemble(source, items, context.findings)
    if context.findings:
        raise SpecError(*context.findings[:MAX_ERRORS])
    return spec


def parse_expr(source: Source, start: int = 0, end: int | None = None) -> ast.Expr:
    """Return the syntax tree of the expression between the offsets `start` and `end` of a text.

    Source locations in the tree refer to the whole text. Trees of equal texts are shared, because a system
    file is often read several times by one command.

    Raises:
        SpecError: the expression has an error in its syntax, a unit or a number.
    """
    end = len(source.text) if end is None else end
    return (_shared if len(source.text) <= _SHARED_TEXT else _parsed)(source, start, end)


def _parsed(source: Source, start: int, end: int) -> ast.Expr:
    _check_text(source, start, end)
    context = BuildContext(source)
    piece = Piece(source, start, end, "expr")
    try:
        expr: ast.Expr = _build(piece, context)
    except _PieceError as error:
        raise SpecError(*context.findings, error.finding) from None
    if context.findings:
        raise SpecError(*context.findings[:MAX_ERRORS])
    return expr


_shared = lru_cache(maxsize=1024)(_parsed)


class _PieceError(Exception):
    """Syntax error in one declaration or expression."""

    def __init__(self, finding: Diagnostic) -> None:
        self.finding = finding


def _check_text(source: Source, start: int, end: int) -> None:
    """Raise SpecError if the text from `start` to `end` is too long (E005) or has odd blanks (E001)."""
    if end - start > MAX_TEXT:
        raise SpecError(Diagnostic("E005", f"`{source.name}` is larger than {MAX_TEXT // 1_000_000} MB"))
    if any(islice(lexemes(source.text, start, end), MAX_LEXEMES, None)):
        message = f"`{source.name}` has more than {MAX_LEXEMES:,} words and signs"
        raise SpecError(Diagnostic("E005", message))
    unseen = tuple(islice(unseen_characters(source, start, end), MAX_ERRORS))
    if unseen:
        raise SpecError(*unseen)


def _build(piece: Piece, context: BuildContext) -> Any:
    try:
        tree = load_parser().parse(piece.text, start=piece.rule)
    except UnexpectedInput as error:
        raise _PieceError(hints.diagnose(piece, _offset(error, piece))) from None
    assert isinstance(tree, Tree)
    return _fold(tree, context, piece.start)


def _offset(error: UnexpectedInput, piece: Piece) -> int:
    """Return the offset in the whole text at which the parsing of the part `piece` failed."""
    token = getattr(error, "token", None)
    if token is not None and token.type == "$END":
        return piece.end
    return piece.start + (error.pos_in_stream or 0)


def _fold(tree: Tree[Token], context: BuildContext, base: int) -> Any:
    """Convert a parse tree to the syntax tree, bottom-up and without recursion.

    `base` is the offset of the parsed piece in the text. An error (E005) is raised if the tree is too deep.
    """
    values: dict[int, Any] = {}
    depths: dict[int, int] = {}
    for node in tree.iter_subtrees():
        meta = node.meta
        start, end = (0, 0) if meta.empty else (meta.start_pos, meta.end_pos)
        span = context.source.span(base + start, base + end)
        depth = 1 + max((depths[id(child)] for child in node.children if isinstance(child, Tree)), default=0)
        if depth > MAX_DEPTH:
            raise _PieceError(hints.too_deep(span, MAX_DEPTH))
        children = [_child(child, values, context, base) for child in node.children]
        values[id(node)] = _RULES[node.data](context, span, children)
        depths[id(node)] = depth
        if node.data.endswith("_decl") or node.data.startswith("param_"):
            context.documented = span.end
    return values[id(tree)]


def _child(
    child: Tree[Token] | Token | None, values: Mapping[int, Any], context: BuildContext, base: int
) -> Any:
    match child:
        case None:
            return None
        case Token():
            assert child.start_pos is not None
            assert child.end_pos is not None
            return TerminalToken(
                child.type, str(child), context.source.span(base + child.start_pos, base + child.end_pos)
            )
        case _:
            return values[id(child)]
