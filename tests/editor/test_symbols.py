from __future__ import annotations

import pytest

from stlc.editor.symbols import inside, names_of
from stlc.grammar.spec import Spec
from stlc.source import Source, Span


def table(text: str) -> list[str]:
    """`use -> declaration` by line and column, in the order of the text."""
    source = Source("t.stl", text)
    uses = [one for one in names_of(Spec.parse(source)).occurrences if not one.declares]
    return [f"{one.span.text} {place(one.span)} -> {place(one.symbol.span)}" for one in uses]


def place(span: Span) -> str:
    return f"{span.line}:{span.column}"


def test_values():
    assert table("signal x [m]\nconst c = 1 m\nrequire r: x > c") == ["x 3:12 -> 1:8", "c 3:16 -> 2:7"]


def test_a_requirement_and_a_signal_may_share_a_name():
    assert table("signal x\nrequire x: x > 0") == ["x 2:12 -> 1:8"]


def test_arguments_hide_signals():
    text = "signal x\ndef near(x, d) = x < d\nrequire r: near(x, d = 2)"
    assert table(text) == [
        "x 2:18 -> 2:10",
        "d 2:22 -> 2:13",
        "near 3:12 -> 2:5",
        "x 3:17 -> 1:8",
        "d 3:20 -> 2:13",
    ]


def test_quantifiers_bind_in_their_body_only():
    text = "const i = 2\nsignal q : real[3]\nrequire r: forall i in 0..i: q[i] > 0"
    assert table(text) == ["i 3:27 -> 1:7", "q 3:30 -> 2:8", "i 3:32 -> 3:19"]


def test_freeze_binds_several():
    text = "signal x, y\nrequire r: freeze a = (x), b = y in always[0 s, 1 s] a + b > x"
    assert table(text)[2:] == ["a 2:54 -> 2:19", "b 2:58 -> 2:28", "x 2:62 -> 1:8"]


def test_enums_and_their_members():
    text = "enum Mode { off, on = 3 }\nsignal m : Mode\nrequire r: m == on"
    assert table(text) == ["Mode 2:12 -> 1:6", "m 3:12 -> 2:8", "on 3:17 -> 1:18"]


def test_backticks():
    assert table("signal `F`\nrequire r: `F` > 0") == ["`F` 2:12 -> 1:8"]


def test_the_words_of_time_are_not_names():
    assert table("signal x\nrequire r: always[0, T] x > 0") == ["x 2:25 -> 1:8"]
    assert table("signal `T`\nrequire r: always[0, T] `T` > 0") == ["`T` 2:25 -> 1:8"]


def test_what_a_tag_calls_a_group_is_no_value():
    assert table("signal x\n@group(x)\nrequire r: true") == []
    assert table("const w = 2\n@weight(w)\nrequire r: true") == ["w 2:9 -> 1:7"]


def test_the_first_declaration_has_the_name():
    assert table("const a = 1\nconst a = 2\nrequire r: a > 0") == ["a 3:12 -> 1:7"]


@pytest.mark.parametrize(("place", "wanted"), [("d)", ["p", "d"]), ("x <", ["p", "d"]), ("require", [])])
def test_what_can_be_used_inside(place, wanted):
    text = "signal x\ndef f(p, d) = x < p + d\nrequire r: f(1, 2)"
    assert [symbol.name for symbol in inside(Spec.parse(Source("t", text)), text.index(place))] == wanted


def test_a_variable_inside_of_its_quantifier():
    text = "signal q : real[3]\nrequire r: forall i in 0..2: q[i] > 0"
    spec = Spec.parse(Source("t", text))
    assert [symbol.name for symbol in inside(spec, text.index("q[i]"))] == ["i"]


def test_what_a_cursor_touches():
    text = "signal x\nrequire r: x>0"
    names = names_of(Spec.parse(Source("t", text)))
    assert [names.at(offset) is not None for offset in (0, 7, 8, 20, 21, 22)] == [
        False,
        True,
        True,
        True,
        True,
        False,
    ]
