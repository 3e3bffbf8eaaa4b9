"""Margins of recorded traces: in the units of what is compared, of the same sign as in SI."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.lower import in_unit
from stlc.monitor.explain.report import explain
from stlc.monitor.online.online import How
from stlc.monitor.verdict import Monitor
from stlc.units import Unit

HEAD = """
signal speed [km/h]
signal rpm [rpm]
signal v [m/s]
signal a [deg]
signal on : bool
"""


def judged(formula: str, **values: float):
    monitor = Monitor(f"{HEAD}require r: {formula}", dt=0.1)
    return monitor.check({name: [value] for name, value in values.items()})["r"]


@pytest.mark.parametrize(
    ("formula", "values", "margin", "unit"),
    [
        ("speed < 120 km/h", {"speed": 100}, 20, "km/h"),
        ("120 km/h > speed", {"speed": 100}, 20, "km/h"),
        ("speed < 120", {"speed": 130}, -10, "km/h"),
        ("not (speed < 30 m/s)", {"speed": 100}, -8, "km/h"),
        ("v <= 7.2 km/h", {"v": 1.5}, 0.5, "m/s"),
        ("speed - v > 1 mph", {"speed": 36, "v": 5}, 18 - 1.609344, "km/h"),
        ("rpm in [1000, 4000]", {"rpm": 3900}, 100, "rpm"),
        ("abs(a) <= 45 deg", {"a": -44}, 1, "deg"),
        ("on -> rpm < 4000", {"on": 1, "rpm": 4100}, -0.5, ""),
        ("rpm < 4000 and speed < 50", {"rpm": 3000, "speed": 20}, 30, ""),
        ("freeze s = speed in speed - s < 9 km/h", {"speed": 33}, 9, "km/h"),
        ("max(speed, v) < 90 km/h", {"speed": 50, "v": 20}, 18, "km/h"),
        ("(if on then speed else v) < 90 km/h", {"on": 1, "speed": 50, "v": 20}, 40, "km/h"),
        ("speed^2 < 100 m^2/s^2", {"speed": 18}, 36**2 - 18**2, "km^2/h^2"),
        ("on", {"on": 1}, 0.5, ""),
    ],
)
def test_margins_in_the_unit_of_what_is_compared(formula, values, margin, unit) -> None:
    found = judged(formula, **values)
    assert found.robustness == pytest.approx(margin, rel=1e-12)
    assert found.unit == unit


def test_numbers_are_those_that_were_meant() -> None:
    assert judged("speed < 120 km/h", speed=100.0).robustness == 20.0
    assert judged("abs(a) <= 45 deg", a=-44.0).robustness == 1.0


def test_streams_and_causes_tell_the_same() -> None:
    monitor = Monitor(f"{HEAD}require r: always (rpm < 4000 and speed < 50)", dt=0.1)
    data = {"rpm": [3000.0, 3000.0], "speed": [20.0, 57.5]}
    online = monitor.online(How(reasons=True))
    for rpm, speed in zip(*data.values(), strict=True):
        online.push({"rpm": rpm, "speed": speed})
    verdict = monitor.check(data)
    cause, told = explain(verdict, "r"), online.cause("r")
    assert cause is not None
    assert told is not None
    assert (cause.unit, told.unit, cause.tree.rho, online.finish()["r"].robustness) == (
        "km/h",
        "km/h",
        -7.5,
        -7.5,
    )


def test_a_scale_goes_along() -> None:
    whole = Monitor(f"{HEAD}@scale(10 km/h)\nrequire r: always speed < 120 km/h", dt=0.1)
    assert whole.robustness({"speed": [100.0]}, at=0) == pytest.approx(2)


numbers = st.recursive(
    st.floats(-1e3, 1e3).map(ir.Const)
    | st.just(ir.Signal("x"))
    | st.just(ir.Op("mul", (ir.Signal("x"), ir.Const(1 / 3.6)))),
    lambda inner: st.builds(
        lambda name, a, b: ir.Op(name, (a, b)),
        st.sampled_from(["add", "sub", "min", "max", "mul"]),
        inner,
        inner,
    ),
    max_leaves=6,
)


@given(num=numbers, x=st.floats(-1e3, 1e3))
def test_a_number_in_a_unit_is_the_number_over_its_scale(num: ir.Num, x: float) -> None:
    from stlc.compile.backends.array.graph import evaluate
    from stlc.compile.backends.array.numpy_ops import NUMPY

    unit = Unit.parse("km/h")
    env = {"x": np.array([[x]])}
    plain, scaled = (
        float(evaluate([ir.Predicate(each)], env, ops=NUMPY)[0][0, 0]) for each in (num, in_unit(num, unit))
    )
    assert math.isclose(scaled * unit.scale, plain, rel_tol=1e-9, abs_tol=1e-3)


@pytest.mark.parametrize(
    ("declared", "codes"), [("temp [C]", ["W107"]), ("charge [C]", []), ("temp [K]", []), ("temp [degC]", [])]
)
def test_a_temperature_in_coulombs(declared: str, codes: list[str]) -> None:
    name = declared.split()[0]
    compiled = Monitor(f"signal {declared}\nrequire r: always[0 s, 1 s] {name} > 1", dt=0.1).compiled
    assert [finding.code for finding in compiled.warnings] == codes
    assert all("`degC`" in finding.help[0] for finding in compiled.warnings)
