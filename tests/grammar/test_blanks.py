"""Blanks and controls: every part of the language agrees on what a blank is."""

from __future__ import annotations

import re
import sys
import unicodedata

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.diagnostics import SpecError, StlcError
from stlc.editor.document import Systems, analyse
from stlc.grammar.errors.unicode import plain_text
from stlc.grammar.format.format import format_text
from stlc.grammar.parser import parse_expr
from stlc.grammar.printer import show
from stlc.grammar.scan import Lexeme
from stlc.grammar.spec import Spec
from stlc.lint.lint import lint
from stlc.source import Source
from stlc.units import Unit
from tests.helpers.strategies import specs

SPACES = [c for c in map(chr, range(sys.maxunicode + 1)) if unicodedata.category(c) == "Zs" and c != " "]
MARKS = [
    c
    for c in map(chr, range(sys.maxunicode + 1))
    if unicodedata.bidirectional(c)[:2] in ("LR", "RL", "PD", "FS")
]
MARKS = [*MARKS, "\u200e", "\u200f", "\u061c"]
CONTROLS = [c for c in map(chr, range(256)) if unicodedata.category(c) == "Cc" and c not in "\t\n"]
BREAKS = ["\u2028", "\u2029"]
UNSEEN = [*MARKS, *CONTROLS, *BREAKS]
TEXT = (
    '## doc\nspec s  # why\ntime s\nsignal x: real[2] [m/s]\nsignal y in [0, 3] from "a b"  // one\n'
    "def `an area` = 5 % + 3 %\n@weight(2)\nrequire r: y > 1 -> always@[0 s, 5 s] (y not in [1, 2]) # two\n"
)


def parts(text: str) -> str:
    """Run every part of the language on a text; return the codes of its errors, on which they agree."""
    source = Source("t.stl", text)
    try:
        Spec.parse(source)
        codes = set()
    except SpecError as error:
        codes = {one.code for one in error.diagnostics}
    found = [one for one in lint(source) if one.severity == "error"]
    if codes:
        assert {one.code for one in found} == codes
        assert codes <= {one.diagnostic.code for one in analyse(source, Systems()).findings}
    else:
        analyse(source, Systems())
    try:
        once = format_text(source)
    except StlcError as error:
        once = None
        assert codes == {one.code for one in error.diagnostics}  # noqa: PT017 - it may also succeed
    if once is not None:
        assert format_text(Source("t.stl", once)) == once
        assert len(re.findall("#|//", once)) >= len(re.findall("#|//", plain_text(text)))
    return " ".join(sorted(codes))


def places(text: str) -> list[int]:
    """Offsets between two lexemes, and within comments, texts and words."""
    return sorted({at for lexeme in Lexeme.scan(text) for at in (lexeme.start, lexeme.end)} | {2, len(text)})


@pytest.mark.parametrize("char", UNSEEN, ids=lambda char: f"U+{ord(char):04X}")
def test_a_control_is_refused_wherever_it_stands(char):
    for at in range(0, len(TEXT) + 1, 7):
        if char == "\r" and TEXT[at : at + 1] == "\n":
            continue
        with pytest.raises(SpecError) as caught:
            Spec.parse(Source("t.stl", TEXT[:at] + char + TEXT[at:]))
        assert {one.code for one in caught.value.diagnostics} == {"E001"}
        assert caught.value.diagnostics[0].span.start == at


@pytest.mark.parametrize("char", SPACES, ids=lambda char: f"U+{ord(char):04X}")
def test_another_space_is_refused_between_words_and_kept_in_comments_and_names(char):
    for text in (
        f"signal x{char}[m]",
        f"signal x [m{char}]",
        f"signal x: real[2{char}]",
        f"{char}## doc\nsignal x",
    ):
        with pytest.raises(SpecError) as caught:
            Spec.parse(Source("t.stl", text))
        (finding,) = caught.value.diagnostics
        assert finding.code == "E001"
        assert finding.fix.edits[0][1] == " "
        assert format_text(Source("t.stl", text)) == format_text(Source("t.stl", text.replace(char, " ")))
    kept = f'signal x [m] from "a{char}b"  # c{char}d\nsignal `e{char}f`\n'
    assert format_text(Source("t.stl", kept)) == kept
    with pytest.raises(SpecError):
        parse_expr(Source("car.yaml", f"1{char}+ 2"))
    for unit in (f"m{char}/s", f"m/s{char}"):
        with pytest.raises(ValueError, match="is not a unit"):
            Unit.parse(unit)


def test_a_lone_carriage_return_hides_nothing():
    assert parts("signal x\n# old\rrequire r: x > 3\n") == "E001"
    assert format_text(Source("t", "signal x\n# old\rrequire r: x > 3\n")).endswith(
        "# old\nrequire r: x > 3\n"
    )


def test_crlf_is_a_line_break():
    assert Spec.parse(Source("t", TEXT.replace("\n", "\r\n"))) == Spec.parse(Source("t", TEXT))


@settings(max_examples=15, deadline=None)
@given(specs, st.sampled_from([*SPACES, *UNSEEN]), st.data())
def test_all_parts_agree_on_random_specifications(spec, char, data):
    text = "# first\n" + show(spec).replace("\n", "  # note\n", 2)
    at = data.draw(st.sampled_from(places(text)))
    assert parts(text[:at] + char + text[at:]) in ("", "E001") or char == "\r"


@pytest.mark.slow
@pytest.mark.parametrize("char", [*SPACES, *UNSEEN], ids=lambda char: f"U+{ord(char):04X}")
def test_all_parts_agree_at_every_place(char):
    for at in range(0, len(TEXT) + 1, 3):
        parts(TEXT[:at] + char + TEXT[at:])
