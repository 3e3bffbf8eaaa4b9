from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest
from helpers import reference
from helpers.resolving import codes, findings, formula, spec
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.frontend.interface import Interface
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.typed import Time
from stlc.diagnostics import SpecError, UsageError
from stlc.signature import Column, Signature
from stlc.units import Unit

ROOT = Path(__file__).parents[3]
TRAFFIC = (ROOT / "specs" / "traffic.stl").read_text(encoding="utf-8")


def traffic() -> typed.Spec:
    return spec(TRAFFIC)


def test_the_traffic_specification() -> None:
    found = traffic()
    assert found.name == "traffic"
    assert found.signature.names == ("x", "v", "sign", "tau", "dx", "v_lead", "yielding")
    assert found.constants == (("T_red", 4.0), ("T_total", 8.0), ("x_inter", -1.0), ("gap", 1.0))
    assert [(r.name, sorted(r.tags)) for r in found.requirements] == [
        ("no_collision", ["safety"]),
        ("stop_sign", ["liveness"]),
        ("give_way", ["safety"]),
        ("red_light", ["safety"]),
    ]
    assert findings(TRAFFIC) == []


def test_the_columns_of_traffic() -> None:
    columns = {column.name: column for column in traffic().signature.columns}
    assert (columns["x"].unit, columns["x"].low, columns["x"].high) == (Unit.parse("m"), -10.0, 8.0)
    assert (columns["tau"].low, columns["tau"].high, columns["tau"].fact) == (0.0, 8.0, False)
    assert (columns["sign"].kind, columns["sign"].labels) == ("enum", (("stop", 0.0), ("light", 1.0)))
    assert (columns["yielding"].kind, columns["yielding"].role) == ("bool", "env")
    assert columns["v_lead"].fact


_positions = st.floats(-10, 10)


@settings(max_examples=12)
@given(
    x=_positions, tau=st.floats(0, 20), sign=st.sampled_from([0.0, 1.0]), yielding=st.sampled_from([0.0, 1.0])
)
def test_the_predicates_of_traffic_are_those_of_the_paper(x, tau, sign, yielding) -> None:
    row = {"x": x, "tau": tau, "sign": sign, "yielding": yielding, "dx": x}
    rules = {r.name: r.formula for r in traffic().requirements}

    def value(node: typed.Formula) -> float:
        assert isinstance(node, typed.Predicate)
        return reference.number(node.num, row)

    collision = rules["no_collision"]
    assert isinstance(collision, typed.Temporal)
    assert (collision.interval.lo, collision.interval.hi) == (Time(), Time(horizons=Fraction(1)))
    assert isinstance(collision.body, typed.Logic)
    guard, apart = collision.body.items
    assert value(guard) == pytest.approx(x + 0.5)
    assert value(apart) == pytest.approx(x - 1)

    give_way = rules["give_way"]
    assert isinstance(give_way, typed.Logic)
    both, always = give_way.items
    assert isinstance(both, typed.Logic)
    assert isinstance(always, typed.Temporal)
    assert [value(item) for item in both.items] == [0.5 - abs(sign), yielding - 0.5]
    assert value(always.body) == pytest.approx(-0.5 - x)

    red_light = rules["red_light"]
    assert isinstance(red_light, typed.Logic)
    light, always = red_light.items
    assert isinstance(always, typed.Temporal)
    assert isinstance(always.body, typed.Logic)
    red, outside = always.body.items
    assert value(light) == 0.5 - abs(sign - 1)
    assert value(red) == pytest.approx(4 - tau % 8)
    assert value(outside) == pytest.approx(x * (x + 1))


# ---------------------------------------------------------------------- signals


def test_vectors_become_columns() -> None:
    found = spec("state signal q : real[3] [deg] in [-90, 90]\nrequire r: norm(q) < 10\n")
    assert found.signature.names == ("q[0]", "q[1]", "q[2]")
    assert [(c.low, c.high, str(c.unit)) for c in found.signature.columns] == [(-90.0, 90.0, "deg")] * 3
    predicate = found.requirements[0].formula
    assert isinstance(predicate, typed.Predicate)
    row = {"q[0]": 3.0, "q[1]": 4.0, "q[2]": 0.0}
    assert reference.number(predicate.num, row) == pytest.approx(5 * Unit.parse("deg").scale)


