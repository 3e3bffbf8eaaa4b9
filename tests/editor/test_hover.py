from __future__ import annotations

import pytest

from stlc.compile.ir.functions import callable_names
from stlc.editor.hover import hover
from stlc.editor.vocabulary import BUILT_IN, FUNCTIONS, KEYWORDS, TEMPORAL
from stlc.grammar import words
from stlc.grammar.words import OPERATORS, RESERVED


def say(document, needle: str, inside: int = 0) -> str:
    found = hover(document, document.source.text.index(needle) + inside)
    return "" if found is None else found[1]


def test_a_signal(traffic):
    text = say(traffic, "v_lead")
    assert "env signal v_lead [m/s] in [0, 10]" in text
    assert "env real [m/s], 0 to 10 m/s (enforced)" in text
    assert "a state of `car.yaml`, line 24" in text


def test_a_nominal_range(traffic):
    assert "state real [m], -10 to 8 m (nominal)" in say(traffic, "x [m] in")


def test_a_constant_has_a_value(traffic):
    assert "= 4 s" in say(traffic, "T_red ")


def test_a_computed_constant(write):
    document, offset = write("const a = 2 m\nconst b│ = a * 3\n")
    assert "= 6 m" in hover(document, offset)[1]


@pytest.mark.parametrize(
    ("value", "shown"),
    [("20 degC + 5 K", "= 25 degC"), ("20 degC - 5 degC", "= 15 K"), ("2 * 20 degC", "= 586.3 K")],
)
def test_a_temperature_and_a_difference(write, value, shown):
    document, offset = write(f"const a│ = {value}\n")
    assert shown in hover(document, offset)[1]


def test_a_signal_in_degrees(write):
    document, offset = write("signal temp│ [degC] in [10, 300 K]\n")
    assert "real [degC], 10 to 26.85 degC" in hover(document, offset)[1]


def test_an_enum_and_its_member(traffic):
    assert "enum Sign { stop = 0, light = 1 }" in say(traffic, "Sign")
    assert "member of `Sign`, 1" in say(traffic, "light = 1")


def test_a_requirement_says_its_horizon_and_its_comment(traffic):
    text = say(traffic, "no_collision")
    assert "requirement @safety" in text
    assert "horizon 2.5 s = 25 steps" in text
    assert "never collide with the leading car" in text


@pytest.mark.parametrize("inside", [0, 3, 6, 8, 12])
def test_an_interval_in_seconds_and_steps(traffic, inside):
    assert "[0 s, 2.5 s] = samples 0..25" in say(traffic, "always[0, T] (dx", inside)


def test_the_horizon(traffic):
    assert "2.5 s = 25 steps" in say(traffic, "T] (dx")


def test_the_inner_of_two_intervals(write):
    document, offset = write("time s\nsignal x\nrequire r: always[0, 2] eventually│(0, 3 steps] x > 0")
    found, text = hover(document, offset)
    assert found.text == "eventually(0, 3 steps]"
    assert "eventually" in text


def test_steps_without_a_system(write):
    document, offset = write("signal x\nrequire r: always[1 steps, 3 steps]│ x > 0")
    assert "samples 1..3" in hover(document, offset)[1]


def test_without_an_interval(write):
    document, offset = write("signal x\nrequire r: alw│ays x > 0")
    assert "from now to the end of the trace" in hover(document, offset)[1]


def test_until(write):
    document, offset = write("signal x, y\nrequire r: x > 0 unt│il[0 steps, 4 steps] y > 0")
    _, text = hover(document, offset)
    assert TEMPORAL["until"] in text
    assert "samples 0..4" in text


def test_a_definition(write):
    text = (
        "signal x [m]\n## far enough\ndef far│(d) = x > d\ndef soon = eventually[0 steps, 5 steps] x > 1 m\n"
    )
    document, offset = write(text)
    assert "far enough" in hover(document, offset)[1]
    assert "def far(d) = x > d" in hover(document, offset)[1]
    assert "formula, looks 5 steps ahead" in say(document, "soon")
    assert "argument of `far`" in say(document, "d)")


def test_words_of_the_language(traffic):
    assert say(traffic, "safety") == "Part of phi_safe, which even an emergency plan keeps."
    assert say(traffic, "require ").startswith("`require NAME")
    assert say(traffic, "# offset") == ""


def test_an_unfinished_text_still_explains(write):
    document, offset = write("signal x│ [m]\nrequire r: x > \n")
    assert "state real [m]" in hover(document, offset)[1]


def test_every_word_has_a_sentence():
    plain = set(RESERVED) - OPERATORS.keys()
    trivial = {"and", "or", "iff", "implies", "then", "else", "true", "false"}
    assert plain - trivial <= KEYWORDS.keys()
    assert {each.name for each in OPERATORS.values()} == TEMPORAL.keys()
    assert {*callable_names()} <= FUNCTIONS.keys()
    assert words.BUILT_IN.keys() == BUILT_IN.keys()
