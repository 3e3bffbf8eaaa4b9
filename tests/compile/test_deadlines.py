"""Requirements that are due later than a plan reaches, and those among them that nothing bridges."""

from __future__ import annotations

from fractions import Fraction

import pytest

from stlc.compile.deadlines import beyond_plans, unreached
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import Compiled, compile_spec
from stlc.grammar.spec import Spec
from stlc.source import Source


def compiled(formula: str) -> Compiled:
    text = f"state signal x [m]\nrequire r: {formula}"
    return compile_spec(Spec.parse(Source("s.stl", text)), grid=Grid(Fraction(1, 2), 20))


@pytest.mark.parametrize(
    ("formula", "seconds", "recurs", "warned"),
    [
        ("eventually@[0 s, 30 s] x > 1 m", 30.0, False, False),
        ("eventually@[0 s, 10 s] x > 1 m", None, False, False),
        ("always@[0 s, 30 s] x > 1 m", None, False, False),
        ("always@[12 s, 30 s] x > 1 m", 12.0, False, False),
        ("(x < 2 m) until@[0 s, 30 s] x > 1 m", 30.0, False, False),
        ("eventually@[0 s, 12 s] x > 1 m and eventually@[0 s, 30 s] x < 0 m", 30.0, False, False),
        ("always@[12 s, end] x > 1 m", 12.0, False, False),
        ("always@[12 s, end] eventually[0 s, 15 s] x > 1 m", 15.0, True, True),
        ("always@[0 s, end] x > 1 m", None, False, False),
        ("always@[0 s, end] once[0 s, 12 s] x > 1 m", 12.0, True, False),
        ("always@[0 s, end] once[0 s, 12 s] x > 1 m and eventually@[0 s, 3 s] x > 1 m", 12.0, True, False),
        ("always@[0 s, end] (x > 1 m or once[0 s, 12 s] x > 1 m)", 12.0, True, True),
        ("always@[0 s, end] once[0 s, 8 s] x > 1 m", None, False, False),
        ("always[0, T] once[0 s, 12 s] x > 1 m", 12.0, True, True),
        ("always@[0 s, 40 s] (x > 1 m -> eventually[0 s, 12 s] x < 0 m)", 12.0, True, True),
    ],
)
def test_what_is_due_later_than_a_plan_reaches(
    formula: str, seconds: float | None, recurs: bool, warned: bool
) -> None:
    found = unreached(compiled(formula))
    assert [(each.seconds, each.recurs) for each in found] == ([] if seconds is None else [(seconds, recurs)])
    warnings = list(beyond_plans(compiled(formula)))
    assert [finding.code for finding in warnings] == ["W316"] * warned
    if warned:
        assert f"is due within {seconds:g} s, again and again" in warnings[0].message
        assert "plans end after 10 s" in warnings[0].message
