"""Degrees Celsius: points of a scale with a zero of its own, and their differences in kelvin."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.diagnostics import SpecError
from stlc.monitor.verdict import Monitor

HEAD = """
import std
signal temp [degC]
signal t2 [°C]
signal wall [K]
signal raw
signal on: bool
signal n: int [degC]
const t_max = 60 degC
const band = 0.5 K
const warm [degC] = [18, 24]
def err = temp - 21 degC
def mean = 0.5 * temp + 0.5 * t2
def near(x, y, d) = abs(x - y) <= d
region calm = box([18 degC, 291.15 K], [24, 26 degC])
"""
VALUES = {"temp": 20.0, "t2": 25.0, "wall": 300.0, "raw": 300.0, "on": 1.0, "n": 21.0}


def judged(formula: str, head: str = HEAD, values: dict[str, float] = VALUES):
    monitor = Monitor(f"{head}require r: {formula}", dt=0.1)
    return monitor.check({name: [value] for name, value in values.items()}, end="truncate")["r"]


@pytest.mark.parametrize(
    ("formula", "margin", "unit"),
    [
        ("temp <= 60 degC", 40, "K"),
        ("temp <= 60 °C", 40, "K"),
        ("temp < 60", 40, "K"),
        ("temp < t_max", 40, "K"),
        ("temp < 300 K", 6.85, "K"),
        ("temp < wall", 6.85, "K"),
        ("temp < raw", 6.85, "K"),
        ("wall < 60 degC", 33.15, "K"),
        ("wall < 310", 10, "K"),
        ("raw < 20 degC", -6.85, "K"),
        ("-5 degC < temp", 25, "K"),
        ("temp > -5", 25, "K"),
        ("abs(temp - 21 degC) <= 0.5 K", -0.5, "K"),
        ("abs(21 - temp) <= 2", 1, "K"),
        ("near(temp, 21 degC, 0.5)", -0.5, "K"),
        ("near(temp, wall, 10 K)", 3.15, "K"),
        ("std.settles(temp, 21 degC, band, 1 s)", -0.5, "K"),
        ("abs(err) <= band", -0.5, "K"),
        ("temp - err > 20 degC", 1, "K"),
        ("20 degC - 5 degC < temp - 0 degC", 5, "K"),
        ("temp + 5 < 60", 35, "K"),
        ("temp - 5 K < t_max", 45, "K"),
        ("temp + (t2 - temp) / 2 < 60", 37.5, "K"),
        ("mean < 60 degC", 37.5, "K"),
        ("temp - wall < 2 K", 8.85, "K"),
        ("wall - temp < 10 K", 3.15, "K"),
        ("min(temp, 300 K) > 10", 10, "K"),
        ("max(wall, 20 degC) > 10 degC", 16.85, "K"),
        ("clip(temp, 10, 300 K) < 25", 5, "K"),
        ("(if on then temp else t2) in [18, 24]", 2, "K"),
        ("temp in [warm[0], warm[1]]", 2, "K"),
        ("temp in [18 degC, 300 K]", 2, "K"),
        ("wall in [10 degC, 30 degC]", 3.15, "K"),
        ("temp not in [18, 24]", -2, "K"),
        ("[temp, t2] in calm", 1, "K"),
        ("dist([temp, t2], [23 degC, 294.15 K]) < 6", 1, "K"),
        ("freeze s = temp in temp - s < 5 K", 5, "K"),
        ("2 * abs(temp - t2) < 11 K", 1, "K"),
        ("temp^2 > 1 K^2", 293.15**2 - 1, "K^2"),
        ("2 * temp > 500 K", 86.3, "K"),
        ("raw * temp > 5", 300 * 293.15 - 5, "K"),
        ("abs(0.5 * temp - 0.5 * t2) < 3", 0.5, "K"),
        ("n > 20", 0.5, "K"),
        ("n < 25 degC", 4, "K"),
        ("n == 21", 0.5, ""),
        ("n in {20, 22}", -0.5, ""),
        ("temp / wall < 1", 1 - 293.15 / 300, "1"),
    ],
)
def test_temperatures(formula: str, margin: float, unit: str) -> None:
    found = judged(formula)
    assert found.robustness == pytest.approx(margin, rel=1e-9)
    assert found.unit == unit


@pytest.mark.parametrize(
    ("formula", "instead"),
    [
        ("temp == 20", "abs(temp - 20 degC) <= 0.05 K"),
        ("temp == 0", "abs(temp - 0 degC) <= 0.05 K"),
        ("temp in {20 degC}", "abs(temp - 20 degC) <= 0.05 K"),
        ("wall == 20 degC", "abs(wall - 20 degC) <= 0.05 K"),
        ("wall == 0", "abs(wall) <= 0.05 K"),
    ],
)
def test_the_way_out_of_equality_is_one(formula: str, instead: str) -> None:
    with pytest.raises(SpecError) as caught:
        judged(formula)
    (finding,) = caught.value.diagnostics
    assert (finding.code, finding.help) == ("E204", (instead,))
    judged(instead)


def test_a_product_of_both_sides() -> None:
    monitor = Monitor(f"{HEAD}@product require r: temp in [18, 24]", dt=0.1)
    assert monitor.check({name: [value] for name, value in VALUES.items()})["r"].robustness == 8.0


def test_nothing_is_lost_at_the_limit() -> None:
    for limit in (0.1, 36.6, 60.0, 99.9):
        found = judged(f"temp <= {limit} degC", values=VALUES | {"temp": limit})
        assert (found.status, found.robustness) == ("satisfied", 0.0)


@pytest.mark.parametrize(
    ("formula", "place", "help_"),
    [
        ("abs(temp - 21 degC) <= 0.5 degC", "0.5 degC", "`0.5 K`"),
        ("abs(wall - 21 degC) <= 0.5 degC", "0.5 degC", "`0.5 K`"),
        ("abs(temp - wall) <= 0.5 degC", "0.5 degC", "`0.5 K`"),
        ("2 * abs(temp - t2) <= 1 degC", "1 degC", "`1 K`"),
        ("temp - t2 + 1 K < 0.5 degC", "0.5 degC", "`0.5 K`"),
        ("delta(temp) <= 1 degC", "1 degC", "`1 K`"),
        ("sqrt((temp - 21 degC)^2) < 2 degC", "2 degC", "`2 K`"),
        ("err < t_max", "t_max", "`60 K`"),
        ("err < t2", "t2", "`t2 - 0 °C`"),
        ("err in [-1 K, 1 degC]", "1 degC", "`1 K`"),
        ("near(temp, 21 degC, 0.5 degC)", "d", "`0.5 K`"),
        ("temp + t2 < 60", "+", "`temp + (t2 - temp) / 2`"),
        ("temp + 5 degC < 60", "+", "`temp + 5 K`"),
        ("temp - 21 <= 0.5", "21", "`21 degC` is a temperature, `21 K` a difference"),
        ("temp - wall < 2", "2", "`2 degC` is a temperature, `2 K` a difference"),
        ("wall in [10 degC, 30]", "30", "`30 K` a difference or a temperature in kelvin"),
        ("mean < 35", "35", "`35 degC` is a temperature"),
        ("1.8 * temp + 32 < 100 K", "32", "`32 degC` is a temperature, `32 K` a difference"),
        ("temp / 2 in [1 K, 3]", "3", "`3 degC` is a temperature"),
        ("0.5 * temp + 0.5 * wall < 35", "35", "`35 degC` is a temperature"),
        ("abs(temp) < 5", "temp", "`temp - 20 degC`"),
        ("norm([temp, t2]) < 5", "temp", "`temp - 20 degC`"),
        ("round(temp) < 5", "temp", "`temp - 20 degC`"),
        ("temp % 10 K < 5", "temp", "`temp - 20 degC`"),
        ("sign(temp) > 0", "temp", "`temp - 20 degC`"),
        ("-temp < 5", "temp", "`temp - 20 degC`"),
        ("temp < 3 m", "<", "`temp < 3`"),
        ("temp + 3 m < 60", "+", "`temp + 3`"),
    ],
)
def test_what_cannot_be_meant(formula: str, place: str, help_: str) -> None:
    with pytest.raises(SpecError) as caught:
        judged(formula)
    (finding,) = caught.value.diagnostics
    assert finding.span is not None
    assert (finding.code, finding.span.text) == ("E203", place)
    assert help_ in finding.help[0]


@pytest.mark.parametrize(
    "declaration",
    [
        "const d [degC] = t_max - 5 degC",
        "signal d [degC] in [20 degC - 10 degC, 30 degC]",
        "param d [degC] ~ normal(0, 1 K)",
        "@scale(5 degC) require s: temp > 1",
        "param d [degC] ~ normal(20, 0.5 degC)",
    ],
)
def test_declarations_that_mix_both_up(declaration: str) -> None:
    with pytest.raises(SpecError) as caught:
        Monitor(f"{HEAD}{declaration}\nrequire r: temp > 1", dt=0.1)
    assert {finding.code for finding in caught.value.diagnostics} == {"E203"}


# ------------------------------------------------------------------------ as kelvin would have it


def _shown(value: Fraction) -> str:
    return f"{float(value):.10g}" if value >= 0 else f"-{float(-value):.10g}"


TENTHS = st.integers(-400, 1200).map(lambda n: Fraction(n, 10))
Texts = tuple[str, str]
"""One formula over columns in degC, and over the same columns in K."""


def _point_literal(value: Fraction) -> Texts:
    return f"{_shown(value)} degC", f"{_shown(value + Fraction('273.15'))} K"


def _both(template: str, *parts: Texts) -> Texts:
    return tuple(template.format(*each) for each in zip(*parts, strict=True))  # type: ignore[return-value]


def _made(*templates: str, of: tuple[st.SearchStrategy[Texts], ...]) -> st.SearchStrategy[Texts]:
    return st.builds(_both, st.sampled_from(templates), *of)


leaves = st.one_of(st.sampled_from([("temp",) * 2, ("t2",) * 2, ("wall",) * 2]), TENTHS.map(_point_literal))
kelvins = st.integers(1, 300).map(lambda n: (f"{n / 10:g} K",) * 2)
points = st.deferred(
    lambda: st.one_of(
        leaves,
        _made("min({}, {})", "max({}, {})", "(if on then {} else {})", of=(points, points)),
        _made("({} + {})", "({} - {})", of=(points, differences)),
        _made("clip({}, {}, {})", of=(points, points, points)),
    )
)
differences = st.deferred(
    lambda: st.one_of(
        kelvins,
        _made("({} - {})", "abs({} - {})", of=(points, points)),
        _made("min({}, {})", "({} + {})", of=(differences, differences)),
        _made("2 * {}", "abs({})", of=(differences,)),
    )
)
formulas = st.deferred(
    lambda: st.one_of(
        _made("{} < {}", "{} >= {}", of=(points, points)),
        _made("{} <= {}", "{} > {}", of=(differences, differences)),
        _made("{} in [{}, {}]", of=(points, leaves, leaves)),
        _made("0.5 * {} + 0.5 * {} < {}", of=(points, points, points)),
        _made("({})^2 > ({})^2", of=(points, points)),
        _made("always[0 s, 0.2 s] ({})", "eventually[0 s, 0.2 s] ({})", "not ({})", of=(formulas,)),
        _made("({} and {})", "({} or {})", "({} -> {})", of=(formulas, formulas)),
    )
)


@settings(max_examples=15, deadline=None)
@given(
    texts=formulas,
    rows=st.lists(st.tuples(TENTHS, TENTHS, TENTHS, st.booleans()), min_size=4, max_size=6),
)
def test_columns_in_degrees_are_judged_as_in_kelvin(texts: Texts, rows: list[tuple]) -> None:
    table = np.array([[float(x) for x in row] for row in rows]).T
    table[2] += 273.15
    found = []
    for unit, text, shift in zip(("degC", "K"), texts, (0.0, 273.15), strict=True):
        head = f"signal temp [{unit}]\nsignal t2 [{unit}]\nsignal wall [K]\nsignal on: bool\n"
        data = {"temp": table[0] + shift, "t2": table[1] + shift, "wall": table[2], "on": table[3]}
        try:
            found.append(Monitor(f"{head}require r: {text}", dt=0.1).check(data)["r"])
        except SpecError as error:  # an empty range, in both
            found.append({finding.code for finding in error.diagnostics})
    if isinstance(found[1], set):
        assert found[0] == found[1] == {"E205"}
        return
    one, other = found
    assert one.robustness == pytest.approx(other.robustness, rel=1e-9, abs=1e-7, nan_ok=True)
    assert one.unit == other.unit
    if abs(other.robustness) > 1e-7:
        assert one.status == other.status