def test_a_signal_may_come_from_another_column() -> None:
    found = spec('signal speed [km/h] from "vehicle.v"\nrequire r: speed < 100\n')
    assert found.signature.names == ("vehicle.v",)
    predicate = found.requirements[0].formula
    assert isinstance(predicate, typed.Predicate)
    assert reference.number(predicate.num, {"vehicle.v": 90.0}) == pytest.approx(10 / 3.6)


def test_a_parameter_is_a_column_of_the_environment() -> None:
    found = spec("signal x [m]\nparam r [m] in [0.6, 1.2]\nparam w ~ normal(0, 1)\nrequire a: x > r + w\n")
    column = found.signature["r"]
    assert (column.role, column.low, column.high, column.fact) == ("env", 0.6, 1.2, True)


def test_sets_and_open_ranges() -> None:
    found = spec("signal n : int in {1, 2, 5}\nsignal x [m] in [0, inf]\nrequire a: x > n\n")
    assert (found.signature["n"].low, found.signature["n"].high) == (1.0, 5.0)
    assert (found.signature["x"].low, found.signature["x"].high) == (0.0, None)


def test_the_name_of_a_file_without_a_pragma() -> None:
    assert spec("signal x\nrequire a: x > 0\n").name == "spec"


def test_vector_constants_and_truth_values() -> None:
    found = spec(
        "const c [m] = [1, 2 km]\nconst on : bool = true\nsignal x [m]\nrequire a: on and x > c[1]\n"
    )
    assert found.constants == (("c[0]", 1.0), ("c[1]", 2000.0), ("on", 1.0))


# ------------------------------------------------------------------- the system


def car(**columns: Column) -> Interface:
    own = (Column("x", Unit.parse("m")), Column("psi", Unit.parse("deg")), *columns.values())
    return Interface("car", Signature(own), {"k": (4.0, Unit.parse("s"))}, path="car.yaml")


def test_the_system_says_what_is_stored() -> None:
    text = "signal psi [rad] in [-1, 1]\nrequire a: psi < 0.5\nrequire b: psi < 30 deg\n"
    found = spec(text, car())
    column = found.signature["psi"]
    assert column.unit == Unit.parse("deg")
    assert column.high == pytest.approx(57.29577951308232)
    row = {"psi": 45.0}
    first, second = (r.formula for r in found.requirements)
    assert isinstance(first, typed.Predicate)
    assert isinstance(second, typed.Predicate)
    assert reference.number(first.num, row) == pytest.approx(0.5 - 45 * Unit.parse("deg").scale)
    assert reference.number(second.num, row) == pytest.approx(-15 * Unit.parse("deg").scale)


def test_a_signal_without_a_unit_takes_that_of_the_system() -> None:
    assert codes("signal x\nrequire a: x > 3 s\n", interface=car()) == ["E203"]
    assert codes("signal x\nrequire a: x > 3 s\n") == []


@pytest.mark.parametrize(
    ("value", "agrees"), [("4 s", True), ("4", True), ("4000 ms", True), ("5 s", False), ("4 m", False)]
)
def test_a_constant_that_the_system_has_too(value: str, agrees: bool) -> None:
    found = codes(f"const k = {value}\nsignal x\nrequire a: x > 0\n", interface=car())
    assert found == ([] if agrees else ["E104"])


def test_a_name_that_only_the_system_has() -> None:
    (finding,) = findings("signal x\nrequire a: x > k\n", interface=car())
    assert finding.help == ("car.yaml has it; declare it here too: `const k = 4 s`",)


# -------------------------------------------------------------------- overrides

GAP = "const gap [m] = 1\nconst wait = 4 s\nsignal x [m]\nrequire a: eventually[0, wait] x > gap\n"


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("gap", "3", 3.0),
        ("gap", "2 km", 2000.0),
        ("wait", "3s", 3.0),
        ("wait", "3 s", 3.0),
        ("wait", "3", 3.0),
        ("wait", "50 ms", 0.05),
        ("gap", "1 + 2 * 3", 7.0),
    ],
)
def test_set_changes_a_constant(name: str, text: str, value: float) -> None:
    found = spec(GAP, overrides={name: text})
    assert dict(found.constants)[name] == value
    always = found.requirements[0].formula
    assert isinstance(always, typed.Temporal)
    if name == "wait":
        assert always.interval.hi is not None
        assert float(always.interval.hi.seconds) == value
    else:
        assert isinstance(always.body, typed.Predicate)
        assert always.body.num == ir.Op("sub", (ir.Signal("x"), ir.Const(value)))


