from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.resolving import codes, findings, formula, spec
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.ir import typed

DEFS = """
const k = 2
def half(a) = a / k
def near(a, w) = abs(a - x) <= w
def both(f, g) = f and not g
def within(f, d) = eventually[0, d] f
def band = x in [-1, 1]
def shifted(a) = half(a) + y
def any_of(f) = exists i in 0..2: (f and q[i] > i)
"""

_numbers = st.recursive(
    st.sampled_from([("x", "x"), ("y", "y"), ("3", "3"), ("q[1]", "q[1]")]),
    lambda inner: (
        inner.map(lambda a: (f"half({a[0]})", f"(({a[1]}) / 2)"))
        | inner.map(lambda a: (f"shifted({a[0]})", f"((({a[1]}) / 2) + y)"))
        | st.tuples(inner, inner).map(lambda p: (f"({p[0][0]} + {p[1][0]})", f"({p[0][1]} + {p[1][1]})"))
    ),
    max_leaves=5,
)
_formulas = st.recursive(
    _numbers.map(lambda a: (f"{a[0]} > 1", f"{a[1]} > 1"))
    | st.tuples(_numbers, _numbers).map(
        lambda p: (f"near({p[0][0]}, {p[1][0]})", f"abs({p[0][1]} - x) <= {p[1][1]}")
    )
    | st.just(("band", "x in [-1, 1]")),
    lambda inner: (
        st.tuples(inner, inner).map(
            lambda p: (f"both({p[0][0]}, {p[1][0]})", f"(({p[0][1]}) and not ({p[1][1]}))")
        )
        | inner.map(lambda f: (f"within({f[0]}, 2 s)", f"(eventually[0, 2 s] ({f[1]}))"))
        | inner.map(lambda f: (f"within(d = T, f = ({f[0]}))", f"(eventually[0, T] ({f[1]}))"))
        | inner.map(
            lambda f: (
                f"any_of({f[0]})",
                "(" + " or ".join(f"(({f[1]}) and q[{i}] > {i})" for i in range(3)) + ")",
            )
        )
    ),
    max_leaves=4,
)


@settings(max_examples=18)
@given(_formulas)
def test_a_macro_is_its_text_written_out(case: tuple[str, str]) -> None:
    short, long = case
    assert flat(formula(short, DEFS)) == flat(formula(long))


def flat(found: typed.Formula) -> typed.Formula:
    """`(a and b) and c` as `a and b and c`: grouping by a name is no grouping of the text."""
    match found:
        case typed.Logic(span, "and" | "or" as op, items):
            parts = [flat(item) for item in items]
            same = [
                part.items if isinstance(part, typed.Logic) and part.op == op else (part,) for part in parts
            ]
            return typed.Logic(span, op, tuple(item for group in same for item in group))
        case typed.Not(span, body):
            return typed.Not(span, flat(body))
        case typed.Temporal():
            return replace(found, body=flat(found.body))
        case _:
            return found


def test_arguments_are_not_captured() -> None:
    """A quantifier of the macro does not bind a name of its argument."""
    found = formula("exists i in 5..5: any_of(y > i)", DEFS)
    assert found == formula("exists j in 0..2: (y > 5 and q[j] > j)")


def test_a_formal_hides_a_signal() -> None:
    assert formula("f(y)", "def f(x) = x > 1") == formula("y > 1")
    assert formula("f(y + x)", "def f(x) = x > 1") == formula("y + x > 1")


def test_a_body_reads_the_file_and_not_its_caller() -> None:
    assert formula("g(3)", "def f(a) = a > x\ndef g(x) = f(x + 1)") == formula("4 > x")


def test_definitions_may_stand_in_any_order() -> None:
    text = "signal x\nrequire r: above\ndef above = x > limit\nconst limit = 2 * base\nconst base = 3\n"
    assert spec(text).constants == (("limit", 6.0), ("base", 3.0))


@pytest.mark.parametrize(
    "text",
    [
        "def a = a",
        "def a = b\ndef b = a",
        "const a = b\nconst b = a + 1",
        "def f(x) = f(x)\nrequire r: f(1) > 2",
        "def f(x) = g(x)\ndef g(x) = f(x)\nrequire r: f(1) > 2",
        "region a = union(a, a)",
    ],
)
def test_no_recursion(text: str) -> None:
    assert codes(text + "\n") == ["E105"]


def test_doubling_is_stopped_early() -> None:
    lines = ["signal x", "def f0(a) = a + a"]
    lines += [f"def f{i}(a) = f{i - 1}(f{i - 1}(a))" for i in range(1, 40)]
    assert codes("\n".join(lines) + "\nrequire r: f39(x) > 0\n") == ["E005"]


def test_arguments_that_double_are_stopped_early() -> None:
    text = "x"
    for _ in range(40):
        text = f"f({text})"
    assert codes(f"signal x\ndef f(a) = a + a\nrequire r: {text} > 0\n") == ["E005"]


@pytest.mark.parametrize(
    "body", ["forall i in 0..10000000: x > i", "forall i in 0..99: forall j in 0..9999: x > i + j"]
)
def test_unrolling_is_bounded(body: str) -> None:
    assert codes(f"signal x\nrequire r: {body}\n") == ["E005"]


def test_chains_of_definitions_are_bounded_in_depth() -> None:
    lines = ["signal x", "def a0 = x + 1"]
    lines += [f"def a{i} = a{i - 1} + 1" for i in range(1, 1200)]
    found = codes("\n".join(lines) + "\nrequire r: a1199 > 0\n")
    assert found == ["E005"]
    assert codes("\n".join(["signal x", *reversed(lines[1:]), "require r: a1199 > 0\n"]))[0] == "E005"


def test_findings_in_a_macro_show_its_use() -> None:
    (finding,) = findings(
        "signal x [m]\nsignal v [m/s]\ndef f(a) = a > x\nrequire r: f(v)\nrequire s: f(v)\n"
    )
    assert finding.code == "E203"
    assert finding.labels[-1].span.text == "f(v)"
    assert finding.labels[-1].text == "in this use of `f`"


def test_declared_sorts_hold() -> None:
    assert codes("signal x\ndef f(a) : real = a > x\nrequire r: f(1) > 2\n") == ["E202"]
    assert codes("signal x\ndef f(a) : bool = a + x\nrequire r: f(1)\n") == ["E201"]
