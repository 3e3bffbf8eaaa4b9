"""Tokens -> a document: where an expression may break, loosest operator first.

What does not fit into its line breaks before the operators of one rank, or within a bracket, an entry a line.
"""

from __future__ import annotations

from collections.abc import Sequence

from stlc.grammar.format.layout import BLANK, LINE, SOFT, Doc, Group, Nest, Word
from stlc.grammar.format.tokens import Text, behind, gap

# Operators that an expression breaks at, loosest first; those of one row break together.
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
    """The tokens from `start` to `end` as an expression."""
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
    """The tokens from `start` to `end` on one line."""
    parts: list[Doc] = []
    for index in range(start, end):
        if index > start and gap(text, index):
            parts.append(BLANK)
        parts.append(_word(text, index))
    return tuple(parts)


def hangs(text: Text, start: int, end: int) -> bool:
    """Whether the tokens are one bracket, perhaps with a name before it, that can stay behind a `=`."""
    last = end - 1
    opening = text.partner.get(last, last)
    return start <= opening < last and all(
        text.tokens[i].kind in ("NAME", "DOT") for i in range(start, opening)
    )


def _word(text: Text, index: int) -> Word:
    token = text.tokens[index]
    return Word(token.text, token.before, token.after)


def _splits(text: Text, start: int, end: int, row: frozenset[str]) -> list[int]:
    """Where the operators of a row stand that are not within brackets or between `if` and `else`."""
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
    """Operands with a line break before each operator."""
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
    """A word that governs what follows it."""
    kind = text.tokens[start].kind
    if kind == "_IF":
        return (_condition(text, start, end),)
    body = behind(text, start)
    if text.roles.get(body) == "interval":
        body = text.partner[body] + 1
    return (*words(text, start, body), BLANK, *expression(text, body, end))


def _condition(text: Text, start: int, end: int) -> Group:
    """`if … then … else …`, the last two in lines of their own where all does not fit."""
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
    """Tokens one behind the other; what a bracket holds may break."""
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
    """What stands between two brackets, one entry a line where it does not fit."""
    closing = text.partner[opening]
    edge = LINE if text.roles[opening] == "enum" else SOFT
    inside: list[Doc] = [edge]
    start = opening + 1
    while start < closing:
        comma = _comma(text, start, closing)
        inside += _entry(text, start, comma)
        if comma < closing:
            inside += [_word(text, comma), LINE]
        start = comma + 1
    if len(inside) == 1:
        return Group((_word(text, opening), _word(text, closing)))
    return Group((_word(text, opening), Nest(tuple(inside)), edge, _word(text, closing)))


def _comma(text: Text, start: int, end: int) -> int:
    """Index of the next comma, or `end`."""
    index = start
    while index < end and text.tokens[index].text != ",":
        index = behind(text, index)
    return index


def _entry(text: Text, start: int, end: int) -> tuple[Doc, ...]:
    """An expression, a named argument or a formal one."""
    if end - start > 2 and text.tokens[start].kind == "NAME" and text.tokens[start + 1].text == "=":
        return (*words(text, start, start + 2), BLANK, *expression(text, start + 2, end))
    return expression(text, start, end)
