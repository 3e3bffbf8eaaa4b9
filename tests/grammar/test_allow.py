"""Comments that silence a warning: where they apply, and what is said of comments that are not understood."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.diagnostics import Diagnostic
from stlc.grammar.allow import allowances, misunderstood, not_allowed
from stlc.grammar.format.format import format_text
from stlc.lint.lint import lint
from stlc.source import Source

HEAD = "signal x\n"
BARE = "always[0, 5]\n    x < 3"


def codes(text: str) -> list[str]:
    return [finding.code for finding in lint(Source("text", text))]


@pytest.mark.parametrize(
    "text",
    [
        f"require a: {BARE}  # stlc: allow W101",
        f"require a: {BARE}  // stlc: allow W101",
        f"require a: {BARE}\n# stlc: allow W101",
        f"require a:  # stlc: allow W101\n    {BARE}",
        f"require a:\n    # stlc: allow W101\n    {BARE}",
        f"# stlc: allow W101\nrequire a: {BARE}",
        f"# stlc: allow W101\n\n## the first\n@weight(2)\nrequire a:\n    {BARE}",
        f"#  stlc:allow w101, W304 - the last one\nrequire a: {BARE}",
        f"# stlc: allow W304 W101: for both\nrequire a: {BARE}",
        f"require b: always[0 s, 1 s] x < 3; require a: {BARE} # stlc: allow W101",
    ],
)
def test_a_comment_silences_a_warning_of_its_declaration(text):
    assert codes(HEAD + text) == []
    assert codes(format_text(Source("text", HEAD + text))) == []


@pytest.mark.parametrize(
    ("text", "left"),
    [
        (f"require a: {BARE}\nrequire b: {BARE}  # stlc: allow W101", ["W101"]),
        (f"# stlc: allow W101\nrequire b: {BARE}\nrequire a: {BARE}", ["W101"]),
        (f"require a: {BARE}\n# stlc: allow W101\nrequire b: {BARE}", ["W101"]),
        (f"require a: {BARE}  # stlc: allow W304", ["W101"]),
        (f"require a: {BARE}  # so that stlc: allow W101", ["W101"]),
        ('@id("# stlc: allow W101") require a: always[0, 5] x < 3', ["W101"]),
        ("require a: z < 1  # stlc: allow E101", ["E101", "W319"]),
    ],
)
def test_a_comment_silences_nothing_else(text, left):
    assert codes(HEAD + text) == left


@pytest.mark.parametrize(
    ("comment", "said"),
    [
        ("# stlc: alow W101", "does not understand"),
        ("# stlc: allow", "does not understand"),
        ("# stlc: allow it", "does not understand"),
        ("# stlc: allow W999", "no code `W999`"),
        ("# stlc: allow W101, E101", "`E101` is an error"),
    ],
)
def test_a_comment_that_is_not_understood(comment, said):
    (finding,) = misunderstood(Source("text", f"{HEAD}{comment}"))
    assert finding.code == "W319"
    assert said in finding.message
    assert finding.span is not None
    assert finding.span.text in comment


def test_findings_without_a_place_and_of_other_texts_stay():
    source = Source("text", "# stlc: allow W101")
    findings = [Diagnostic("W101", "one"), Diagnostic("W101", "two", Source("other", "x").span(0, 1))]
    assert not_allowed([*findings, Diagnostic("W101", "three", source.span(0, 1))]) == findings


@given(st.text('requi :#/stl,aowW10\n"`x', max_size=80))
def test_any_text_is_read(text):
    source = Source("text", text)
    for each in allowances(source):
        assert 0 <= each.where.start <= each.span.start <= each.span.end <= each.where.end <= len(text)
    assert all(finding.code == "W319" for finding in misunderstood(source))
