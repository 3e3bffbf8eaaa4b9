"""Formatter of specifications: canonical blanks, line breaks and spellings; the meaning is unchanged.

    comments     keep their place: above a line, at its end, or between the parts of a long formula
    empty lines  are kept, at most one in a row, so groups of declarations are kept
    spellings    aliases such as `G`, `&&`, `=>` become the words of the language, tags get their own lines
    columns      names, formulas and comments are aligned within a group
    parentheses  are added where other tools would parse a formula differently (W301)

Invariants: formatting is idempotent, and preserves the syntax tree.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from stlc.diagnostics import SpecError
from stlc.grammar.ambiguity import Ambiguity, ambiguities
from stlc.grammar.errors.unicode import plain_text
from stlc.grammar.format.layout import (
    BLANK,
    LINE,
    SOFT,
    AlignedColumn,
    Doc,
    Group,
    Nest,
    Word,
    align,
    is_plain,
    render,
)
from stlc.grammar.format.tokens import Text, behind, gap, prepare
from stlc.grammar.spec import Spec
from stlc.grammar.tokens import Comment, Item, Token, TokenLayout, tokenize
from stlc.source import Source

# Operators at which an expression may break, loosest first; those of one row break together.
_ROWS = (
    frozenset({"IFF"}),
    frozenset({"IMPLIES"}),
    frozenset({"OR"}),
    frozenset({"AND"}),
    frozenset({"BINARY", "BINARY_AT", "BINARY_BRACKET"}),
)
_WITHIN = (frozenset({"CMP", "_IN", "_NOT_IN"}), frozenset({"PLUS", "MINUS"}), frozenset({"MULOP"}))
_UNARY = ("UNARY", "UNARY_AT", "UNARY_BRACKET")
_PREFIX = frozenset({*_UNARY, "_NOT", "QUANTIFIER", "_FREEZE", "_IF"})


def expression(text: Text, start: int, end: int) -> tuple[Doc, ...]:
    """Return the layout elements (words, possible line breaks) of an expression.

    The expression consists of the tokens with indices from `start` to `end` (exclusive).
    """
    for row in _ROWS:
        splits = _splits(text, start, end, row)
        if splits:
            return (_infix(text, start, end, splits),)
    if start < end and text.tokens[start].kind in _PREFIX:
        return _prefix(text, start, end)
    for row in _WITHIN:
        splits = _splits(text, start, end, row)
        if splits:
            return (_infix(text, start, end, splits),)
    return _sequence(text, start, end)


def words(text: Text, start: int, end: int) -> tuple[Doc, ...]:
    """Return the layout elements of the tokens from `start` to `end`, without a possible line break."""
    parts: list[Doc] = []
    for index in range(start, end):
        if index > start and gap(text, index):
            parts.append(BLANK)
        parts.append(_word(text, index))
    return tuple(parts)


def hangs(text: Text, start: int, end: int) -> bool:
    """True if the body of a declaration may begin on the line of the `=` and continue below it.

    This is the case if the body, the tokens from `start` to `end`, is a single pair of brackets with its
    contents. A name may stand before the bracket, as in `circle(…)`.
    """
    last = end - 1
    opening = text.partner.get(last, last)
    return start <= opening < last and all(
        text.tokens[i].kind in ("NAME", "DOT") for i in range(start, opening)
    )


def _word(text: Text, index: int) -> Word:
    token = text.tokens[index]
    return Word(token.text, token.before, token.after)


def _splits(text: Text, start: int, end: int, row: frozenset[str]) -> list[int]:
    """Return the indices of the operators whose kind is in `row`.

    Only the tokens from `start` to `end` are searched. Operators within brackets or within `if … else` are
    left out.
    """
    found: list[int] = []
    index, conditions = start, 0
    while index < end:
        kind = text.tokens[index].kind
        conditions += (kind == "_IF") - (kind == "_ELSE")
        if not conditions and kind in row and index > start and not text.is_sign(index):
            found.append(index)
        index = behind(text, index)
    return found


def _infix(text: Text, start: int, end: int, splits: Sequence[int]) -> Group:
    """Return a group of operands with a possible line break before each operator.

    The tokens are those from `start` to `end`; `splits` are the indices of the operators.
    """
    parts = [*expression(text, start, splits[0])]
    for at, following in zip(splits, [*splits[1:], end], strict=True):
        operand = at + 1
        parts += [LINE, _word(text, at)]
        if text.roles.get(operand) == "interval":
            operand = text.partner[operand] + 1
            parts += words(text, at + 1, operand)
        parts += [BLANK, *expression(text, operand, following)]
    return Group(tuple(parts))


def _prefix(text: Text, start: int, end: int) -> tuple[Doc, ...]:
    """Return the layout elements of the tokens from `start` to `end`: a prefix operator and its operand.

    Examples of a prefix operator are `not` and `always[a, b]`.
    """
    kind = text.tokens[start].kind
    if kind == "_IF":
        return (_condition(text, start, end),)
    body = behind(text, start)
    if text.roles.get(body) == "interval":
        body = text.partner[body] + 1
    return (*words(text, start, body), BLANK, *expression(text, body, end))


def _condition(text: Text, start: int, end: int) -> Group:
    """Return the group of `if … then … else …`, the tokens from `start` to `end`.

    If the group is too long for a line, each branch gets its own line.
    """
    marks: list[int] = []
    index, depth = start, 0
    while index < end and depth >= 0:
        kind = text.tokens[index].kind
        depth += (kind == "_IF") - (kind == "_ELSE")
        if (kind == "_THEN" and depth == 1) or (kind == "_ELSE" and depth == 0):
            marks.append(index)
        if len(marks) == 2:
            break
        index = behind(text, index)
    then, other = marks
    return Group(
        (
            *(_word(text, start), BLANK, *expression(text, start + 1, then)),
            *(LINE, _word(text, then), BLANK, *expression(text, then + 1, other)),
            *(LINE, _word(text, other), BLANK, *expression(text, other + 1, end)),
        )
    )


def _sequence(text: Text, start: int, end: int) -> tuple[Doc, ...]:
    """Return the layout elements of the tokens from `start` to `end`.

    Only brackets among them can be broken into lines.
    """
    parts: list[Doc] = []
    index = start
    while index < end:
        if index > start and gap(text, index):
            parts.append(BLANK)
        following = behind(text, index)
        if following > index + 1:
            parts.append(_bracket(text, index))
        else:
            parts.append(_word(text, index))
        index = following
    return tuple(parts)


def _bracket(text: Text, opening: int) -> Group:
    """Return the group of the bracket that begins at the index `opening`.

    If the bracket does not fit on a line, each entry gets its own line.
    """
    closing = text.partner[opening]
    edge = LINE if text.roles[opening] == "enum" else SOFT
    inside: list[Doc] = [edge]
    start = opening + 1
    while start < closing:
        comma = start
        while comma < closing and text.tokens[comma].text != ",":
            comma = behind(text, comma)
        if comma - start > 2 and text.tokens[start].kind == "NAME" and text.tokens[start + 1].text == "=":
            inside += (*words(text, start, start + 2), BLANK)
            start += 2
        inside += expression(text, start, comma)
        if comma < closing:
            inside += [_word(text, comma), LINE]
        start = comma + 1
    if len(inside) == 1:
        return Group((_word(text, opening), _word(text, closing)))
    return Group((_word(text, opening), Nest(tuple(inside)), edge, _word(text, closing)))


_OWN_COLUMN = {"const_decl": 2, "param_in": 2, "param_from": 2}
_DEFINED = frozenset({"def_decl", "region_decl", "const_decl"})
_REQUIRED = frozenset({"require_decl", "assume_decl"})


@dataclass(slots=True)
class _Page:
    """Lines of the formatted text under construction, before adjacent lines are aligned."""

    columns: list[AlignedColumn] = field(default_factory=list)

    def add(self, text: str, *, apart: bool = False, **more: object) -> None:
        first = not self.columns
        self.columns.append(AlignedColumn(text, apart=apart and not first, **more))  # type: ignore[arg-type]


def lay_out(layout: TokenLayout, unclear: Sequence[Ambiguity], *, width: int) -> str:
    """Return the formatted text of a specification, in lines of at most `width` characters where possible.

    The parts in `unclear`, which other tools parse differently, get parentheses.
    """
    page = _Page()
    spans = sorted((part.span.start, part.span.end) for part in unclear)
    for item in layout.items:
        first = bisect_left(spans, (item.tokens[0].start, 0))
        last = bisect_left(spans, (item.tokens[-1].end, 0))
        tokens = _with_parentheses(item, spans[first:last]).tokens
        tags = _tags(tokens)
        body = tokens[sum(map(len, tags)) :]
        for part, kind in (*((tag, "tag") for tag in tags), (body, item.rule)):
            _comments(part[0].before, page)
            _declaration(prepare((replace(part[0], before=()), *part[1:])), kind, page, width)
    _comments(layout.rest, page)
    lines = align(page.columns)
    return "".join(f"{line}\n" for line in lines)


def _comments(comments: Sequence[Comment], page: _Page) -> None:
    for comment in comments:
        page.add(comment.text, apart=comment.apart, kind="comment")


def _tags(tokens: Sequence[Token]) -> list[Sequence[Token]]:
    """Return the tokens of each tag, `@name` or `@name(…)`, before a declaration."""
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
    """Return the layout elements of a declaration; `rule` is its grammar rule.

    The part up to `=` or `:` stays on one line; the body after it may be broken into lines.
    """
    count = len(text.tokens)
    start = _body(text, rule)
    if start >= count:
        return (Group(expression(text, 0, count)),)
    head, body = words(text, 0, start), expression(text, start, count)
    if hangs(text, start, count):
        return (*head, BLANK, *body)
    return (Group((*head, Nest((LINE, Group(body))))),)


def _body(text: Text, rule: str) -> int:
    """Return the index of the first token after the `=` or `:` of a declaration.

    `rule` is the grammar rule of the declaration. If the declaration has no such sign, the number of tokens
    is returned.
    """
    sign = "=" if rule in _DEFINED else ":" if rule in _REQUIRED else ""
    index = 0
    while index < len(text.tokens) and sign:
        if text.tokens[index].text == sign:
            return index + 1
        index = text.partner[index] + 1 if index in text.roles else index + 1
    return len(text.tokens)


def _head(text: Text, rule: str) -> int:
    """Return the width of the first part of a declaration, such as `def NAME`, in characters.

    In adjacent declarations of one kind, the text after this part begins in the same column. `rule` is the
    grammar rule of the declaration. The width is 0 for a kind of declaration that is not aligned in this way.
    """
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
    """Return an item with parentheses around its parts at `spans`, (start, end) offsets in the text."""
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


WIDTH = 100


def format_text(source: Source) -> str:
    """Return the formatted text of a specification, ending with a line break.

    If the text does not parse, it is parsed again with symbols such as `□`, `≤`, `∧` spelled in the language.

    Raises:
        SpecError: the text does not parse either way.
    """
    source, spec = _read(source)
    formatted = lay_out(tokenize(source), tuple(ambiguities(spec)), width=WIDTH)
    again = Spec.parse(Source(source.name, formatted))
    if again != spec:
        raise AssertionError(f"the layout of {source.name} would change its meaning")
    return formatted


def _read(source: Source) -> tuple[Source, Spec]:
    """Parse a source; return the source that was parsed, and its syntax tree.

    If the given source does not parse, symbols such as `≤` are replaced, and the result is parsed instead.

    Raises:
        SpecError: neither text parses; the errors are those of the given text.
    """
    try:
        return source, Spec.parse(source)
    except SpecError as error:
        plain = Source(source.name, plain_text(source.text))
        if plain.text == source.text:
            raise
        try:
            return plain, Spec.parse(plain)
        except SpecError:
            raise error from None
