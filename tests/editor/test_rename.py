from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest

from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.diagnostics import SpecError
from stlc.editor.document import Systems, analyse
from stlc.editor.rename import RenameError, can_rename, rename
from stlc.grammar.spec import Spec
from stlc.lint.lint import edited
from stlc.source import Source

DATA = sorted((Path(__file__).parent.parent / "grammar/data").glob("*.stl"))


def renamed(write, text: str, new: str) -> str:
    document, offset = write(text)
    return edited(document.source.text, rename(document, offset, new))


def test_every_use(write):
    text = "const c│ = 2\nsignal x\nrequire r: x > c and always[0 s, 1 s] x < c"
    assert renamed(write, text, "d") == "const d = 2\nsignal x\nrequire r: x > d and always[0 s, 1 s] x < d"


def test_from_a_use(write):
    assert renamed(write, "const c = 2\nrequire r: │c > 1", "d") == "const d = 2\nrequire r: d > 1"


def test_a_signal_goes_on_to_read_its_column(write):
    assert renamed(write, "signal x│ [m]\nrequire r: x > 0 m", "pos") == (
        'signal pos [m] from "x"\nrequire r: pos > 0 m'
    )
    assert (
        renamed(write, 'signal x│ from "a"\nrequire r: x > 0', "y") == 'signal y from "a"\nrequire r: y > 0'
    )


def test_arguments_of_a_definition(write):
    text = "signal x\ndef f(a│, b) = a > b\nrequire r: f(a = x, b = 2)"
    assert (
        renamed(write, text, "left") == "signal x\ndef f(left, b) = left > b\nrequire r: f(left = x, b = 2)"
    )


def test_a_type_and_a_member(write):
    text = "enum Mode { off, on }\nsignal m : Mode\nrequire r: m == on"
    assert "enum State { off, on }\nsignal m : State" in renamed(
        write, text.replace("Mode", "Mo│de", 1), "State"
    )
    assert "enum Mode { off, up }" in renamed(write, text.replace("== on", "== on│"), "up")
    assert "m == up" in renamed(write, text.replace("== on", "== on│"), "up")


def test_a_reserved_word_gets_backticks(write):
    assert renamed(write, "const c│ = 2\nrequire r: c > 1", "always") == (
        "const `always` = 2\nrequire r: `always` > 1"
    )
    assert "`T`" in renamed(write, "const c│ = 2\nrequire r: c > 1", "T")


@pytest.mark.parametrize(
    ("text", "new", "says"),
    [
        ("const c│ = 2\nconst d = 3\nrequire r: c > d", "d", "has a meaning already"),
        ("const c│ = 2\nconst d = 3\nrequire r: c > 1", "d", "has a meaning already"),
        ("const c│ = 2\ndef f(d) = d > c\nrequire r: f(1)", "d", "has a meaning already"),
        ("const c│ = 2\nsignal x\nrequire r: abs(x) > c", "abs", "has a meaning already"),
        ("const c│ = 2", "2c", "not a name"),
        ("const c│ = 2", "a b", "not a name"),
        ("const c│ = 2\nrequire r: c > ", "d", "error in line"),
        ("signal x│, y\nrequire r: x > y", "z", "share a declaration"),
        ("signal x\nrequire│ r: x > 0", "z", "no name here"),
        ("import std│\nsignal x", "z", "no name here"),
        ("param p│ in [0, 1]", "q", "no name here"),
        ("extern fn f│(x) -> real", "g", "no name here"),
    ],
)
def test_what_is_refused(write, text, new, says):
    document, offset = write(text)
    with pytest.raises(RenameError, match=says):
        rename(document, offset, new)


def test_what_can_be_renamed(write):
    document, _ = write("signal x\nrequire r: x > 0")
    assert [can_rename(document, offset) is not None for offset in (3, 7, 20)] == [False, True, True]


def test_requirements_may_be_called_as_signals(write):
    text = "signal x\nrequire r│: x > 0"
    assert renamed(write, text, "x") == "signal x\nrequire x: x > 0"


@pytest.mark.parametrize("path", DATA, ids=lambda path: path.stem)
def test_the_formulas_stay_whatever_is_renamed(path):
    """Definitions, constants, regions, enums and arguments of the six benchmarks, one after the other."""
    text = path.read_text(encoding="utf-8")
    document = analyse(Source("untitled:1", text), Systems())
    before = formulas(text)
    assert before
    for one in document.names.occurrences[::4]:
        if one.declares and one.symbol.kind != "signal" and can_rename(document, one.span.start):
            changed = edited(text, rename(document, one.span.start, "another_name"))
            assert changed != text
            assert formulas(changed) == before, one.symbol


def formulas(text: str) -> list[object]:
    """Compiled text: formulas over columns, or the codes of its findings."""
    grid = Grid(Fraction(1, 10), 20)
    try:
        compiled = compile_spec(Spec.parse(Source("t.stl", text)), grid=grid, purpose="check")
    except SpecError as error:
        return [finding.code for finding in error.diagnostics]
    return [rule.formula for rule in compiled.requirements]
