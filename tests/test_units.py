from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.units import Unit, time_text

_PRODUCTS = sorted(symbol for symbol, unit in Unit.SYMBOLS.items() if not unit.offset)
_factors = st.lists(st.tuples(st.sampled_from(_PRODUCTS), st.integers(-3, 3)), min_size=1, max_size=3)


def _text(factors: list[tuple[str, int]]) -> str:
    return "*".join(symbol if power == 1 else f"{symbol}^{power}" for symbol, power in factors)


units = _factors.map(_text).map(Unit.parse)


@pytest.mark.parametrize(
    ("text", "dims", "ratio"),
    [
        ("m", (1, 0, 0, 0, 0, 0, 0), 1),
        ("m/s^2", (1, 0, -2, 0, 0, 0, 0), 1),
        ("m/s/s", (1, 0, -2, 0, 0, 0, 0), 1),
        ("m/s²", (1, 0, -2, 0, 0, 0, 0), 1),
        ("m s^-2", (1, 0, -2, 0, 0, 0, 0), 1),
        ("kg*m", (1, 1, 0, 0, 0, 0, 0), 1),
        ("1/s", (0, 0, -1, 0, 0, 0, 0), 1),
        ("1", (0, 0, 0, 0, 0, 0, 0), 1),
        ("Hz", (0, 0, -1, 0, 0, 0, 0), 1),
        ("N", (1, 1, -2, 0, 0, 0, 0), 1),
        ("Nm", (2, 1, -2, 0, 0, 0, 0), 1),
        ("W", (2, 1, -3, 0, 0, 0, 0), 1),
        ("km/h", (1, 0, -1, 0, 0, 0, 0), Fraction(5, 18)),
        ("ms", (0, 0, 1, 0, 0, 0, 0), Fraction(1, 1000)),
        ("min", (0, 0, 1, 0, 0, 0, 0), 60),
        ("%", (0, 0, 0, 0, 0, 0, 0), Fraction(1, 100)),
        ("mrad", (0, 0, 0, 0, 0, 0, 0), Fraction(1, 1000)),
        ("kPa", (-1, 1, -2, 0, 0, 0, 0), 1000),
        ("m/rad", (1, 0, 0, 0, 0, 0, 0), 1),
    ],
)
def test_reads_what_people_write(text: str, dims: tuple[int, ...], ratio: Fraction | int) -> None:
    assert Unit.parse(text) == Unit(dims, Fraction(ratio))  # type: ignore[arg-type]
    assert Unit.parse(text).text == text


@pytest.mark.parametrize("unit", Unit.PREFIXED)
def test_every_prefix_scales_every_unit(unit: str) -> None:
    one = Unit.parse(f"m{unit}").ratio * 1000
    for prefix, power in Unit.PREFIXES.items():
        found = Unit.parse(prefix + unit)
        assert found.ratio == one * Fraction(10) ** power
        assert found.dims == Unit.parse(f"k{unit}").dims


def test_no_two_units_share_a_spelling() -> None:
    spelled = [prefix + unit for unit in Unit.PREFIXED for prefix in ("", *Unit.PREFIXES)]
    plain = ["min", "h", "ft", "mph", "lb", "rpm", "deg", "°", "degC", "°C", "%", "1"]
    assert len({*spelled, *plain}) == len([*spelled, *plain])
    assert {*spelled, *plain, "kg"} - {"T"} == Unit.SYMBOLS.keys()


@pytest.mark.parametrize(
    ("text", "product"),
    [
        ("MNm", "1000000 kg*m^2/s^2"), ("MV", "1000000 kg*m^2/s^3/A"), ("MA", "1000000 A"), ("kK", "1000 K"),
        ("Mohm", "1000000 kg*m^2/s^3/A^2"), ("GN", "1000000000 kg*m/s^2"), ("hPa", "100 kg/m/s^2"),
        ("mbar", "100 kg/m/s^2"), ("MWh", "3600000000 kg*m^2/s^2"), ("kΩ", "1000 kg*m^2/s^3/A^2"),
        ("mT", "0.001 kg/s^2/A"), ("uF", "0.000001 A^2*s^4/kg/m^2"), ("μH", "0.000001 kg*m^2/s^2/A^2"),
        ("lx", "1 cd/m^2"), ("kat", "1 mol/s"), ("dam", "10 m"), ("dal", "0.01 m^3"),
        ("mSv", "0.001 m^2/s^2"),
    ],
)  # fmt: skip
def test_prefixed_units(text: str, product: str) -> None:
    number, base = product.split()
    assert Unit.parse(text).ratio == Fraction(number) * Unit.parse(base).ratio
    assert Unit.parse(text).same_dims(Unit.parse(base))


def test_degrees_and_revolutions() -> None:
    assert Unit.parse("deg").scale == math.pi / 180
    assert Unit.parse("°") == Unit.parse("deg")
    assert Unit.parse("rpm").scale == pytest.approx(2 * math.pi / 60, rel=1e-15)


@pytest.mark.parametrize(
    "text", ["", " ", "furlong", "m/", "/s", "m^", "2", "m**2", "m^100", "steps", "m)", "1//s"]
)
def test_refuses_what_is_no_unit(text: str) -> None:
    with pytest.raises(ValueError, match=r"unit|power"):
        Unit.parse(text)


