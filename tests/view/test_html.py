"""Markup: what is text stays text."""

from html import unescape

from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.escape import html as text_of
from stlc.view.html import Html, el, facts, figure, join, spec_html, table, yaml_html

HOSTILE = "<script>alert('1')</script> & \"quoted\""


def unmarked(html):
    """The text that a browser would show."""
    from html.parser import HTMLParser

    shown = []
    parser = HTMLParser(convert_charrefs=True)
    parser.handle_data = shown.append
    parser.feed(html)
    parser.close()
    return "".join(shown)


def test_text_is_escaped_and_markup_is_not():
    assert el("p", "a < b", Html("<b>c</b>")) == "<p>a &lt; b<b>c</b></p>"


def test_attributes_are_escaped():
    assert el("a", "x", attrs={"href": '"><script>'}) == '<a href="&quot;&gt;&lt;script&gt;">x</a>'


def test_none_is_left_out_and_iterables_are_joined():
    assert join("a", None, ["b", Html("<i>c</i>")]) == "ab<i>c</i>"


def test_every_helper_escapes():
    for html in (
        table([HOSTILE], [[HOSTILE]]),
        facts([(HOSTILE, HOSTILE)]),
        figure("data:,", HOSTILE, HOSTILE),
        spec_html(HOSTILE),
        yaml_html(HOSTILE),
    ):
        assert "<script" not in html


def test_numeric_cells_stand_right():
    assert '<td class="num">1</td>' in table(["a", "b"], [["x", "1"]], numeric=(1,))


@settings(deadline=None)
@given(st.text(st.characters(exclude_characters="\r\0", exclude_categories=("Cs",))))
def test_highlighting_keeps_the_text(text):
    told = unescape(text_of(text))  # signs stand for what no page may hold
    assert unmarked(spec_html(text)) == told
    assert unmarked(yaml_html(text)) == told


def test_words_of_a_specification_are_set_apart():
    html = spec_html("require a: always x > 0  # why")
    assert '<span class="kw">require</span>' in html
    assert '<span class="kw">always</span>' in html
    assert '<span class="cm"># why</span>' in html
    assert "always" in spec_html("alwaysx")
    assert "span" not in spec_html("alwaysx")


def test_keys_of_a_system_are_set_apart():
    html = yaml_html("time: {dt: 0.1 s} # note\n  x: 1\n")
    assert '<span class="kw">time</span>' in html
    assert '<span class="cm"># note</span>' in html
    assert '<span class="kw">  x</span>' in html
