from __future__ import annotations

import math
import operator
from fractions import Fraction

import pytest
from helpers import reference
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from stlc.compile.frontend.expressions import Number, resolve_number, resolve_numbers, stored
from stlc.compile.frontend.scope import (
    Definition,
    Known,
    Scope,
    column_entries,
    member_entries,
)
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS
from stlc.diagnostics import SpecError, StlcError, SystemFileError
from stlc.grammar.parser import parse_expr
from stlc.signature import Column, Signature
from stlc.source import Source
from stlc.units import Unit

LABELS = (("stop", 0.0), ("light", 1.0))
COLUMNS = (
    Column("x", Unit.parse("m")),
    Column("v", Unit.parse("m/s"), low=-0.01, high=10.0, fact=True),
    Column("psi", Unit.parse("deg")),
    Column("d", Unit.parse("km")),
    Column("free"),
    Column("sign", kind="enum", labels=LABELS),
    Column("yielding", kind="bool"),
    Column("gear", kind="int"),
    Column("q[0]", Unit.parse("m")),
    Column("q[1]", Unit.parse("m")),
)
CONSTANTS = {
    "amax": Known(Number.fixed(10.0, Unit.parse("m/s^2"))),
    "dt": Known(Number.fixed(0.1, Unit.parse("s"))),
    "two": Known(Number.fixed(2.0, Unit.ONE)),
}
ROW = {"x": 3.0, "v": 2.0, "psi": 90.0, "d": 1.5, "free": 0.25, "sign": 1.0, "yielding": 0.0, "gear": 3.0}
ROW |= {"q[0]": 3.0, "q[1]": -4.0}


def scope(**settings: object) -> Scope:
    entries = {**column_entries(COLUMNS), **member_entries([LABELS]), **CONSTANTS}
    entries["has_lead"] = Definition("has_lead", parse_expr(Source("d", "x >= 0")))
    given_ = {"error": SystemFileError, "ranges": Signature(COLUMNS).enforced, **settings}
    return Scope(entries, **given_)  # type: ignore[arg-type]


def number(text: str, expected: Column | None = None, **settings: object) -> Number:
    return resolve_number(parse_expr(Source("s", text)), scope(**settings), expected=expected)


def value(text: str) -> float:
    return reference.number(number(text).num, ROW)


def codes(text: str, expected: Column | None = None, **settings: object) -> list[str]:
    with pytest.raises(StlcError) as caught:
        number(text, expected, **settings)
    return [finding.code for finding in caught.value.diagnostics]


# ---------------------------------------------------------------------- folding

SIGNS = {"+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv, "%": operator.mod}

_leaves = st.integers(-9, 9).map(lambda n: (str(n) if n >= 0 else f"({n})", Fraction(n))) | st.decimals(
    min_value=0, max_value=99, places=2
).map(lambda d: (str(d), Fraction(d)))


def _grown(inner):
    def joined(parts):
        (a, x), op, (b, y) = parts
        if op in "/%" and y == 0:
            return (a, x)
        return (f"({a} {op} {b})", SIGNS[op](x, y))

    return st.tuples(inner, st.sampled_from("+-*/%"), inner).map(joined)


@given(st.recursive(_leaves, _grown, max_leaves=8))
def test_constants_fold_exactly(case) -> None:
    text, exact = case
    found = number(text)
    assert found.exact == exact
    assert found.constant == float(exact)
    assert found.bare


@given(st.recursive(_leaves, _grown, max_leaves=6))
def test_folding_equals_python_arithmetic(case) -> None:
    """Up to rounding; a float modulo jumps where an exact one does not."""
    text, _ = case
    assume("%" not in text)
    assert number(text).constant == pytest.approx(eval(text), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("name", [name for name, f in FUNCTIONS.items() if f.kind == "function"])
@settings(max_examples=12)
@given(args=st.lists(st.floats(-3, 3, allow_subnormal=False), min_size=3, max_size=3))
def test_functions_fold_to_what_they_mean(name: str, args: list[float]) -> None:
    function = FUNCTIONS[name]
    args = [round(arg, 3) for arg in args[: function.most or 3]]
    try:
        wanted = float(reference._PLAIN[name](*args))
    except ValueError:
        assume(False)
    text = f"{name}({', '.join(f'({arg:.3f})' for arg in args)})"
    assert number(text).constant == pytest.approx(wanted, rel=1e-12, abs=1e-12)


def test_operators_and_functions_have_one_meaning_in_both_tables() -> None:
    folded = {name for name, f in FUNCTIONS.items() if f.kind != "sampler"}
    assert folded == set(reference._PLAIN)


@pytest.mark.parametrize("text", ["2^0.5", "2^-2", "(-8)^3", "2^10", "1.5^2", "10^-3"])
def test_powers(text: str) -> None:
    assert number(text).constant == pytest.approx(eval(text.replace("^", "**")), rel=1e-15)


def test_large_powers_do_not_grow_without_bound() -> None:
    found = number("((((10^60)^2)^2 / 10^60)^1) * 1")
    assert found.exact is None or found.exact.numerator.bit_length() <= 512
    assert codes("10^60^60") == ["E205"]


# ------------------------------------------------------------------------ units


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("x + v * dt", "m"),
        ("x * x", "m^2"),
        ("v^2 / amax", "m"),
        ("sqrt(v^2)", "m/s"),
        ("abs(x)", "m"),
        ("x % 2", "m"),
        ("atan2(x, q[0])", "1"),
        ("sin(psi)", "1"),
        ("ind(x > 0) * v", "m/s"),
        ("if x > 0 then v else 3", "m/s"),
        ("norm(q)", "m"),
        ("dot(q, q)", "m^2"),
        ("cross(q, q)", "m^2"),
        ("dist(q, [0, 0])", "m"),
        ("sdist(q, circle([0, 0], 5))", "m"),
    ],
)
def test_units_follow_the_operations(text: str, unit: str) -> None:
    found = number(text)
    assert found.unit.same_dims(Unit.parse(unit))
    assert not found.flexible


