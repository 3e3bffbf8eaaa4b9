"""Messages about malformed texts: one golden text for each slip."""

from __future__ import annotations

from pathlib import Path

import pytest

from stlc.cli.framework.render import render_text
from stlc.diagnostics import CODES, Fix, SpecError
from stlc.grammar.parser import MAX_ERRORS, parse_expr
from stlc.grammar.spec import Spec
from stlc.source import Source

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "diagnostics"
CASES = sorted(GOLDEN.glob("*.stl"))


def findings(text: str, name: str = "specs/spec.stl"):
    with pytest.raises(SpecError) as caught:
        Spec.parse(Source(name, text))
    return caught.value.diagnostics


def expr_findings(text: str):
    with pytest.raises(SpecError) as caught:
        parse_expr(Source("car.yaml", text))
    return caught.value.diagnostics


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_the_message_is_the_golden_one(path, request):
    found = findings(path.read_text(encoding="utf-8"), f"specs/{path.name}")
    text = render_text(found, color=False)
    golden = path.with_suffix(".txt")
    if request.config.getoption("--regenerate"):
        golden.write_text(text, encoding="utf-8")
    assert text == golden.read_text(encoding="utf-8")
    assert "ANON" not in text
    assert all(finding.code in CODES for finding in found)


def test_every_golden_text_has_its_case():
    assert len(CASES) > 40
    assert {path.stem for path in GOLDEN.glob("*.txt")} == {path.stem for path in CASES}


def test_every_syntax_code_has_a_golden_text():
    texts = "".join(path.with_suffix(".txt").read_text(encoding="utf-8") for path in CASES)
    for code in ("E001", "E002", "E005", "E010", "E011", "E012", "E013", "E014"):
        assert f"error[{code}]" in texts


def applied(text: str, fix: Fix) -> str:
    for span, replacement in sorted(fix.edits, key=lambda edit: -edit[0].start):
        text = text[: span.start] + replacement + text[span.end :]
    return text


def count(text: str) -> int:
    try:
        Spec.parse(Source("fixed.stl", text))
    except SpecError as error:
        return len(error.diagnostics)
    return 0


def test_a_fix_repairs_its_finding():
    """Applying the edits of the first fix removes that finding and adds none."""
    offered = 0
    for path in CASES:
        text = path.read_text(encoding="utf-8")
        found = findings(text)
        for fix in [finding.fix for finding in found if finding.fix is not None][:1]:
            offered += 1
            assert count(applied(text, fix)) < len(found), path.stem
    assert offered > 10


def test_errors_of_independent_declarations_come_in_one_run():
    found = findings("require a x > 0\nrequire b: (x > 0\nrequire c: x = 3\nrequire d: x > 0\n")
    assert [finding.code for finding in found] == ["E010", "E011", "E013"]
    assert [finding.span.line for finding in found] == [1, 2, 3]


def test_at_most_twenty_errors():
    assert len(findings("require a x > 0\n" * 50)) == MAX_ERRORS


def test_well_formed_text_that_is_wrong_is_found_beside_syntax_errors():
    found = findings("const T = 5 s\nrequire a x\nconst b = 1e9999\nenum E { a = 0.5 }\n")
    assert [finding.code for finding in found] == ["E010", "E010", "E005", "E010"]


def test_one_slip_in_a_name_is_one_error():
    assert len(findings("const signal = 3\nrequire a: x > 0\n")) == 1


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        ("", "E010", "expected an expression, found the end of the expression"),
        ("x +", "E010", "expected a value after `+`, found the end of the expression"),
        ("x y", "E010", "expected an operator or the end of the expression after `x`, found `y`"),
        ("require a: x", "E010", "found `require`"),
        ("__import__('os').system('id')", "E001", "unexpected character `'`"),
        ("x[0", "E011", "this `[` is never closed"),
        ("a = 3", "E013", "`=` defines, `==` compares"),
        ("lambda: 0", "E010", "found `:`"),
        ("x; y", "E010", "found `;`"),
    ],
)
def test_expressions_have_messages_of_their_own(text, code, says):
    (finding,) = expr_findings(text)
    assert finding.code == code
    assert says in finding.message
    assert "declaration" not in finding.message


