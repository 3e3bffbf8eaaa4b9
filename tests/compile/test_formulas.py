from __future__ import annotations

import pytest
from helpers import reference
from helpers.resolving import HEAD, formula, state
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.frontend.expressions import resolve_state_formula
from stlc.compile.frontend.scope import Scope, column_entries
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.normal_form import condition
from stlc.diagnostics import SystemFileError
from stlc.grammar.parser import parse_expr
from stlc.signature import Column
from stlc.source import Source
from stlc.units import Unit

SAMPLES = st.fixed_dictionaries(
    {name: st.sampled_from([-1.5, -0.5, 0.5, 1.5, 2.5]) for name in ("x", "y", "v")}
    | {name: st.sampled_from([0.0, 1.0]) for name in ("b", "c")}
    | {"n": st.integers(-2, 3).map(float), "mode": st.sampled_from([0.0, 2.0, 5.0])}
)

_atoms = st.sampled_from(
    [
        ("x > 1", lambda r: r["x"] > 1),
        ("-1 <= x < y + 1", lambda r: -1 <= r["x"] < r["y"] + 1),
        ("b", lambda r: r["b"] == 1),
        ("n == 2", lambda r: r["n"] == 2),
        ("n != 0", lambda r: r["n"] != 0),
        ("n in {-1, 1, 3}", lambda r: r["n"] in (-1, 1, 3)),
        ("x in [-1, 1]", lambda r: -1 <= r["x"] <= 1),
        ("x not in [-1, 1]", lambda r: not -1 <= r["x"] <= 1),
        ("mode == fast", lambda r: r["mode"] == 5),
        ("mode in {off, slow}", lambda r: r["mode"] in (0, 2)),
        ("mode != slow", lambda r: r["mode"] != 2),
        ("b == c", lambda r: r["b"] == r["c"]),
        ("b == true", lambda r: r["b"] == 1),
        ("true", lambda _: True),
        ("false", lambda _: False),
        ("exists i in 1..3: n == i", lambda r: 1 <= r["n"] <= 3),
        ("forall k in {2, 4}: x < k", lambda r: r["x"] < 2),
    ]
)
_SIGNS = {
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
    "xor": lambda a, b: a != b,
    "->": lambda a, b: not a or b,
    "<->": lambda a, b: a == b,
}


def _grown(inner):
    def binary(parts):
        (left, f), op, (right, g) = parts
        return (f"({left} {op} {right})", lambda r: _SIGNS[op](f(r), g(r)))

    def choice(parts):
        (cond, f), (yes, g), (no, h) = parts
        return (f"(if {cond} then {yes} else {no})", lambda r: g(r) if f(r) else h(r))

    return (
        st.tuples(inner, st.sampled_from(sorted(_SIGNS)), inner).map(binary)
        | st.tuples(inner, inner, inner).map(choice)
        | inner.map(lambda pair: (f"not ({pair[0]})", lambda r: not pair[1](r)))
    )


@settings(max_examples=18)
@given(st.recursive(_atoms, _grown, max_leaves=5), st.lists(SAMPLES, min_size=8, max_size=8))
def test_a_state_formula_means_what_python_says(case, rows) -> None:
    text, meaning = case
    found = state(text)
    for row in rows:
        assert reference.true(found, row) == bool(meaning(row)), text


@settings(max_examples=18)
@given(st.recursive(_atoms, _grown, max_leaves=5), SAMPLES)
def test_the_negation_is_the_opposite(case, row) -> None:
    found = formula(case[0])
    assert reference.true(condition(found, negated=True), row) != reference.true(condition(found), row)


@pytest.mark.parametrize(
    ("text", "strict", "value"),
    [
        ("x > y", True, 1.0),
        ("x >= y", False, 1.0),
        ("x < y", True, -1.0),
        ("x <= y", False, -1.0),
        ("b", False, 0.5),
        ("n == 2", False, -0.5),
        ("mode == fast", False, 0.5),
        ("p in circle([0, 0], 6)", False, 1.0),
    ],
)
def test_the_margin_of_a_predicate(text: str, strict: bool, value: float) -> None:
    row = {"x": 2.0, "y": 1.0, "b": 1.0, "n": 1.0, "mode": 5.0, "p[0]": 3.0, "p[1]": 4.0}
    found = formula(text)
    assert isinstance(found, typed.Predicate)
    assert found.strict is strict
    assert reference.number(found.num, row) == value


def test_an_inequality_of_enums_is_the_negated_equality() -> None:
    assert state("mode != fast") == condition(formula("mode == fast"), negated=True)


def test_chains_of_and_stay_flat() -> None:
    found = formula(" and ".join(["x > 1"] * 100))
    assert isinstance(found, typed.Logic)
    assert len(found.items) == 100


def test_temporal_operators_are_kept_with_their_shape() -> None:
    found = formula(
        "x > 0 until[0 s, 2 s] (always (y > 0)) and rise(b) and prev(x > 1) and fall(c) and next(b)"
    )
    assert isinstance(found, typed.Logic)
    kinds = [type(item) for item in found.items]
    assert kinds == [typed.Until, typed.Edge, typed.Shift, typed.Edge, typed.Shift]
    until = found.items[0]
    assert isinstance(until, typed.Until)
    assert (until.op, until.right.__class__) == ("until", typed.Temporal)
    assert [item.steps for item in found.items if isinstance(item, typed.Shift)] == [-1, 1]


@pytest.mark.parametrize("op", ["until", "release", "unless", "since"])
def test_binary_temporal_operators(op: str) -> None:
    found = formula(f"b {op}[1 s, 2 s] c")
    assert isinstance(found, typed.Until)
    assert found.op == op


@pytest.mark.parametrize("op", ["always", "eventually", "once", "historically"])
def test_unary_temporal_operators(op: str) -> None:
    found = formula(f"{op}[1 s, 2 s] b")
    assert isinstance(found, typed.Temporal)
    assert found.op == op


def test_places_point_into_the_text() -> None:
    text = "always (x > 1 and y > 2)"
    found = formula(text)
    assert isinstance(found, typed.Temporal)
    assert found.span.text == text
    assert isinstance(found.body, typed.Logic)
    assert [item.span.text for item in found.body.items] == ["x > 1", "y > 2"]


def test_a_guard_of_a_system_file() -> None:
    scope = Scope(column_entries([Column("x", Unit.parse("m"))]), error=SystemFileError)
    found = resolve_state_formula(parse_expr(Source("car.yaml", "x > 8")), scope, what="a guard")
    assert found == ir.Predicate(ir.Op("sub", (ir.Signal("x"), ir.Const(8.0))), strict=True)
    with pytest.raises(SystemFileError) as caught:
        resolve_state_formula(parse_expr(Source("car.yaml", "x + 1")), scope, what="a guard")
    (finding,) = caught.value.diagnostics
    assert (finding.code, finding.message) == ("S203", "a guard must be a formula, this is a number [m]")
    assert finding.label == "real [m]"
    assert finding.help == ("`x + 1 > 0`",)
    assert caught.value.diagnostics == tuple(scope.sink)


def test_the_head_of_these_tests_is_sound() -> None:
    assert formula("b", "def twice(a) = 2 * a").span.source.text.startswith(HEAD)