def test_what_was_not_written_is_told_from_one() -> None:
    assert Unit.ONE.text == ""
    assert Unit.parse("1").text == "1"
    assert Unit.parse("1") == Unit.ONE
    assert str(Unit.ONE) == "1"


@given(units, units, units)
def test_products_form_a_group(a: Unit, b: Unit, c: Unit) -> None:
    assert a * b == b * a
    assert (a * b) * c == a * (b * c)
    assert a * Unit.ONE == a
    assert (a * b) / b == a
    assert (a / a).dimensionless
    assert (a / a).ratio == 1


@given(units, st.integers(-3, 3), st.integers(-3, 3))
def test_powers_add(a: Unit, m: int, n: int) -> None:
    assert a**m * a**n == a ** (m + n)


@given(units)
def test_a_root_undoes_a_square(a: Unit) -> None:
    root = (a**2) ** Fraction(1, 2)
    assert root.same_dims(a)
    assert root.scale == pytest.approx(a.scale, rel=1e-12)


def test_a_root_of_an_odd_power_has_no_unit() -> None:
    with pytest.raises(ValueError, match="no unit"):
        Unit.parse("m") ** Fraction(1, 2)


@given(units, units)
def test_a_computed_unit_can_be_read_again(a: Unit, b: Unit) -> None:
    for unit in (a * b, a / b, a**2):
        assert Unit.parse(str(unit)) == unit


@given(units)
def test_si_keeps_the_dimensions(a: Unit) -> None:
    assert a.si.ratio == 1
    assert a.same_dims(a.si)
    assert Unit.parse(str(a.si)) == a.si


@pytest.mark.parametrize(("text", "si"), [("1 mph", 0.44704), ("1 ft", 0.3048), ("1 lb", 0.45359237)])
def test_units_of_elsewhere(text: str, si: float) -> None:
    assert Unit.parse(text.split()[1]).scale == si


@pytest.mark.parametrize("text", ["degC", "°C"])
def test_degrees_have_a_zero_of_their_own(text: str) -> None:
    unit = Unit.parse(text)
    assert (str(unit), unit.offset, unit.ratio) == (text, Fraction("273.15"), 1)
    assert unit.same_dims(Unit.parse("K"))
    assert unit != Unit.parse("K")
    assert unit.interval == unit.si == Unit.parse("K")
    assert str(unit.interval) == "K"
    assert unit.of_si(293.15) == pytest.approx(20)
    assert str(Unit.parse("J") / unit) == "J/K"
    assert unit**2 == Unit.parse("K^2")
    assert unit * Unit.ONE == Unit.parse("K")


@pytest.mark.parametrize(
    ("text", "instead"),
    [
        ("kJ/degC", "kJ/K"),
        ("W/m^2/°C", "W/m^2/K"),
        ("degC/min", "K/min"),
        ("degC^2", "K^2"),
        ("1/degC", "1/K"),
    ],
)
def test_a_zero_of_its_own_is_no_factor(text: str, instead: str) -> None:
    with pytest.raises(ValueError, match="stands alone") as caught:
        Unit.parse(text)
    assert f"write `{instead}`" in str(caught.value)


@pytest.mark.parametrize(
    "text", ["celsius", "Celsius", "deg_C", "DegC", "degrees C", "degree_celsius", "Cel", "° C"]
)
def test_other_spellings_of_degrees_celsius(text: str) -> None:
    assert Unit.celsius_advice(text)


@pytest.mark.parametrize("text", ["deg", "C", "degrees", "cell", "degF", "c"])
def test_what_means_something_else(text: str) -> None:
    assert not Unit.celsius_advice(text)


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("36 km/h", "m/s", 10.0),
        ("36km/h", "m/s", 10.0),
        ("-1.5e1", "m", -15.0),
        (" .5 m ", "cm", 50.0),
        ("20 degC", "K", 293.15),
        ("293.15 K", "degC", 20.0),
        ("50 %", "1", 0.5),
        ("2 1/s", "1/s", 2.0),
        ("3 1", "%", 300.0),
        ("1e3 m", "km", 1.0),
    ],
)
def test_a_quantity(text, unit, value):
    assert Unit.parse(unit).value_of(text) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("5 kg", r"`kg` is not a unit of \[m\]"),
        ("1e999", "`1e999` is not a finite number"),
        ("inf", "`inf` is not a finite number"),
        ("", "`` is not a finite number"),
        ("2 bananas", "unknown unit `bananas`"),
    ],
)
def test_what_is_no_quantity(text, message):
    with pytest.raises(ValueError, match=message):
        Unit.parse("m").value_of(text)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(17100, "4.75 h"), (7200, "2 h"), (3600, "60 min"), (120, "2 min"), (7260, "121 min"), (90, "90 s"),
     (0.02, "0.02 s")],
)  # fmt: skip
def test_a_length_of_time_is_readable(seconds: float, text: str) -> None:
    assert time_text(seconds) == text
    assert time_text(Fraction(seconds)) == text
    number, unit = text.split()
    assert float(number) * Unit.parse(unit).scale == pytest.approx(seconds)
