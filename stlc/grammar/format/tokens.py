"""Preparation of tokens for the formatter: canonical spelling, pairs of brackets, blanks between tokens.

Redundant tokens (a unary plus, doubled parentheses) are dropped unless a comment is attached to them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from stlc.diagnostics import SpecError
from stlc.grammar.fold import MAX_DEPTH
from stlc.grammar.tokens import Token
from stlc.grammar.words import OPERATORS, SPACE

Role: TypeAlias = Literal["interval", "call", "index", "group", "list", "enum"]

_WORD = re.compile(r"[A-Za-z]+")
_SPELLED = {"IFF": "<->", "IMPLIES": "->", "AND": "and", "_NOT": "not", "_NOT_IN": "not in"}
_OPENING = frozenset("([{")
_CLOSING = frozenset(")]}")
_OPERAND = frozenset({"NAME", "NUMBER", "UNIT", "STRING", "TYPE_SIZE", "_TRUE", "_FALSE", "_INF"})


@dataclass(frozen=True, slots=True)
class Text:
    """Tokens of a declaration as the formatter prints them.

    Attributes:
        tokens: tokens with canonical spelling.
        partner: index of an opening bracket -> index of its closing bracket, and vice versa.
        roles: index of an opening bracket -> use of the bracket, such as "call" or "interval".
    """

    tokens: tuple[Token, ...]
    partner: dict[int, int]
    roles: dict[int, Role]

    def ends_operand(self, index: int) -> bool:
        """True if an operand ends with the token at `index`.

        After such a token, `-` is a subtraction, and `(` begins the arguments of a call.
        """
        token = self.tokens[index]
        if token.text in _CLOSING:
            return self.roles[self.partner[index]] != "interval"
        return token.kind in _OPERAND

    def is_sign(self, index: int) -> bool:
        """True if the token at `index` is a unary `-` or `+`."""
        return self.tokens[index].kind in ("PLUS", "MINUS") and not (index and self.ends_operand(index - 1))


def prepare(tokens: Sequence[Token]) -> Text:
    """Return the tokens of a declaration (without its tags) as the formatter prints them.

    Spelling is normalised, brackets are paired, redundant tokens are dropped.

    Raises:
        SpecError: E005, brackets are nested too deeply.
    """
    text = _paired(tuple(map(_spelled, tokens)))
    signs = {i for i, token in enumerate(text.tokens) if token.kind == "PLUS" and text.is_sign(i)}
    text = _without(text, signs)
    text = _without(text, _doubled(text))
    depth = 0
    for token in text.tokens:
        depth += (token.text in _OPENING) - (token.text in _CLOSING)
        if depth > MAX_DEPTH:
            raise SpecError.of("E005", f"brackets are nested more than {MAX_DEPTH} deep")
    return _with_commas(text)


def spelling(kind: str, text: str) -> str:
    """Return the canonical spelling of a token: `always` for `G`, `and` for `&&`.

    `kind` is the kind of token (its terminal in the grammar), and `text` is the spelling in the source.
    """
    if kind.startswith(("UNARY", "BINARY")):
        match = _WORD.match(text)
        assert match is not None
        return OPERATORS[match[0]].name + ("@" if kind.endswith("_AT") else "")
    if kind == "OR":
        return "xor" if text == "xor" else "or"
    if kind in ("UNIT_BRACKET", "TYPE_SIZE"):
        return re.sub(SPACE, "", text)
    return _SPELLED.get(kind, text)


def gap(text: Text, index: int) -> str:
    """Return the text between the token at `index` and the token before it: a blank or ""."""
    left, right = text.tokens[index - 1], text.tokens[index]
    if _hugs_right(text, index - 1) or _hugs_left(text, index):
        return ""
    if right.text in _OPENING:
        return "" if text.roles[index] in ("call", "index", "interval") else " "
    if not {left.text, right.text} & {".", "..", "^"}:
        return " "
    # a blank keeps tokens apart that would be read as others: `1 .x`, `m ^2`
    if right.text == "^":
        return " " if left.kind == "UNIT" else ""
    if left.kind == "NUMBER":
        return " " if right.text == "." or left.text.endswith(".") else ""
    return " " if right.kind == "NUMBER" and right.text.startswith(".") else ""


def _hugs_right(text: Text, index: int) -> bool:
    """True if no blank follows the token at `index`."""
    token = text.tokens[index]
    if token.text in _OPENING:
        return text.roles[index] != "enum"
    return token.text == "@" or text.is_sign(index)


def _hugs_left(text: Text, index: int) -> bool:
    """True if no blank precedes the token at `index`."""
    token = text.tokens[index]
    if token.text in _CLOSING:
        return text.roles[text.partner[index]] != "enum"
    if token.text != ":":
        return token.text == "," or token.kind == "TYPE_SIZE"
    # a blank precedes the colon of a type, as in `signal x : Type`
    declared = any(token.kind in ("_SIGNAL", "_CONST", "_PARAM") for token in text.tokens[:2])
    return not declared or any(token.text == "=" for token in text.tokens[:index])


# --------------------------------------------------------------------------- brackets


def _spelled(token: Token) -> Token:
    text = spelling(token.kind, token.text)
    return token if text == token.text else replace(token, text=text)


def _paired(tokens: tuple[Token, ...]) -> Text:
    text = Text(tokens, {}, {})
    still_open: list[int] = []
    for index, token in enumerate(tokens):
        if token.text in _OPENING and token.kind != "UNIT_BRACKET":
            text.roles[index] = _role(text, index)
            still_open.append(index)
        elif token.text in _CLOSING:
            opening = still_open.pop()
            text.partner[opening], text.partner[index] = index, opening
            # an interval follows a temporal operator, and contains a comma or is closed by `]`
            temporal = opening > 0 and tokens[opening - 1].kind in ("UNARY", "BINARY")
            if temporal and text.roles[opening] == "group":
                several = any(tokens[i].text == "," for i in level(text, opening))
                text.roles[opening] = "interval" if several or token.text == "]" else "group"
    return text


def _role(text: Text, index: int) -> Role:
    """Return the use of the bracket that opens at `index`, such as "call", judged by the tokens before it."""
    token = text.tokens[index]
    before = text.tokens[index - 1] if index else None
    if before is not None and before.kind.endswith(("_AT", "_BRACKET")):
        return "interval"
    if token.text == "{":
        return "enum" if text.tokens[0].kind == "_ENUM" else "list"
    if index and text.ends_operand(index - 1):
        return "call" if token.text == "(" else "index"
    if token.text == "(" and before is not None and before.text == "]":
        opening = text.partner[index - 1]
        if opening and text.tokens[opening - 1].kind == "EXTREME_BRACKET":
            return "call"
    return "group" if token.text == "(" else "list"


def level(text: Text, opening: int) -> list[int]:
    """Return the indices of the tokens directly within the bracket that begins at the index `opening`.

    An inner bracket is represented by its opening token only. A head such as `forall i in …:` is represented
    by its first token only.
    """
    found: list[int] = []
    index = opening + 1
    while index < text.partner[opening]:
        found.append(index)
        index = behind(text, index)
    return found


def behind(text: Text, index: int) -> int:
    """Return the index of the next token after the one at `index`.

    A bracket with its content counts as one token, and so does a head such as `forall i in …:`.
    """
    if index in text.roles:
        return text.partner[index] + 1
    last = {"QUANTIFIER": "COLON", "_FREEZE": "_IN"}.get(text.tokens[index].kind, "")
    index += 1
    while last and text.tokens[index - 1].kind != last:
        index = text.partner[index] + 1 if index in text.roles else index + 1
    return index


def _doubled(text: Text) -> set[int]:
    """Return the indices of redundant parentheses: the outer pair in `((p))`.

    Parentheses with a comment are left out.
    """
    found: set[int] = set()
    for opening, role in text.roles.items():
        inner = opening + 1
        twin = text.roles.get(inner) == "group" and text.partner[inner] == text.partner[opening] - 1
        pair = {opening, text.partner[opening]}
        if role == "group" and twin and not any(map(_commented, (text.tokens[i] for i in pair))):
            found |= pair
    return found


def _commented(token: Token) -> bool:
    return bool(token.before) or token.after is not None


def _without(text: Text, dropped: set[int]) -> Text:
    """Return the text without the tokens at the indices `dropped`; a token with a comment is kept."""
    kept = tuple(t for i, t in enumerate(text.tokens) if i not in dropped or _commented(t))
    return _paired(kept) if len(kept) < len(text.tokens) else text


def _with_commas(text: Text) -> Text:
    """Return the text with commas in intervals: `[0:5]` becomes `[0, 5]`."""
    tokens = list(text.tokens)
    for opening, role in text.roles.items():
        if role == "interval":
            for index in level(text, opening):
                if tokens[index].text == ":":
                    tokens[index] = replace(tokens[index], text=",", kind="COMMA")
    return Text(tuple(tokens), text.partner, text.roles)
