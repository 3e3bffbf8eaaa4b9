"""Texts of papers and word processors in the characters of the language."""

from __future__ import annotations

from stlc.grammar.errors.unicode import replacement, unexpected_character
from stlc.grammar.scan import lexemes


def plain_text(text: str) -> str:
    """The text with `□`, `≤`, `∧` and their like spelled out; comments and names in quotes stay."""
    parts: list[str] = []
    done = 0
    for lexeme in lexemes(text):
        advice = replacement(lexeme.text[0]) if unexpected_character(lexeme) else None
        if advice is None or advice.text is None:
            continue
        behind = text[lexeme.start + 1 : lexeme.start + 2]
        word = advice.text
        if word[0].isalpha() and lexeme.start and text[lexeme.start - 1].isalnum():
            word = f" {word}"
        if word[-1].isalpha() and behind.isalnum():
            word = f"{word} "
        parts += [text[done : lexeme.start], word]
        done = lexeme.start + 1
    return "".join([*parts, text[done:]])
