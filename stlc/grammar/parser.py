"""Parser of expressions and other pieces of a text, based on Lark: from text to syntax tree."""

from __future__ import annotations

from functools import lru_cache
from itertools import islice
from typing import Any

from lark import Tree, UnexpectedInput

from stlc.diagnostics import SpecError
from stlc.grammar import ast
from stlc.grammar.builder import BuildContext
from stlc.grammar.errors.failure import Piece
from stlc.grammar.errors.hints import diagnose
from stlc.grammar.errors.unicode import unseen_characters
from stlc.grammar.fold import PieceError, fold
from stlc.grammar.scan import Lexeme
from stlc.grammar.tables import load_parser
from stlc.source import Source

MAX_ERRORS = 20
MAX_TEXT = 4_000_000
MAX_LEXEMES = 500_000
"""Words and signs of the longest text: linting it takes half a minute of the processor and some 200 MB."""
_SHARED_TEXT = 32_768
"""Characters of the longest text whose trees are shared: they keep the text in memory."""


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
    check_text(source, start, end)
    context = BuildContext(source)
    piece = Piece(source, start, end, "expr")
    try:
        expr: ast.Expr = build(piece, context)
    except PieceError as error:
        raise SpecError(*context.findings, error.finding) from None
    if context.findings:
        raise SpecError(*context.findings[:MAX_ERRORS])
    return expr


_shared = lru_cache(maxsize=1024)(_parsed)


def check_text(source: Source, start: int, end: int) -> None:
    """Raise SpecError if the text from `start` to `end` is too long (E005) or has odd blanks (E001)."""
    if end - start > MAX_TEXT:
        raise _too_large(source, f"is larger than {MAX_TEXT // 1_000_000} million characters")
    if any(islice(Lexeme.scan(source.text, start, end), MAX_LEXEMES, None)):
        raise _too_large(source, f"has more than {MAX_LEXEMES:,} words and signs")
    unseen = tuple(islice(unseen_characters(source, start, end), MAX_ERRORS))
    if unseen:
        raise SpecError(*unseen)


def _too_large(source: Source, what: str) -> SpecError:
    help_ = ("split it into several specifications, and `import` what they share",)
    return SpecError.of("E005", f"`{source.name}` {what}", help=help_)


def build(piece: Piece, context: BuildContext) -> Any:
    """Return what a piece of a text stands for. Raises PieceError for an error of its syntax."""
    try:
        tree = load_parser().parse(piece.text, start=piece.rule)
    except UnexpectedInput as error:
        ended = getattr(getattr(error, "token", None), "type", "") == "$END"
        offset = piece.end if ended else piece.start + (error.pos_in_stream or 0)
        raise PieceError(diagnose(piece, offset)) from None
    assert isinstance(tree, Tree)
    return fold(tree, context, piece.start)