@pytest.mark.parametrize(
    "text",
    [
        "x + v",
        "x - dt",
        "min(x, v)",
        "x % dt",
        "sin(x)",
        "x ^ x",
        "clip(x, v, 1)",
        "exp(dt)",
        "x + ind(x > 0)",
    ],
)
def test_units_that_do_not_agree(text: str) -> None:
    assert codes(text) == ["E203"]


@pytest.mark.parametrize(
    "text", ["x + 2", "2 * x + v", "x + free", "5 / x + v", "sqrt(2 * amax * x) + v", "two + x"]
)
def test_bare_numbers_take_any_unit(text: str) -> None:
    number(text)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("psi + 30", math.radians(120)),
        ("d + 2", 3500.0),
        ("max(d, 1)", 1500.0),
        ("psi / 2", math.radians(45)),
        ("2 * d", 3000.0),
        ("d + 2 * x", 1506.0),
        ("deg(psi)", 90.0),
        ("rad(180)", math.pi),
        ("x + 1 km", 1003.0),
        ("clip(d, 0, 1)", 1000.0),
    ],
)
def test_a_bare_number_takes_the_scale_too(text: str, wanted: float) -> None:
    assert value(text) == pytest.approx(wanted, rel=1e-12)


def test_a_flexible_product_keeps_its_value() -> None:
    assert value("d - 2 * x") == 1494.0


# ----------------------------------------------------------------------- values


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("ind(sign == light or x > 5)", 1.0),
        ("ind(yielding)", 0.0),
        ("ind(has_lead and gear == 3)", 1.0),
        ("if gear != 3 then 1 else 2", 2.0),
        ("norm(q)", 5.0),
        ("norm1(q)", 7.0),
        ("norminf(q)", 4.0),
        ("q[1]", -4.0),
        ("norm(q - [1, 1])", math.hypot(2, 5)),
        ("norm(2 * q)", 10.0),
        ("norm(-q / 2)", 2.5),
        ("min(q)", -4.0),
        ("x^2 - 1", 8.0),
        ("free % 0.2", 0.25 % 0.2),
        ("sdist(q, box([0, -5], [4, 0]))", 1.0),
        ("relu(-x) + clip(x, 0, 1)", 1.0),
        ("v * (1 - ind(x < 0))", 2.0),
    ],
)
def test_values(text: str, wanted: float) -> None:
    assert value(text) == pytest.approx(wanted, rel=1e-12)


def test_sharpness_is_kept() -> None:
    found = number("ind(x > 0, sharpness = 500)").num
    assert isinstance(found, ir.Indicator)
    assert found.sharpness == 500.0


def test_neutral_elements_vanish() -> None:
    for text in ("x + 0", "0 + x", "x - 0", "1 * x", "x / 1", "x^1"):
        assert number(text).num == ir.Signal("x")


def test_several_components() -> None:
    found = resolve_numbers(parse_expr(Source("s", "2 * q")), scope())
    assert [reference.number(item.num, ROW) for item in found] == [6.0, -8.0]
    assert codes("q") == ["S203"]


# ---------------------------------------------------------------- what is asked


