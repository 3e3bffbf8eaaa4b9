"""Whatever well-formed text says, the answer is a specification or a diagnostic with a place."""

from __future__ import annotations

import pytest
from helpers.effort import effort, refused
from helpers.resolving import HEAD
from hypothesis import example, given, settings
from hypothesis import strategies as st

from stlc.compile.frontend.resolve import resolve
from stlc.diagnostics import CODES, Diagnostic, SpecError
from stlc.grammar.spec import Spec
from stlc.source import Source

DEFS = """
param w in [0, 1]
const k = 2
const lag = 0.5 s
region disc = circle([0, 0], 1)
def half(a) = a / 2
def within(f, d) = eventually[0, d] f
def loop = loop
"""

_names = "x v b n mode fast q p w k lag disc T dt end inf true half loop nothing circle `T`"
_leaves = st.sampled_from(
    [*_names.split(), "0", "3", "[]", "[1, 2]", '"text"', "2.5 m", "3 s", "4 steps", "30 deg"]
)
_binary = [
    "+",
    "-",
    "*",
    "/",
    "%",
    "^",
    "<",
    ">=",
    "==",
    "!=",
    "in",
    "not in",
    "and",
    "or",
    "xor",
    "->",
    "<->",
]
_calls = [
    "half",
    "within",
    "norm",
    "min",
    "clip",
    "sin",
    "ind",
    "rise",
    "prev",
    "circle",
    "box",
    "union",
    "dilate",
]
_calls += [
    "polygon",
    "sdist",
    "dot",
    "cross",
    "deg",
    "uniform",
    "shift",
    "foo",
    "atan2",
    "complement",
    "x",
    "disc",
]


def _grown(inner):
    return (
        st.tuples(inner, st.sampled_from(_binary), inner).map(lambda p: f"({p[0]}) {p[1]} ({p[2]})")
        | st.tuples(st.sampled_from(_calls), st.lists(inner, max_size=3)).map(
            lambda p: f"{p[0]}({', '.join(p[1])})"
        )
        | st.tuples(inner, inner, inner).map(lambda p: f"(if {p[0]} then {p[1]} else {p[2]})")
        | st.tuples(inner, inner, inner).map(lambda p: f"(always[{p[0]}, {p[1]}] ({p[2]}))")
        | st.tuples(inner, inner, inner).map(lambda p: f"(({p[0]}) until@[0, {p[1]}) ({p[2]}))")
        | st.tuples(inner, inner).map(lambda p: f"(forall i in 0..{p[0]}: ({p[1]}))")
        | st.tuples(inner, inner).map(lambda p: f"({p[0]})[{p[1]}]")
        | st.tuples(inner, inner).map(lambda p: f"({p[0]}) in {{{p[1]}, 1}}")
        | inner.map(lambda a: f"-({a})")
        | inner.map(lambda a: f"not ({a})")
    )


@settings(max_examples=18)
@given(
    st.recursive(_leaves, _grown, max_leaves=6),
    st.sampled_from(["require r:", "def d =", "const e =", "region g ="]),
)
@example("norm([])", "require r:")
@example("2 ^ 100000000000", "const e =")
@example("(10^60)^(10^60)", "const e =")
@example("x ^ 100000000000 > 1 m", "require r:")
@example("min([])", "const e =")
@example("forall i in 5..0: x > i", "require r:")
@example("box([], [])", "region g =")
@example("p in union(disc, complement(disc))", "require r:")
def test_never_a_crash(text: str, keyword: str) -> None:
    try:
        syntax = Spec.parse(Source("specs/spec.stl", f"{HEAD}{DEFS}\n{keyword} {text}\n"))
    except SpecError:
        return
    try:
        resolve(syntax, sink=[])
    except SpecError as error:
        found = error.diagnostics
    else:
        raise AssertionError("`loop` refers to itself")
    for finding in found:
        assert finding.code in CODES
        assert finding.span is not None
        assert 0 <= finding.span.start <= finding.span.end <= len(finding.span.source.text)


@pytest.mark.parametrize("grown", ["({}) <-> x > 0", "x > 0 xor ({})", "({}) unless x > 1", "rise({})"])
def test_what_doubles_on_every_level_is_refused(grown: str) -> None:
    text = "x > 0"
    for _ in range(40):
        text = grown.format(text)
    syntax = Spec.parse(Source("specs/spec.stl", f"{HEAD}\nrequire r: {text}\n"))
    error, spent = refused(lambda: resolve(syntax, sink=[]), SpecError)
    assert [finding.code for finding in error.diagnostics] == ["E005"]
    assert spent < 1_000_000


@pytest.mark.parametrize(
    "items",
    [
        "require r: x > 1e308 h * 1 m/s",
        "require r: x > 0 m until[1e308 h, inf] y > 0 m",
        "const k [km] = 1e308",
        "const k [km] = [1, -1e308]",
        "signal w [km] in [0, 1e308]",
        "const k [km] = 2\nrequire r: 1e308 > k",
    ],
)
def test_what_only_the_unit_makes_too_large(items: str) -> None:
    with pytest.raises(SpecError) as caught:
        resolve(Spec.parse(Source("specs/spec.stl", f"{HEAD}\n{items}\n")), sink=[])
    assert [finding.code for finding in caught.value.diagnostics] == ["E005"]


@pytest.mark.apart
@pytest.mark.parametrize("line", ["require r{0}: u{0} > 0", "signal w{0}\nrequire r{0}: v{0} > 0"])
def test_twice_as_many_errors_take_twice_the_work(line: str) -> None:
    def found(count: int) -> int:
        text = HEAD + "\n".join(line.format(number) for number in range(count))
        syntax = Spec.parse(Source("specs/spec.stl", text))
        error, spent = refused(lambda: resolve(syntax, sink=[]), SpecError)
        assert f"{count - 20} more errors" in error.diagnostics[-1].note[-1]
        return spent

    assert found(300) < 2.5 * found(150)


def test_twice_as_many_warnings_take_twice_the_work() -> None:
    def found(count: int) -> int:
        text = HEAD + "\n".join(f"require r{number}: always[0, {number}] x > 0 m" for number in range(count))
        syntax = Spec.parse(Source("specs/spec.stl", text))
        warnings: list[Diagnostic] = []
        spent = effort(lambda: resolve(syntax, sink=warnings))
        assert [finding.code for finding in warnings] == ["W101"] * (count - 1)
        return spent

    assert found(300) < 2.5 * found(150)
