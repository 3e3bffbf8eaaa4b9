"""Lexemes, brackets, and where declarations start."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.grammar.scan import Lexeme, brackets, declaration_starts

STARTERS = ("state", "env", "const", "def", "region", "enum", "extern", "spec", "system")
DATA = sorted((Path(__file__).parent / "data").glob("*.stl"))


def pieces(text: str) -> list[str]:
    starts = declaration_starts(text)
    return [text[a:b].strip() for a, b in zip(starts, [*starts[1:], len(text)], strict=True)]


@given(st.text())
def test_lexemes_cover_all_but_blanks_and_comments(text):
    found = list(Lexeme.scan(text))
    assert all(text[lexeme.start : lexeme.end] == lexeme.text for lexeme in found)
    assert all(a.end <= b.start for a, b in pairwise(found))
    if "#" not in text and "//" not in text:
        written = "".join(lexeme.text for lexeme in found)
        assert "".join(written.split()) == "".join(text.split())


@given(st.text('require signal env@[x] \n#"', max_size=60))
def test_pieces_make_up_the_text(text):
    starts = declaration_starts(text)
    assert starts[0] == 0
    assert starts == sorted(starts)


def test_a_piece_holds_its_tags_and_role():
    text = (
        'spec a\nsystem "s"\n@safety @id("signal") require r: x > 0\nenv signal x, y\nsignal state from "def"'
    )
    assert pieces(text) == [
        "",
        "spec a",
        'system "s"',
        '@safety @id("signal") require r: x > 0',
        "env signal x, y",
        'signal state from "def"',
    ]


def test_words_in_comments_texts_and_backticks_start_nothing():
    assert pieces('# require a\nconst a = "def" // signal\nrequire b: `const`')[1:] == [
        'const a = "def" // signal',
        "require b: `const`",
    ]


def test_names_that_are_pragmas_elsewhere_start_nothing():
    for line in ("time < 3", "time in {1}", "spec", "time from"):
        assert len(pieces(f"require a: x and\n{line}")) == 2
    assert len(pieces("require a: x\ntime s")) == 3
    assert len(pieces("require a: x and\n  time s")) == 2


@pytest.mark.parametrize("path", DATA, ids=lambda path: path.stem)
def test_every_declaration_of_the_benchmarks_is_a_piece(path):
    text = path.read_text(encoding="utf-8")
    starts = declaration_starts(text)
    lines = {text.count("\n", 0, start) for start in starts[1:]}
    declared = {
        number
        for number, line in enumerate(text.splitlines())
        if line.split(" ")[0]
        in ("state", "env", "const", "def", "region", "enum", "extern", "spec", "system")
    }
    assert declared <= lines


def test_an_interval_may_be_closed_by_either_bracket():
    found = brackets(list(Lexeme.scan("always(0, 1] (a] until@[0, 1) b")))
    assert [(b.opening.text, b.interval, b.closing and b.closing.text) for b in found] == [
        ("(", True, "]"),
        ("(", False, None),
        ("[", True, ")"),
    ]
