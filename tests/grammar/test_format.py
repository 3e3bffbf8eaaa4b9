"""Formatting: the same tree, the same comments in the same order, and nothing left to change."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from strategies import specs

from stlc.diagnostics import SpecError
from stlc.files import read_source
from stlc.grammar.format import WIDTH, format_text
from stlc.grammar.parser import parse
from stlc.grammar.parser_tokens import tokenize
from stlc.grammar.printer import show
from stlc.source import Source

DATA = sorted((Path(__file__).parent / "data").glob("*.stl"))
ROOT = Path(__file__).resolve().parent.parent.parent


def formatted(text: str) -> str:
    return format_text(Source("text", text))


def tree(text: str):
    return parse(Source("text", text))


def comments(text: str) -> list[str]:
    """All comments of a text, in order."""
    layout = tokenize(Source("text", text))
    found = []
    for item in layout.items:
        for token in item.tokens:
            found += [*token.before, *([token.after] if token.after else [])]
    return [comment.text for comment in (*found, *layout.rest)]


# ---------------------------------------------------------------------- laws


def respaced(draw: st.DrawFn, text: str) -> str:
    """The text with other blanks, and with numbered comments, between its tokens."""
    tokens = [token for item in tokenize(Source("text", text)).items for token in item.tokens]
    parts, count = [], 0
    styles = st.sampled_from(
        ["", "", "", " ", "  ", "\n", "\n\n\n", " # ", "\n## ", " // ", "\n  # a\n\n  # ", "\t", " ;"]
    )
    for before, token in zip([None, *tokens], tokens, strict=False):
        glue = draw(styles)
        if ";" in glue and token.kind not in ("_CONST", "_DEF", "_REQUIRE", "_REGION"):
            glue = " "
        if "#" in glue or "/" in glue:
            count += 1
            glue += f"c{count} always[0, T\n"
        elif not glue.strip(";"):
            glue = text[before.end : token.start] if before else ""
        parts += [glue, text[token.start : token.end]]
    return "".join(parts) + draw(st.sampled_from(["", "\n", "  # end", "\n\n# end\n\n", ";\n# end"]))


@st.composite
def written(draw: st.DrawFn) -> str:
    text = respaced(draw, show(draw(specs)))
    try:
        tree(text)
    except SpecError:
        assume(False)
    return text


def hold(text: str) -> None:
    spec = tree(text)
    once = formatted(text)
    assert tree(once) == spec
    assert [item.doc for item in tree(once).items] == [item.doc for item in spec.items]
    assert comments(once) == comments(text)
    assert formatted(once) == once
    assert once == "" or once.endswith("\n")
    assert not re.search(r"[ \t]+$|\n\n\n|\A\n", once, re.MULTILINE)


@settings(max_examples=100)
@given(written())
def test_the_laws_hold_for_random_specifications(text):
    hold(text)
