"""Items -> lines: one declaration after the other, its tags above it, its comments where they were."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from stlc.grammar.ambiguity import Ambiguity
from stlc.grammar.format.columns import Column, align
from stlc.grammar.format.document import expression, hangs, words
from stlc.grammar.format.layout import BLANK, LINE, Doc, Group, Nest, is_plain, render
from stlc.grammar.format.tokens import Text, gap, prepare
from stlc.grammar.parse.tokens import Comment, Item, Layout, Token

_OWN_COLUMN = {"const_decl": 2, "param_in": 2, "param_from": 2}
_DEFINED = frozenset({"def_decl", "region_decl", "const_decl"})
_REQUIRED = frozenset({"require_decl", "assume_decl"})


@dataclass(slots=True)
class _Page:
    """Lines as they are collected; an entry is one line and what may be aligned in it."""

    columns: list[Column] = field(default_factory=list)

    def add(self, text: str, *, apart: bool = False, **more: object) -> None:
        first = not self.columns
        self.columns.append(Column(text, apart=apart and not first, **more))  # type: ignore[arg-type]


def lay_out(layout: Layout, unclear: Sequence[Ambiguity], *, width: int) -> str:
    """The text of a layout; `unclear` parts get parentheses."""
    page = _Page()
    spans = sorted((part.span.start, part.span.end) for part in unclear)
    for item in layout.items:
        first = bisect_left(spans, (item.tokens[0].start, 0))
        last = bisect_left(spans, (item.tokens[-1].end, 0))
        _item(_with_parentheses(item, spans[first:last]), page, width)
    _comments(layout.rest, page)
    lines = align(page.columns)
    return "".join(f"{line}\n" for line in lines)


def _comments(comments: Sequence[Comment], page: _Page) -> None:
    for comment in comments:
        page.add(comment.text, apart=comment.apart, kind="comment")


def _item(item: Item, page: _Page, width: int) -> None:
    """The lines of an item: comments, tags, declaration."""
    for tag in _tags(item.tokens):
        _comments(tag[0].before, page)
        _declaration(prepare(_bare(tag)), "tag", page, width)
    body = item.tokens[sum(map(len, _tags(item.tokens))) :]
    _comments(body[0].before, page)
    _declaration(prepare(_bare(body)), item.rule, page, width)


def _bare(tokens: Sequence[Token]) -> tuple[Token, ...]:
    """The tokens without the comments above the first one, which have lines of their own."""
    return (replace(tokens[0], before=()), *tokens[1:])


def _tags(tokens: Sequence[Token]) -> list[Sequence[Token]]:
    """The tags in front of a declaration, `@name` or `@name(…)` each."""
    found: list[Sequence[Token]] = []
    start = 0
    while tokens[start].text == "@":
        end = start + 2
        depth = 0
        while end < len(tokens) and (depth or tokens[end].text == "("):
            depth += (tokens[end].text in ("(", "[", "{")) - (tokens[end].text in (")", "]", "}"))
            end += 1
        found.append(tokens[start:end])
        start = end
    return found


def _declaration(text: Text, rule: str, page: _Page, width: int) -> None:
    apart, last = text.tokens[0].apart, text.tokens[-1]
    bare = Text((*text.tokens[:-1], replace(last, after=None)), text.partner, text.roles)
    parts = _document(bare, rule)
    lines = render(parts, width=width)
    if len(lines) == 1 and is_plain(parts):
        head = _head(bare, rule)
        comment = last.after.text if last.after else ""
        page.add(lines[0], apart=apart, kind=rule, head=head, comment=comment)
        return
    if last.after is not None:
        lines[-1] += f"  {last.after.text}"
    for number, line in enumerate(lines):
        page.add(line, apart=apart and number == 0, kind="part")


def _document(text: Text, rule: str) -> tuple[Doc, ...]:
    """A declaration: its head, and behind `=` or `:` what breaks into lines of its own."""
    count = len(text.tokens)
    start = _body(text, rule)
    if start >= count:
        return (Group(expression(text, 0, count)),)
    head, body = words(text, 0, start), expression(text, start, count)
    if hangs(text, start, count):
        return (*head, BLANK, *body)
    return (Group((*head, Nest((LINE, Group(body))))),)


def _body(text: Text, rule: str) -> int:
    """Index of the first token behind the `=` or `:` of a declaration."""
    sign = "=" if rule in _DEFINED else ":" if rule in _REQUIRED else ""
    index = 0
    while index < len(text.tokens) and sign:
        if text.tokens[index].text == sign:
            return index + 1
        index = text.partner[index] + 1 if index in text.roles else index + 1
    return len(text.tokens)


def _head(text: Text, rule: str) -> int:
    """How many columns of the line belong to its first column; 0 where it has none."""
    if rule == "signal_decl":
        count = 1 if text.tokens[0].kind == "ROLE" else 0
    elif rule in _OWN_COLUMN:
        count = _OWN_COLUMN[rule]
    elif rule in _DEFINED:
        count = _body(text, rule) - 1
    else:
        count = _body(text, rule) if rule in _REQUIRED else 0
    return sum(len(text.tokens[i].text) + (len(gap(text, i)) if i else 0) for i in range(count))


# ------------------------------------------------------------------------ parentheses


def _with_parentheses(item: Item, spans: Sequence[tuple[int, int]]) -> Item:
    """The item with parentheses around the parts at these offsets, which other tools read differently."""
    tokens = list(item.tokens)
    for start, end in spans:
        first = next(i for i, token in enumerate(tokens) if token.start >= start)
        last = max(i for i, token in enumerate(tokens) if token.end <= end)
        opening = Token("LPAR", "(", start, start, before=tokens[first].before)
        closing = Token("RPAR", ")", end, end, after=tokens[last].after)
        tokens[first] = replace(tokens[first], before=())
        tokens[last] = replace(tokens[last], after=None)
        tokens[first : last + 1] = [opening, *tokens[first : last + 1], closing]
    return Item(item.rule, tuple(tokens))
