from __future__ import annotations

import pytest

from stlc.editor.completion import complete
from stlc.editor.document import Systems, analyse
from stlc.source import Source

HEAD = "enum Mode { off = 0, on = 1 }\nsignal x [m] in [0, 9]\nsignal m : Mode\nconst c = 2 m\n"


def offers(write, text: str) -> list[str]:
    return [offer.text for offer in complete(*write(HEAD + text)).offers]


def test_names_first_then_words(write):
    found = offers(write, "require r: │")
    assert found[:5] == ["c", "m", "off", "on", "x"]
    assert found.index("x") < found.index("T") < found.index("always") < found.index("abs")
    assert "until" not in found


def test_after_an_operand_only_operators(write):
    found = offers(write, "require r: x > c │")
    assert {"and", "or", "until", "since", "require"} <= {*found}
    assert "x" not in found
    assert "abs" not in found


def test_what_is_written_already_is_replaced(write):
    document, offset = write(HEAD + "require r: x > 1 m and al│ways")
    found = complete(document, offset)
    assert document.source.text[found.start : offset] == "al"
    assert "always" in [offer.text for offer in found.offers]


def test_a_bound_is_a_time(write):
    assert {"T", "end", "dt", "inf", "c"} <= {*offers(write, "require r: always[0, │")}


@pytest.mark.parametrize("text", ["signal y [│", "signal y [m│", "const d [m/│"])
def test_units_in_brackets(write, text):
    assert {"m/s^2", "deg", "kg"} <= {*offers(write, text)}
    assert "always" not in offers(write, text)


def test_an_index_is_no_unit(write):
    assert "x" in offers(write, "require r: x[│")


def test_units_after_a_number(write):
    assert {"s", "steps", "m"} <= {*offers(write, "require r: always[0, 3 │")}


def test_the_unit_of_the_file(write):
    assert offers(write, "time │") == ["h", "min", "ms", "ns", "s", "steps", "us"]


def test_tags(write):
    of_requirements = ["@group", "@id", "@liveness", "@product", "@safety", "@scale", "@weight"]
    assert offers(write, "@│") == sorted(["@angle", "@hold", "@linear", *of_requirements])
    assert "@safety" in offers(write, "@sa│")


def test_types(write):
    assert offers(write, "signal y : │") == ["Mode", "bool", "formula", "int", "real"]


def test_a_name_of_ones_own_is_not_guessed(write):
    assert offers(write, "const │") == []


def test_states_that_the_system_has(traffic):
    text = traffic.source.text.replace("state signal dx [m] in [-1, 10]", "state signal ")
    offset = text.index("state signal ", text.index("tau [s]")) + len("state signal ")
    document = analyse(Source(traffic.source.name, text), Systems())
    assert [offer.text for offer in complete(document, offset).offers] == ["dx [m]"]


def test_arguments_come_first(write):
    assert offers(write, "def f(p, d) = p > │ 0")[:2] == ["d", "p"]


def test_names_that_need_backticks_have_them(write):
    assert "`F`" in offers(write, "signal `F`\nrequire r: │")


@pytest.mark.parametrize("text", ["# x │", "signal z  // a │", 'system "│', 'signal a from "b # │'])
def test_nothing_in_comments_and_texts(write, text):
    assert offers(write, text) == []


def test_a_hash_in_a_text_is_no_comment(write):
    assert "require" in offers(write, 'signal a from "b#c" │')


def test_where_the_text_cannot_be_read_everything_is_offered(write):
    assert {"x", "always", "abs"} <= {*offers(write, "require r: x > ) and │")}


def test_details(write):
    document, offset = write(HEAD + "require r: │")
    by_name = {offer.text: offer for offer in complete(document, offset).offers}
    assert by_name["x"].detail == "state real [m], 0 to 9 m (nominal)"
    assert "ahead" in by_name["always"].doc
    assert by_name["m"].detail == "state enum: off = 0, on = 1"
