from __future__ import annotations

from fractions import Fraction

import pytest
from helpers.resolving import codes, formula
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.ir import typed
from stlc.compile.ir.typed import Time


def interval(
    text: str, before: str = "const lapse = 0.6 s\nconst k = 3\nconst lag [s] = 0.2"
) -> typed.Interval:
    found = formula(f"always{text} b", before)
    assert isinstance(found, typed.Temporal)
    return found.interval


def seconds(value: str) -> Time:
    return Time(Fraction(value))


@pytest.mark.parametrize(
    ("written", "time"),
    [
        ("2 s", seconds("2")),
        ("50 ms", seconds("1/20")),
        ("1 min", seconds("60")),
        ("0.1 s + 0.2 s", seconds("3/10")),
        ("lapse", seconds("3/5")),
        ("2 * lapse", seconds("6/5")),
        ("lapse / 3", seconds("1/5")),
        ("lapse + lag", seconds("4/5")),
        ("3 steps", Time(steps=Fraction(3))),
        ("dt", Time(steps=Fraction(1))),
        ("k * dt", Time(steps=Fraction(3))),
        ("T", Time(horizons=Fraction(1))),
        ("T / 2", Time(horizons=Fraction(1, 2))),
        ("T - 1 s", Time(Fraction(-1), horizons=Fraction(1))),
        ("T - 2 * dt + lapse", Time(Fraction(3, 5), Fraction(-2), Fraction(1))),
        ("-(lapse - T)", Time(Fraction(-3, 5), horizons=Fraction(1))),
        ("min(lapse, 1 s)", seconds("3/5")),
    ],
)
def test_a_bound_is_exact(written: str, time: Time) -> None:
    assert interval(f"[0, {written}]").hi == time


@pytest.mark.parametrize("written", ["end", "inf"])
def test_the_end_is_open(written: str) -> None:
    assert interval(f"[1 s, {written}]").hi is None


def test_nothing_written_means_to_the_end() -> None:
    found = formula("always b")
    assert isinstance(found, typed.Temporal)
    assert (found.interval.lo, found.interval.hi, found.interval.clock) == (Time(), None, "now")


@pytest.mark.parametrize(
    ("text", "ends"), [("[0, 1 s]", (0, 0)), ("(0, 1 s]", (1, 0)), ("[0, 1 s)", (0, 1)), ("(0, 1 s)", (1, 1))]
)
def test_open_ends_are_kept(text: str, ends: tuple[int, int]) -> None:
    found = interval(text)
    assert (found.lo_open, found.hi_open) == (bool(ends[0]), bool(ends[1]))


def test_the_mission_clock_is_kept() -> None:
    assert interval("@[5 s, 10 s]").clock == "start"


@settings(max_examples=12)
@given(st.fractions(0, 100, max_denominator=1000), st.fractions(0, 100, max_denominator=1000))
def test_seconds_add_exactly(a: Fraction, b: Fraction) -> None:
    written = f"{a.numerator} s / {a.denominator} + {b.numerator} s / {b.denominator}"
    assert interval(f"[0, {written}]").hi == Time(a + b)


@pytest.mark.parametrize(
    ("pragma", "hi", "warned"),
    [
        ("", seconds("3"), True),
        ("time s", seconds("3"), False),
        ("time ms", seconds("3/1000"), False),
        ("time steps", Time(steps=Fraction(3)), False),
    ],
)
def test_bare_numbers_are_in_the_unit_of_the_pragma(pragma: str, hi: Time, warned: bool) -> None:
    text = f"{pragma}\nsignal b : bool\nrequire r: always[0, 3] b\n"
    assert codes(text) == (["W101"] if warned else [])
    if not pragma:
        assert interval("[0, 3]").hi == hi
    else:
        from helpers.resolving import spec

        found = spec(text).requirements[0].formula
        assert isinstance(found, typed.Temporal)
        assert found.interval.hi == hi


@pytest.mark.parametrize(
    ("bounds", "code"),
    [
        ("[2 s, 1 s]", "E301"),
        ("[T, 0]", "E301"),
        ("[2 * T, T]", "E301"),
        ("[-1 s, 1 s]", "E302"),
        ("[-T, 0]", "E302"),
        ("[-2 steps, -1 steps]", "E302"),
        ("[0, t]", "E303"),
        ("[0, 2 * t]", "E303"),
        ("[end, end]", "E303"),
        ("[0, 3 m]", "E203"),
        ("[0, 3 m/s]", "E203"),
        ("[0, b]", "E205"),
        ("[0, T * T]", "E205"),
        ("[0, end - 1 s]", "E205"),
        ("[0, T / 0]", "E401"),
        ("[0, 1 s / dt]", "E205"),
    ],
)
def test_bounds_that_do_not_work(bounds: str, code: str) -> None:
    assert codes(f"signal b : bool\nsignal t [s]\nrequire r: always{bounds} b\n") == [code]


def test_bounds_that_depend_on_the_grid_are_left_to_it() -> None:
    assert interval("[1 s, T]").lo == seconds("1")
    assert interval("[2 steps, 1 s]").hi == seconds("1")


def test_a_macro_takes_times() -> None:
    found = formula("within(b, T - 1 s)", "def within(f, d) = eventually[0, d] f")
    assert isinstance(found, typed.Temporal)
    assert found.interval.hi == Time(Fraction(-1), horizons=Fraction(1))
