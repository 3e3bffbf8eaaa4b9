from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lsprotocol.types import Position
from pygls.workspace import PositionCodec

from stlc.editor.server import PositionMapper, mapper_of

UTF_16 = PositionCodec("utf-16")
TEXTS = st.text(alphabet="ab \t\r\né€😀\u2028", max_size=30)


def test_columns_count_what_the_editor_counts():
    text = "a😀b"
    places = [PositionMapper(text, PositionCodec(one)).place(2) for one in ("utf-8", "utf-16", "utf-32")]
    assert places == [Position(0, 5), Position(0, 3), Position(0, 2)]


@pytest.mark.parametrize("text", ["a\nb", "a\r\nb", "a\rb"])
def test_every_kind_of_line_break(text):
    assert PositionMapper(text, UTF_16).place(len(text) - 1) == Position(1, 0)


def test_a_separator_of_unicode_is_no_line_break():
    assert PositionMapper("a\u2028b", UTF_16).place(2) == Position(0, 2)


def test_beyond_the_end():
    layout = PositionMapper("ab\ncd", UTF_16)
    assert layout.offset(Position(0, 99)) == 2
    assert layout.offset(Position(9, 0)) == 5
    assert layout.place(5) == Position(1, 2)


def test_inside_of_a_character():
    assert PositionMapper("😀", UTF_16).offset(Position(0, 1)) == 0


@given(TEXTS, st.sampled_from(["utf-8", "utf-16", "utf-32"]))
def test_back_and_forth(text, encoding):
    layout = PositionMapper(text, PositionCodec(encoding))
    for offset in range(len(text) + 1):
        if text[offset - 1 : offset + 1] != "\r\n":  # no editor stands inside of a break
            assert layout.offset(layout.place(offset)) == offset


def test_the_lines_of_a_text_are_found_once():
    text = "signal x\n" * 3
    assert mapper_of(text, UTF_16) is mapper_of(text, UTF_16)
    assert mapper_of("😀b", UTF_16).place(2) != mapper_of("😀b", PositionCodec("utf-8")).place(2)