def test_messages_name_at_most_four_things():
    for path in CASES:
        for finding in findings(path.read_text(encoding="utf-8")):
            if finding.message.startswith("expected"):
                assert finding.message.count("`,") + finding.message.count(" or ") <= 4


@pytest.mark.parametrize("bracket", ["]", ")"])
def test_an_interval_is_closed_by_nobody_but_its_author(bracket):
    """`]` and `)` mean different samples; what is meant is not known, so nothing is repaired."""
    (finding,) = findings("signal v\nrequire a: always[0, T abs(v) <= 1.5")
    assert finding.fix is None
    assert finding.help == ("require a: always[0, T] abs(v) <= 1.5",)
    Spec.parse(Source("s.stl", f"signal v\nrequire a: always[0, T{bracket} abs(v) <= 1.5"))


@pytest.mark.parametrize(
    ("formula", "near"),
    [
        ("alwyas[0, T] v > 1", "always"),
        ("eventualy v > 1", "eventually"),
        ("v > 1 adn v < 2", "and"),
        ("v > 0 untill[0, 1 s] v > 1", "until"),
        ("(v > 1 or alwys[0, T] v > 2)", "always"),
    ],
)
def test_operators_that_are_misspelt(formula, near):
    (finding,) = findings(f"signal v\nrequire a: {formula}\n")
    assert finding.help == (f"did you mean `{near}`?",)
    assert finding.fix is None


@pytest.mark.parametrize("unit", ["deg C", "° C"])
def test_degrees_celsius_in_two_words(unit):
    (finding,) = findings(f"signal t\nrequire a: t > 20 {unit}\n")
    assert (finding.code, "`degC`" in finding.help[0]) == ("E010", True)


@pytest.mark.parametrize(
    "text", ["signal t [deg_C]\nrequire a: t > 1", "signal t\nrequire a: t > 20 celsius"]
)
def test_degrees_celsius_are_not_taken_for_angles(text):
    (finding,) = findings(text)
    assert (finding.code, "`degC`" in finding.help[0]) == ("E101", True)
    assert not any("`deg`" in line for line in finding.help)


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("kOhm", ["kohm"]),
        ("khz", ["kHz"]),
        ("kNn", ["kN"]),
        ("metre", ["m"]),
        ("barr", ["bar"]),
        ("mpa", ["mPa` (0.001 ", "MPa` (1e+06 "]),
        ("Mnm", ["mNm` (0.001 ", "MNm` (1e+06 "]),
        ("furlong", []),
    ],
)
def test_a_unit_is_never_meant_with_another_prefix_unsaid(word, meant):
    for text in (f"signal x [{word}]", f"signal x\nrequire r: x > 3 {word}"):
        (finding,) = findings(text)
        assert finding.code == "E101"
        (advice,) = [line for line in finding.help if "did you mean" in line] or [""]
        assert [unit for unit in meant if f"`{unit}" in advice] == meant
        assert advice.count("`") == 2 * len(meant)


@pytest.mark.parametrize(
    ("text", "code", "advice"),
    [
        ("require r: count[0 s, 5 s](x > 0) >= 3", "E016", "eventually(0 s, 5 s]"),
        ("require r: always mean[0:5](x) < 3", "E016", "shift(x, -1)"),
        ("phi := alw_[0, 5] (x[t] > 0)", "E010", "require phi: always[0 s, 5 s] x > 0"),
        (
            "mu := (x[t] > 0) and ev_[1, 2.5] (y[t] < 3)  # c",
            "E010",
            "def mu = (x > 0) and eventually[1 s, 2.5 s] y < 3",
        ),
        ("a := G[0, 5] x > 0", "E010", "require a: always[0 s, 5 s] x > 0"),
    ],
)
def test_words_of_other_tools_have_an_answer(text, code, advice):
    (finding,) = findings(f"signal x\nsignal y\n{text}\n")
    assert finding.code == code
    assert any(advice in line for line in finding.help)
    if ":=" in text:
        for line in finding.help:
            Spec.parse(Source("t", line.removeprefix("or, for a part of others:  ")))