@pytest.mark.parametrize(
    ("text", "column", "wanted"),
    [
        ("stop", "sign", 0.0),
        ("light", "sign", 1.0),
        ("1", "sign", 1.0),
        ("true", "yielding", 1.0),
        ("false", "yielding", 0.0),
        ("x > 5", "yielding", 0.0),
        ("sign == light", "yielding", 1.0),
        ("45", "psi", math.radians(45)),
        ("2", "d", 2000.0),
        ("x", "d", 3.0),
        ("if x > 0 then light else stop", "sign", 1.0),
        ("yielding", "yielding", 0.0),
    ],
)
def test_a_number_for_a_column(text: str, column: str, wanted: float) -> None:
    target = next(c for c in COLUMNS if c.name == column)
    found = number(text, target)
    assert reference.number(found.num, ROW) == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "column"), [("45", "psi"), ("x + 1", "d"), ("x", "d"), ("2", "d"), ("v", "v")]
)
def test_stored_is_in_the_unit_of_the_column(text: str, column: str) -> None:
    target = next(c for c in COLUMNS if c.name == column)
    found = number(text, target)
    si = reference.number(found.num, ROW)
    assert reference.number(stored(found, target.unit), ROW) == pytest.approx(
        si / target.unit.scale, rel=1e-12
    )
    if text.isdigit():
        assert reference.number(stored(found, target.unit), ROW) == float(text)


@pytest.mark.parametrize(
    ("text", "column", "code"),
    [
        ("v", "x", "E203"),
        ("1 s", "x", "E203"),
        ("stop", "x", "S203"),
        ("0.5", "sign", "S203"),
        ("x", "yielding", "S203"),
        ("x > 0", "x", "S203"),
    ],
)
def test_a_number_that_does_not_fit_the_column(text: str, column: str, code: str) -> None:
    assert codes(text, next(c for c in COLUMNS if c.name == column)) == [code]


# ---------------------------------------------------------------------- refused


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("always x > 0", "S201"),
        ("ind(eventually x > 0)", "S201"),
        ("uniform(0, 1)", "S201"),
        ("a.b(3)", "S201"),
        ("a.b", "S201"),
        ("shift(x, 1)", "S201"),
        ("3 steps", "S201"),
        ("x > 0", "S203"),
        ("xx + 1", "E101"),
        ("squrt(2)", "E101"),
        ("1 / 0", "E401"),
        ("x % 0", "E401"),
        ("sqrt(-1)", "E205"),
        ("log(0)", "E205"),
        ("exp(1000)", "E205"),
        ('"text"', "E205"),
        ("x == 3", "E204"),
        ("(x > 0) + 1", "E202"),
        ("if x then 1 else 2", "E201"),
        ("ind(x)", "E201"),
        ("ind(x > 0, sharpness = -1)", "E205"),
        ("ind(x > 0, width = 1)", "E105"),
        ("min()", "E105"),
        ("T", "E101"),
    ],
)
def test_refused_with_a_finding(text: str, code: str) -> None:
    assert codes(text) == [code]


def test_attribute_calls_are_pointed_at() -> None:
    with pytest.raises(SystemFileError) as caught:
        number("x + foo.system(1)")
    (finding,) = caught.value.diagnostics
    assert finding.message == "calls to attributes are not part of the expression language"
    assert finding.span is not None
    assert finding.span.text == ".system"


def test_independent_findings_come_together() -> None:
    assert codes("(x + v) * (a + 1) + sqrt(-1)") == ["E203", "E101", "E205"]


def test_the_error_is_the_callers() -> None:
    with pytest.raises(SpecError):
        number("nothing", error=SpecError)


def test_samplers_where_they_are_allowed() -> None:
    found = number("choice(stop, light)", COLUMNS[5], samplers=True)
    assert found.num == ir.Op("choice", (ir.Const(0.0), ir.Const(1.0)))
    assert found.kind == "enum"
    assert number("bernoulli(0.2)", COLUMNS[6], samplers=True).num == ir.Op("bernoulli", (ir.Const(0.2),))
    assert number("uniform(x, 2)", COLUMNS[0], samplers=True).num == ir.Op(
        "uniform", (ir.Signal("x"), ir.Const(2.0))
    )
    assert number("uniform(0, 90)", COLUMNS[2], samplers=True).unit == Unit.parse("deg")
    assert codes("uniform(x, v)", samplers=True) == ["E203"]


def test_a_divisor_that_may_be_zero_is_a_warning_from_facts_alone() -> None:
    for text, warned in (("x / v", True), ("x / (v + 1)", False), ("x / d", False), ("x / (v - 5)", True)):
        found = scope()
        resolve_number(parse_expr(Source("s", text)), found)
        assert [finding.code for finding in found.sink] == (["W402"] if warned else [])
