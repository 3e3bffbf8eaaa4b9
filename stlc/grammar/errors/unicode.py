# ruff: noqa: RUF001 - this module lists such characters
"""Replacements for mathematical and typographic characters, such as `□`, `≤` and curved quotes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from stlc.grammar.scan import Lexeme, lexemes


@dataclass(frozen=True, slots=True)
class Replacement:
    """Advice about a character that is not in the language, such as `≤`.

    `text` is the spelling of this character in the language, here `<=`. It is None if there is no unique
    spelling. `help` is the advice in words.
    """

    help: str
    text: str | None = None


_SPELLED = {
    "always": "□◻☐▢",
    "eventually": "◇◊♢⋄",
    "until": "𝒰𝓤",
    "and": "∧⋀",
    "or": "∨⋁",
    "not": "¬",
    "xor": "⊕",
    "->": "→⇒⟶⟹⊃",
    "<->": "↔⇔⟷⟺≡",
    "<=": "≤⩽≦",
    ">=": "≥⩾≧",
    "!=": "≠",
    "in": "∈",
    "not in": "∉",
    "forall": "∀",
    "exists": "∃",
    "true": "⊤",
    "false": "⊥",
    "inf": "∞",
    "*": "×·⋅∙",
    "/": "÷",
    "-": "−–—",
    "^2": "²",
    "^3": "³",
    "sqrt": "√",
    '"': "“”„",
}
_ADVICE: Mapping[str, Replacement] = MappingProxyType(
    {
        **{char: Replacement(f"write `{text}`", text) for text, chars in _SPELLED.items() for char in chars},
        **dict.fromkeys("'‘’", Replacement('texts stand in double quotes: "…"')),
        "?": Replacement("write `if … then … else …`"),
        **dict.fromkeys("‖∥", Replacement("write `norm(…)`")),
        "∪": Replacement("write `union(a, b)`"),
        "∩": Replacement("write `intersect(a, b)`"),
    }
)
_OF_THE_LANGUAGE = frozenset("()[]{}.,:;=<>!&|+-*/%^~@#")


def replacement(char: str) -> Replacement | None:
    """Return the advice about a character that is not in the language; None if there is none."""
    return _ADVICE.get(char)


def unexpected_character(lexeme: Lexeme) -> bool:
    """True if no token of the language begins with the first character of a lexeme."""
    if lexeme.kind == "sign":
        return lexeme.text[0] not in _OF_THE_LANGUAGE
    return lexeme.text[0] in _ADVICE and lexeme.kind == "word"


def apart(word: str, text: str, at: int) -> str:
    """Return `word`, with blanks around it if needed, as a replacement of one character of `text`.

    `at` is the offset of this character. A blank is added on a side where `word` would otherwise join a
    letter or digit.
    """
    before = " " if word[0].isalpha() and at and text[at - 1].isalnum() else ""
    behind = " " if word[-1].isalpha() and text[at + 1 : at + 2].isalnum() else ""
    return f"{before}{word}{behind}"


def plain_text(text: str) -> str:
    """Return the text with symbols such as `□`, `≤`, `∧` spelled in the language.

    Symbols in comments, strings and quoted names are kept.
    """
    parts: list[str] = []
    done = 0
    for lexeme in lexemes(text):
        advice = replacement(lexeme.text[0]) if unexpected_character(lexeme) else None
        if advice is None or advice.text is None:
            continue
        parts += [text[done : lexeme.start], apart(advice.text, text, lexeme.start)]
        done = lexeme.start + 1
    return "".join([*parts, text[done:]])
