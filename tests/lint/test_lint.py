"""Lint: what it finds, what is selected, what it repairs."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest

from stlc.compile.ir.discretize import Grid
from stlc.diagnostics import UsageError
from stlc.dynamics.load import load_system_decl
from stlc.files import File
from stlc.grammar.format.format import format_text
from stlc.grammar.spec import Spec
from stlc.lint.lint import Selection, Surroundings, edited, fix, lint
from stlc.lint.rules import RULES
from stlc.source import Source

ROOT = Path(__file__).resolve().parents[2]
SIGNAL = "signal x, y [m]\n"


def codes(text: str, **options) -> list[str]:
    return [finding.code for finding in lint(Source("text", text), **options)]


def test_the_flagship_has_nothing_to_say():
    source = File(ROOT / "specs/traffic.stl").read()
    decl = load_system_decl(ROOT / "examples/car.yaml")
    within = Surroundings(decl.interface(), Grid(decl.dt, decl.horizon))
    assert lint(source) == ()
    assert lint(source, within=within) == ()


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("def near(a, b) = x < a\nrequire r: always[0 s, 1 s] near(1 m, y)", ["W105"]),
        ("const a = 1 m\nconst b = a\nrequire r: always[0 s, 1 s] x < 1 m", ["W105"]),
        ("enum Sort { one, two }\nrequire r: always[0 s, 1 s] x < 1 m", ["W105"]),
        ("enum Sort { one, two }\nsignal s : Sort\nrequire r: always[0 s, 1 s] s == one", []),
        ("region pond = circle([x, y], 1 m)\nrequire r: always[0 s, 1 s] x < 1 m", ["W105"]),
        ("require r: G[0 s, 1 s] (x < 1 m && !(y > 1 m))", ["W106"] * 3),
        ("require r: alw_[0 s, 1 s] x < 1 m", ["W106"]),
        ("require r: always[0 s, 1 s] `G` < 1 m\nsignal `G` [m]", []),
        ("require r: always[0 s, 1 s] x < 1 m and eventually y < 1 m", ["W301"]),
        ("", ["W504"]),
    ],
)
def test_a_finding(text, found):
    assert codes(SIGNAL + text) == found


def test_a_file_to_be_imported_need_not_require_anything():
    assert codes("def near(a) = abs(a) < 1 m") == ["W105"]


def test_findings_come_in_the_order_of_the_text():
    found = lint(Source("text", SIGNAL + "require a: G[0, 1] x < 1 m\nrequire b: F[0, 1] z < 1 m"))
    places = [finding.span.start for finding in found]
    assert places == sorted(places)
    assert {finding.code for finding in found} == {"W106", "W101", "E101"}


# ---------------------------------------------------------------------- selection

UNCLEAR = SIGNAL + "const a = 1\nrequire r: G[0, 1] x < 1 m and y < 1 m -> F x > 0 m"


@pytest.mark.parametrize(
    ("select", "ignore", "found"),
    [
        ((), (), {"W105", "W106", "W101", "W301"}),
        (("W1",), (), {"W105", "W106", "W101"}),
        (("W301",), (), {"W301"}),
        (("W302",), (), {"W302"}),
        (("ALL",), ("W1",), {"W301", "W302"}),
        ((), ("W10",), {"W301"}),
    ],
)
def test_selection(select, ignore, found):
    assert set(codes(UNCLEAR, selection=Selection(select, ignore))) == found


def test_errors_are_always_told():
    assert codes(SIGNAL + "require r: z", selection=Selection(("W301",))) == ["E101"]


def test_an_unknown_code_is_refused():
    with pytest.raises(UsageError):
        Selection(("Q1",))


def test_every_rule_has_a_code():
    assert all(code.startswith("W") for code in RULES)


# ---------------------------------------------------------------------- repairs


def repaired(text: str) -> tuple[str, list[str], int]:
    done = fix(Source("text", text), lint)
    return done.source.text, [finding.code for finding in done.findings], done.count


@pytest.mark.parametrize(
    ("text", "after"),
    [
        ("require r: G[0 s, 1 s](x<1 m&&y<1 m)", "require r: always[0 s, 1 s](x<1 m and y<1 m)"),
        ("require r: G !x<1 m", "require r: always not x<1 m"),
        (
            "require r: always[0 s, 1 s] x < 1 m and eventually y < 1 m",
            "require r: (always[0 s, 1 s] x < 1 m) and eventually y < 1 m",
        ),
        ("require r: always[2 s, 1 s] x < 1 m", "require r: always[1 s, 2 s] x < 1 m"),
        ("require r: □[0 s, 1 s] x ≤ 1 m", "require r: always[0 s, 1 s] x <= 1 m"),
        ("require r: always[0 s, 1 s] |x| < 1 m", "require r: always[0 s, 1 s] abs(x) < 1 m"),
    ],
)
def test_a_repair(text, after):
    assert repaired(SIGNAL + text)[:2] == (SIGNAL + after, [])


def test_a_repair_does_not_change_the_meaning():
    text = SIGNAL + "require r: F[0 s, 1 s] x < 1 m && G[0 s, 1 s] y < 1 m || x => F y > 0 m"
    text = text.replace("|| x =>", "|| x > 2 m =>")
    after, left, count = repaired(text)
    assert Spec.parse(Source("text", after)) == Spec.parse(Source("text", text))
    assert left == []
    assert count == 8
    assert format_text(Source("text", after)) == format_text(Source("text", text))


def test_what_cannot_be_repaired_stays():
    text = SIGNAL + "require r: always[0 s, 1 s] z < 1 m"
    assert repaired(text) == (text, ["E101"], 0)


def test_a_grid_brings_what_only_it_knows():
    decl = load_system_decl(ROOT / "examples/car.yaml")
    within = Surroundings(decl.interface(), Grid(Fraction(1, 10), 25))
    text = "state signal x [m]\nrequire r: always[0 s, 0.25 s] x < 1 m"
    assert codes(text) == []
    assert codes(text, within=within) == ["W304"]


def test_a_repair_that_changes_the_requirement_is_left_to_the_reader():
    text = SIGNAL + "require r: x<1 m&&y<1 m"
    after = SIGNAL + "require r: x<1 m and y<1 m"
    assert repaired(text) == (after, ["W311"], 1)
    (finding,) = lint(Source("text", after))
    assert finding.fix is not None
    assert Spec.parse(Source("text", edited(after, finding.fix.edits))) == Spec.parse(
        Source("text", SIGNAL + "require r: always (x < 1 m and y < 1 m)")
    )
    assert not lint(Source("text", edited(after, finding.fix.edits)))