def test_a_mistyped_override_is_a_usage_error() -> None:
    with pytest.raises(UsageError) as caught:
        spec(GAP, overrides={"gpa": "3"})
    assert "did you mean `gap`?" in caught.value.diagnostics[0].help[0]
    with pytest.raises(UsageError):
        spec(GAP, overrides={"gap": "3 +"})
    with pytest.raises(SpecError):
        spec(GAP, overrides={"gap": "3 s"})


def test_constants_of_the_system_and_its_keys_are_left_to_it() -> None:
    spec("signal x\nrequire a: x > 0\n", car(), {"k": "3 s", "train.lr": "1e-3"})


# ----------------------------------------------------------------- requirements


def test_tags() -> None:
    text = '@safety @weight(2) @scale(5 m) @id("R1") @group(city)\nrequire a: always x > 0\n'
    rule = spec(f"signal x [m]\n## Stay ahead.\n{text}").requirements[0]
    assert (rule.tags, rule.weight, rule.scale, rule.id, rule.group) == ({"safety"}, 2.0, 5.0, "R1", "city")
    assert rule.doc == "Stay ahead."
    assert rule.span.text.endswith("require a: always x > 0")


def test_assumptions_stand_apart() -> None:
    found = spec("signal x\nassume start: x > 3\nrequire a: always x > 0\n")
    assert [r.name for r in found.assumptions] == ["start"]
    assert [r.name for r in found.requirements] == ["a"]


@pytest.mark.parametrize(
    ("text", "weak"),
    [
        ("always[0, T] x > 0", False),
        ("eventually[0, T] x > 0", True),
        ("eventually[0, 1 s] x > 0", False),
        ("eventually x > 0", True),
        ("not always x > 0", True),
        ("not eventually x > 0", False),
        ("x > 0 until[0, T] y > 0", False),
        ("true until[0, T] y > 0", True),
        ("x > 0 -> always[0, T] y > 0", False),
        ("x > 0 -> eventually[0, T] y > 0", True),
        ("x > 0 and eventually[0, T] y > 0", False),
        ("x > 0 or eventually[0, T] y > 0", True),
        ("always (x > 0 -> eventually[0, 1 s] y > 0)", False),
        ("y > 0 release[0, T] x > 0", False),
    ],
)
def test_safety_that_no_prefix_can_violate(text: str, weak: bool) -> None:
    found = codes(f"signal x, y\n@safety require a: {text}\n")
    assert found == (["W502"] if weak else [])


@pytest.mark.parametrize(
    ("text", "vacuous"),
    [
        ("e > 5 -> always x > 0", True),
        ("e > 3 -> always x > 0", False),
        ("always (e * 2 > 9 -> x > 0)", True),
        ("always e >= -1", True),
        ("always e > 1", False),
        ("eventually (e < -1)", False),
        ("m == up -> x > 0", False),
        ("not (e < 5) -> x > 0", True),
        ("x > 20 -> always x > 0", False),
        ("b -> x > 0", False),
        ("norm([e, e]) > 6 -> x > 0", True),
        ("sin(x) > 2 -> x > 0", True),
    ],
)
def test_vacuity_counts_enforced_ranges_alone(text: str, vacuous: bool) -> None:
    head = "enum M { up = 1, down = 2 }\nsignal x in [0, 10]\nenv signal e in [0, 4]\n"
    head += "signal m : M\nsignal b : bool\n"
    assert codes(f"{head}require a: {text}\n") == (["W503"] if vacuous else [])


def test_conditional_numbers() -> None:
    predicate = formula("(if b then x else 2 * x) > 0")
    assert isinstance(predicate, typed.Predicate)
    assert isinstance(predicate.num, ir.Where)
    assert [reference.number(predicate.num, {"b": b, "x": 3.0}) for b in (1.0, 0.0)] == [3.0, 6.0]
