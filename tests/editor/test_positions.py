from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.editor.server import EditorPlace, Layout

TEXTS = st.text(alphabet="ab \t\r\né€😀\u2028", max_size=30)


def test_columns_count_what_the_editor_counts():
    text = "a😀b"
    assert [Layout(text, one).place(2) for one in ("utf-8", "utf-16", "utf-32")] == [(0, 5), (0, 3), (0, 2)]


@pytest.mark.parametrize("text", ["a\nb", "a\r\nb", "a\rb"])
def test_every_kind_of_line_break(text):
    assert Layout(text).place(len(text) - 1) == (1, 0)


def test_a_separator_of_unicode_is_no_line_break():
    assert Layout("a\u2028b").place(2) == (0, 2)


def test_beyond_the_end():
    layout = Layout("ab\ncd")
    assert layout.offset(EditorPlace(0, 99)) == 2
    assert layout.offset(EditorPlace(9, 0)) == 5
    assert layout.offset(EditorPlace(-1, 0)) == 0
    assert layout.end == (1, 2)


def test_inside_of_a_character():
    assert Layout("😀").offset(EditorPlace(0, 1)) == 0


@given(TEXTS, st.sampled_from(["utf-8", "utf-16", "utf-32"]))
def test_back_and_forth(text, encoding):
    layout = Layout(text, encoding)
    for offset in range(len(text) + 1):
        if text[offset - 1 : offset + 1] != "\r\n":  # no editor stands inside of a break
            assert layout.offset(layout.place(offset)) == offset
