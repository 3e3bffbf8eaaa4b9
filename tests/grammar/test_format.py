"""Formatting: the same tree, the same comments in the same order, and nothing left to change."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers.strategies import specs
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from stlc.diagnostics import SpecError
from stlc.files import File
from stlc.grammar.format.format import WIDTH, format_text
from stlc.grammar.printer import show
from stlc.grammar.spec import Spec
from stlc.grammar.tokens import tokenize
from stlc.source import Source

DATA = sorted((Path(__file__).parent / "data").glob("*.stl"))
ROOT = Path(__file__).resolve().parent.parent.parent


def formatted(text: str) -> str:
    return format_text(Source("text", text))


def tree(text: str):
    return Spec.parse(Source("text", text))


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


@settings(max_examples=18)
@given(written())
def test_the_laws_hold_for_random_specifications(text):
    hold(text)


# ---------------------------------------------------------------------- layouts

RULE = "@safety\n@weight(2)\nrequire r: always[0, 5 s] (x > 0 and not y)\n"


@pytest.mark.parametrize("path", DATA, ids=lambda path: path.stem)
def test_the_benchmarks_keep_what_they_say(path):
    hold(File(path).read().text)


@pytest.mark.parametrize(
    "path", [*ROOT.glob("specs/*.stl"), *ROOT.glob("stlc/templates/cart*.stl")], ids=lambda path: path.stem
)
def test_what_is_shipped_has_the_layout(path):
    text = path.read_text(encoding="utf-8")
    assert formatted(text) == text


@pytest.mark.parametrize(
    ("written", "laid_out"),
    [
        ("", ""),
        ("\n\n# a\n\n\n\n# b", "# a\n\n# b\n"),
        ("const a=1;const b = 2 // c\n;", "const a = 1\nconst b = 2  // c\n"),
        (
            "@safety@weight( 2 )require r:G[0:5 s](x>0&&!y)",
            RULE,
        ),
        (RULE, RULE),
        ("require r: alw_[0,1 s] p=>F q", "require r: (always[0, 1 s] p) -> eventually q\n"),
        ("require r: always @ (1 s , 2 s) [x,y] not  in A", "require r: always@(1 s, 2 s) [x, y] not in A\n"),
        (
            "def f( a,b:real[3] ):bool=if a>b then a else b",
            "def f(a, b: real[3]): bool = if a > b then a else b\n",
        ),
        (
            'state signal q:real [7] [ rad ] in[-1,+1] from"p"',
            'state signal q : real[7] [rad] in [-1, 1] from "p"\n',
        ),
        ("enum S{a=0,b}", "enum S { a = 0, b }\n"),
        ("const c = ((5 m)) ^2+- -3%2", "const c = (5 m)^2 + --3 % 2\n"),
        ("const c = 5 m ^2 + 5% - 3", "const c = 5 m ^2 + 5 % - 3\n"),
        ("require r: forall i in 0 .. 6:x[ i ]in{1,2}", "require r: forall i in 0..6: x[i] in {1, 2}\n"),
        (
            "require r: freeze a=x,b=y in always(x<a+b)",
            "require r: freeze a = x, b = y in always (x < a + b)\n",
        ),
        ("require r: a|b&c", "require r: a or (b and c)\n"),
        ("require r: a->b->c", "require r: a -> (b -> c)\n"),
        ("require r: a and b U c", "require r: a and (b until c)\n"),
        ("require r: x ≤ 3 ∧ □[0,5 s] y", "require r: x <= 3 and always[0, 5 s] y\n"),
        ("const a = 1\nconst long [m] = 2  # x\n", "const a    = 1\nconst long [m] = 2  # x\n"),
        ("env signal a # x\nstate signal b [m] # y\n", "env   signal a      # x\nstate signal b [m]  # y\n"),
        ("def a = x\n\ndef long = y", "def a = x\n\ndef long = y\n"),
        (
            "@safety\nrequire a: x\n@safety\nrequire bcd: y",
            "@safety\nrequire a:   x\n@safety\nrequire bcd: y\n",
        ),
    ],
)
def test_a_layout(written, laid_out):
    assert formatted(written) == laid_out
    hold(written if "≤" not in written else laid_out)


def test_long_formulas_break_before_their_loosest_operator():
    text = (
        "require r: " + " and ".join(f"(some_signal_{i} > 12.5 m/s or other_{i})" for i in range(4)) + " -> z"
    )
    lines = formatted(text).splitlines()
    assert lines[0] == "require r:"
    assert [line.split()[0] for line in lines[2:]] == ["and", "and", "and", "->"]
    assert max(map(len, lines)) <= WIDTH


def test_long_lists_break_within_their_brackets():
    text = "region r = union(" + ", ".join(f"circle([{i}, {i}], radius = 3)" for i in range(6)) + ")"
    lines = formatted(text).splitlines()
    assert (lines[0], lines[-1]) == ("region r = union(", ")")
    assert len(lines) == 8


def test_comments_stay_within_a_formula():
    text = "require r:\n  # first\n  p # one\n  and # two\n\n  q\n# last\nconst c = 1"
    wanted = "require r:\n    # first\n    p  # one\n    and  # two\n    q\n# last\nconst c = 1\n"
    assert formatted(text) == wanted


def test_a_comment_behind_a_line_does_not_become_documentation():
    (first, second) = tree(formatted("const a = 1 # x\n; ## y\nconst b = 2")).items
    assert (first.doc, second.doc) == ("", "")


def test_deep_brackets_are_a_finding():
    assert formatted(f"const c = {'(' * 900}1{')' * 900}") == "const c = (1)\n"
    with pytest.raises(SpecError) as caught:
        formatted("const c = " + "(  # c\n" * 400 + "1" + ")" * 400)
    assert caught.value.diagnostics[0].code == "E005"


def test_what_cannot_be_read_is_told_about_the_text_that_was_given():
    with pytest.raises(SpecError) as caught:
        formatted("require r: x ≤ ∧")
    assert caught.value.diagnostics[0].span.source.text == "require r: x ≤ ∧"
