"""Tokens of a specification, each with the comments around it.

The formatter needs the comments, which the syntax tree does not contain. The text is split as in
`parser.parse` and parsed with the same tables, so the tokens are those of the syntax tree.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from lark import Token as LarkToken
from lark import Tree, UnexpectedInput

from stlc.diagnostics import SpecError
from stlc.grammar.scan import declaration_starts
from stlc.grammar.tables import load_parser
from stlc.source import Source

_COMMENT = re.compile(r"(?:#|//)[^\n]*")
_WITH_BLANKS = frozenset({"UNARY_AT", "BINARY_AT", "_NOT_IN"})


@dataclass(frozen=True, slots=True)
class Comment:
    """Comment in the source, without trailing blanks.

    Attributes:
        text: text with its `#` or `//`.
        own_line: whether the comment is the first thing on its line.
        apart: whether there is an empty line before the comment.
    """

    text: str
    own_line: bool
    apart: bool = False


@dataclass(frozen=True, slots=True)
class Token:
    """Token of the source text, with the comments around it.

    Attributes:
        kind: name of the token's terminal in the grammar.
        text: text of the token in the source.
        start: offset of the first character.
        end: offset after the last character.
        before: comments between the previous token and this one, without the comment that is `after` of the
            previous token.
        after: comment after the token on the same line.
        apart: whether there is an empty line between the comments in `before` and the token.
    """

    kind: str
    text: str
    start: int
    end: int
    before: tuple[Comment, ...] = ()
    after: Comment | None = None
    apart: bool = False


@dataclass(frozen=True, slots=True)
class Item:
    """Pragma, import or declaration: its grammar rule and its tokens."""

    rule: str
    tokens: tuple[Token, ...]


@dataclass(frozen=True, slots=True)
class TokenLayout:
    """Tokens of a whole text, grouped by item (declaration, import, or line such as `time s`).

    `rest` holds the comments after the last item.
    """

    items: tuple[Item, ...]
    rest: tuple[Comment, ...]


def tokenize(source: Source) -> TokenLayout:
    """Split a text that `parser.parse` accepts into tokens, each with the comments around it.

    Raises:
        SpecError: E010, the text is not well-formed.
    """
    tokens: list[Token] = []
    places: list[tuple[str, int, int]] = []
    starts = declaration_starts(source.text)
    for start, end in zip(starts, [*starts[1:], len(source.text)], strict=True):
        _read_piece(source, start, end, tokens, places)
    rest = _attach(source.text, tokens)
    items = tuple(_items(tokens, places))
    last = items[-1].tokens[-1].end if items else 0
    dropped = (comment for token in tokens if token.start >= last for comment in _own(token))
    return TokenLayout(items, (*dropped, *rest))


def _read_piece(
    source: Source, start: int, end: int, tokens: list[Token], places: list[tuple[str, int, int]]
) -> None:
    """Parse the part of a text from `start` to `end`.

    Its tokens are appended to `tokens`. For each item (such as a declaration), (grammar rule, start, end) is
    appended to `places`. Raises SpecError (E010) if the part does not parse.
    """
    interactive = load_parser().parse_interactive(source.text[start:end], start="start")
    last: LarkToken | None = None
    try:
        for token in interactive.iter_parse():
            last = token
            tokens.append(Token(token.type, str(token), start + _at(token), start + _at(token) + len(token)))
        tree = interactive.feed_eof(last)  # type: ignore[no-untyped-call]
    except UnexpectedInput as error:
        offset = start + (error.pos_in_stream or 0)
        place = source.span(offset, offset)
        raise SpecError.of("E010", "this cannot be read", place) from None
    assert isinstance(tree, Tree)
    found = [item for item in tree.children if isinstance(item, Tree)]
    places += [(str(item.data), start + item.meta.start_pos, start + item.meta.end_pos) for item in found]


def _at(token: LarkToken) -> int:
    assert token.start_pos is not None
    return token.start_pos


def _items(tokens: Sequence[Token], places: Sequence[tuple[str, int, int]]) -> Iterator[Item]:
    """Yield the items (pragmas, imports, declarations) with their tokens.

    `places` has (grammar rule, start offset, end offset) of each item.

    A token between two items, such as `;`, belongs to no item; its comments are moved to the next item.
    """
    index = 0
    for rule, start, end in places:
        carried: tuple[Comment, ...] = ()
        apart = False
        while tokens[index].start < start:
            carried += _own(tokens[index])
            apart |= tokens[index].apart
            index += 1
        first = index
        while index < len(tokens) and tokens[index].end <= end:
            index += 1
        own = list(tokens[first:index])
        own[0] = replace(own[0], before=(*carried, *own[0].before), apart=apart or own[0].apart)
        yield Item(rule, tuple(own))


def _own(token: Token) -> tuple[Comment, ...]:
    """Return the comments of a token that is not printed itself.

    The formatter prints each comment on its own line.

    A `##` comment after the token gets another `#` in front. Otherwise it would document the next item.
    """
    if token.after is None:
        return token.before
    text = f"# {token.after.text}" if token.after.text.startswith("##") else token.after.text
    return (*token.before, Comment(text, own_line=True))


# ----------------------------------------------------------------------- comments


def _attach(text: str, tokens: list[Token]) -> tuple[Comment, ...]:
    """Attach every comment of the text to a token in `tokens`; return the comments after the last token."""
    previous, offset = -1, 0
    for index, token in enumerate(tokens):
        found, apart = _comments(text, offset, token.start, first=previous < 0)
        found = _give_trailing(tokens, previous, found)
        # `always@` and `not in` consist of two words or signs; a comment between these moves before the token
        inside = _COMMENT.finditer(token.text) if token.kind in _WITH_BLANKS else ()
        moved = (Comment(match[0].rstrip(), own_line=True) for match in inside)
        tokens[index] = replace(token, before=(*found, *moved), apart=apart)
        previous, offset = index, token.end
    rest, _ = _comments(text, offset, len(text), first=previous < 0)
    return _give_trailing(tokens, previous, rest)


def _give_trailing(tokens: list[Token], index: int, found: tuple[Comment, ...]) -> tuple[Comment, ...]:
    """Attach a comment that follows a token on the same line to this token; return the other comments.

    `index` is the index of the token, and `found` has the comments between this token and the next one. Only
    the first comment can be on the line of the token. If the token is `;`, the comment is attached to the
    token before the `;`.
    """
    if not found or found[0].own_line or index < 0:
        return found
    owner = index
    while owner > 0 and tokens[owner].kind == "SEMICOLON" and tokens[owner - 1].after is None:
        owner -= 1
    tokens[owner] = replace(tokens[owner], after=found[0])
    return found[1:]


def _comments(text: str, start: int, end: int, *, first: bool) -> tuple[tuple[Comment, ...], bool]:
    """Return the comments between the offsets `start` and `end`, and whether an empty line follows them.

    If `first`, no token precedes the comments. The first comment then counts as alone on its line.
    """
    found: list[Comment] = []
    offset = start
    for match in _COMMENT.finditer(text, start, end):
        breaks = text.count("\n", offset, match.start())
        own_line = breaks > 0 or bool(found) or first
        found.append(Comment(match[0].rstrip(), own_line, apart=breaks > 1))
        offset = match.end()
    return tuple(found), text.count("\n", offset, end) > 1
