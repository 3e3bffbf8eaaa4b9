"""Rules on the meaning of a specification: what is judged once, decided by ranges, or said without a unit."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.compile.frontend.interface import Interface
from stlc.compile.ir.discretize import Grid
from stlc.lint.lint import Surroundings, lint
from stlc.monitor.verdict import Monitor
from stlc.signature import Column, Signature
from stlc.source import Source

HEAD = """signal x, y
signal go : bool
signal mode : int
signal heading [rad]
signal rate [rad/s]
signal speed [m/s]
signal level [m] in [0 m, 10 m]
env signal wind [m/s] in [0, 12]
const limit = 30
const slow = 5 m/s
def calm = x < 3
def below(a, b) = a < b
"""


def found(formula: str, **options: object) -> list[tuple[str, str]]:
    findings = lint(Source("text", f"{HEAD}require r: {formula}"), **options)  # type: ignore[arg-type]
    return [(one.code, one.span.text) for one in findings if one.span and one.code != "W105"]


# ------------------------------------------------------------- the first sample


@pytest.mark.parametrize(
    ("formula", "place"),
    [
        ("x > 2", "x > 2"),
        ("not x > 2", "not x > 2"),
        ("go", "go"),
        ("x > 2 or go", "x > 2 or go"),
        ("x > 2 -> y > 3", "x > 2 -> y > 3"),
        ("x > 2 and y > 3", "x > 2 and y > 3"),
        ("historically x < 3", "historically x < 3"),
        ("once[1 s, 2 s] x < 3", "once[1 s, 2 s] x < 3"),
        ("x < 3 since go", "x < 3 since go"),
        ("rise(go)", "rise(go)"),
        ("x > 10 -> eventually[0 s, 1 s] y > 5", "x > 10"),
        ("(go and x > 1) -> always[1 s, 2 s] y > 5", "go and x > 1"),
        ("go or always[0 s, 2 s] y > 5", "go"),
        ("if go then x > 1 else always[0 s, 2 s] x < 1", "go"),
        ("x > 2 and always y < 3", "x > 2"),
        ("(always y < 3) and (go -> eventually[0 s, 1 s] x > 2)", "go"),
        ("freeze x0 = x in (x0 > 2 -> eventually[0 s, 1 s] x > x0)", "x0 > 2"),
        ("calm", "calm"),
        ("below(x, 3)", "below(x, 3)"),
    ],
)
def test_read_once(formula, place):
    assert ("W311", place) in found(formula)


@pytest.mark.parametrize(
    "formula",
    [
        "always x > 2",
        "always historically[0 s, 1 s] x < 3",
        "always[0 s, 0 s] x > 2",
        "(always[0 s, 0 s] go) -> eventually[0 s, 1 s] y > 5",
        "always[0 s, 1 s] x > 2",
        "eventually x > 2",
        "x < 3 until y < 5",
        "x < 3 until[0 s, 2 s] y < 5",
        "x < 3 release go",
        "go -> always x > 2",
        "go -> eventually x > 2",
        "forall i in 0..2: always x > i",
        "freeze x0 = x in always[0 s, 2 s] x <= x0",
        "always@[2 s, 5 s] x > 2",
        "historically[0 s, 1 s] eventually x > 2",
        "go -> always[0, T] x > 2",
        "true",
    ],
)
def test_read_elsewhere(formula):
    assert "W311" not in [code for code, _ in found(formula)]


def test_plans_are_judged_wherever_they_start():
    interface = Interface("cart", Signature((Column("x"), Column("y"))))
    text = "signal x, y\nrequire r: x > 10 -> eventually[0 s, 1 s] y > 5"
    for purpose, codes in (("train", []), ("check", ["W311"])):
        within = Surroundings(interface, Grid(1, 10), purpose)
        assert [one.code for one in lint(Source("text", text), within=within)] == codes


LEAF = st.sampled_from(["x > 2", "go", "y < 3"])
ONCE = st.recursive(
    LEAF,
    lambda part: st.one_of(
        st.tuples(st.sampled_from(["not", "historically[0 s, 2 s]", "once"]), part).map(
            "({0[0]} ({0[1]}))".format
        ),
        st.tuples(part, st.sampled_from(["and", "or", "->", "since"]), part).map(
            "(({0[0]}) {0[1]} ({0[2]}))".format
        ),
    ),
    max_leaves=5,
)


@given(
    ONCE, st.lists(st.tuples(st.integers(-5, 5), st.integers(-5, 5), st.booleans()), min_size=2, max_size=4)
)
def test_what_is_read_once_depends_on_the_first_sample_alone(formula, rows):
    """Other samples do not change the verdict of a requirement for which W311 is given as a whole."""
    text = f"signal x, y\nsignal go : bool\nrequire r: {formula}"
    codes = {one.code for one in lint(Source("text", text))}
    assert codes & {"W311", "W312", "W505"}
    monitor = Monitor(text, dt=1.0)
    columns = [[float(row[i]) for row in rows] for i in range(3)]
    whole = monitor.check(dict(zip(("x", "y", "go"), columns, strict=True)))
    start = monitor.check(
        {name: column[:1] * 3 for name, column in zip(("x", "y", "go"), columns, strict=True)}
    )
    assert whole.satisfied == start.satisfied


# ------------------------------------------------------------- declared ranges


@pytest.mark.parametrize(
    ("formula", "codes"),
    [
        ("always level < 30 m", ["W313"]),
        ("always level < 3000 cm", ["W313"]),
        ("always (level > 11 m -> x > 2)", ["W313"]),
        ("always 2 * level - 1 m < 20 m", ["W313"]),
        ("always level < 9 m", []),
        ("always level <= 10 m", []),
        ("always level >= 0 m", []),
        ("always (level < 30 m or x < 3)", ["W313"]),
        ("always below(level, 30 m)", []),
        ("always wind < 13 m/s", ["W503"]),
        ("always level < x", []),
        ("always sin(x) + level / 1 m < 30", ["W313"]),
        ("always sin(x) < 2", ["W503"]),
    ],
)
def test_decided_by_a_range(formula, codes):
    assert [code for code, _ in found(formula)] == codes


# ------------------------------------------------------------- bare numbers


@pytest.mark.parametrize(
    ("formula", "place"),
    [
        ("always abs(heading) < 30", "30"),
        ("always heading > -45", "-45"),
        ("always abs(heading) < limit", "limit"),
        ("always heading in [-1, 20]", "20"),
        ("always -20 < heading < 1", "-20"),
        ("always abs(rate) < 20", "20"),
        ("always speed < 50", "50"),
        ("eventually speed > slow + 2 m/s and always speed < 50", "50"),
    ],
)
def test_a_bare_number(formula, place):
    assert ("W314", place) in found(formula)


@pytest.mark.parametrize(
    "formula",
    [
        "always abs(heading) < 30 deg",
        "always abs(heading) < 0.5",
        "always heading + 1 rad < 30",
        "always speed < 50 km/h",
        "always speed < 2",
        "always speed > slow",
        "always x < 50",
        "always level < 9",
    ],
)
def test_a_number_that_is_clear(formula):
    assert found(formula) == []


# ------------------------------------------------------------- every value


@pytest.mark.parametrize(
    ("formula", "place"),
    [
        ("always (x < 3 or x > 1)", "x < 3 or x > 1"),
        ("always (x < 3 or x >= 3)", "x < 3 or x >= 3"),
        ("always (x <= 3 or go or x >= 3)", "x <= 3 or go or x >= 3"),
        ("always (x > 10 -> x > 5)", "x > 10 -> x > 5"),
        ("always (mode != 1 or mode != 2)", "mode != 1 or mode != 2"),
        ("always (go or not go)", "go or not go"),
        ("always (x - y > 1 or 2 * y - 2 * x > -4)", "x - y > 1 or 2 * y - 2 * x > -4"),
        ("always (go -> x > 3 or x < 4)", "x > 3 or x < 4"),
    ],
)
def test_every_value_satisfies_it(formula, place):
    assert found(formula) == [("W312", place)]


@pytest.mark.parametrize(
    "formula",
    [
        "x < 3 or x > 3",
        "x < 3 or x > 4",
        "x < 3 or y > 1",
        "abs(x) < 3 or x > 1",
        "mode != 1 or mode == 2",
        "x > 5 -> x > 10",
        "(eventually[0 s, 1 s] x < 3) or eventually[0 s, 1 s] x > 1",
    ],
)
def test_some_value_does_not_satisfy_it(formula):
    assert found(f"always ({formula})") == []


@pytest.mark.parametrize("formula", ["mode == 1 and mode == 2", "abs(x) < 1 and x > 3", "x < 3 and x >= 3"])
def test_no_value_satisfies_it(formula):
    assert found(f"always ({formula})") == [("W505", formula)]


LINEAR = st.tuples(
    st.sampled_from(["x", "2 * x - 1", "y - x", "abs(x - 1)", "mode"]),
    st.sampled_from(["<", "<=", ">", ">="]),
    st.integers(-3, 3),
).map(lambda part: f"{part[0]} {part[1]} {part[2]}")


@given(
    st.lists(LINEAR, min_size=2, max_size=4),
    st.lists(st.tuples(st.integers(-8, 8), st.integers(-8, 8), st.integers(-4, 4)), min_size=1, max_size=8),
)
def test_no_value_contradicts_the_finding(parts, rows):
    """At random points a disjunction with W312 is true, and a conjunction with W505 is false."""
    for word, code, truth in (("or", "W312", True), ("and", "W505", False)):
        text = f"signal x, y\nsignal mode : int\nrequire r: always ({f' {word} '.join(parts)})"
        if code not in {one.code for one in lint(Source("text", text))}:
            continue
        for x, y, mode in rows:
            verdict = Monitor(text, dt=1.0).check({"x": [x / 2], "y": [y / 2], "mode": [float(mode)]})
            (judgement,) = verdict
            assert judgement.robustness * (1 if truth else -1) >= 0


# ------------------------------------------------------------- comments


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("# require far: always x > -3", "far"),
        ("//  @safety require far : always x > -3", "far"),
        ('#@id("R1") @safety require far: x', "far"),
        ("# require near: always x > -3", None),
        ("# We require that: x is small", None),
        ("# require far:", None),
        ("## A require NAME: FORMULA is one.", None),
        ("# stlc: allow W315\n# require far: always x > -3", None),
    ],
)
def test_a_requirement_in_a_comment(text, named):
    findings = lint(Source("text", f"signal x\nrequire near: always x < 3\n{text}\n"))
    assert [one.code for one in findings] == ([] if named is None else ["W315"])
    assert all(named is not None and f"`{named}`" in one.message for one in findings)
