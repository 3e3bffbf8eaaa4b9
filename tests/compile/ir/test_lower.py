from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from helpers.effort import effort
from helpers.formula_strategies import GRID, SPAN

from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.defined import defined
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.text import show_formula
from stlc.diagnostics import Diagnostic

X = typed.Predicate(SPAN, ir.Signal("x"), strict=True)
Y = typed.Predicate(SPAN, ir.Signal("y"), strict=False)


def between(lo: str, hi: str | None, opened: str = "[]") -> typed.Interval:
    upper = None if hi is None else typed.Time(seconds=Fraction(hi), span=SPAN)
    return typed.Interval(
        typed.Time(seconds=Fraction(lo), span=SPAN), upper, opened[0] == "(", opened[1] == ")", span=SPAN
    )


def lowered(formula: typed.Formula, grid: Grid = GRID) -> tuple[str, list[Diagnostic]]:
    sink: list[Diagnostic] = []
    return show_formula(grid.lower(formula, sink)), sink


def codes(formula: typed.Formula, grid: Grid = GRID) -> list[str]:
    return [finding.code for finding in lowered(formula, grid)[1]]


def always(interval: typed.Interval) -> typed.Temporal:
    return typed.Temporal(SPAN, "always", interval, X)


@pytest.mark.parametrize(
    ("formula", "text"),
    [
        (typed.Not(SPAN, X), "x <= 0"),
        (typed.Not(SPAN, typed.Not(SPAN, Y)), "y >= 0"),
        (typed.Logic(SPAN, "->", (X, Y)), "x <= 0 or y >= 0"),
        (typed.Not(SPAN, typed.Logic(SPAN, "->", (X, Y))), "x > 0 and y < 0"),
        (typed.Logic(SPAN, "<->", (X, Y)), "(x <= 0 or y >= 0) and (x > 0 or y < 0)"),
        (typed.Logic(SPAN, "xor", (X, Y)), "(x > 0 and y < 0) or (x <= 0 and y >= 0)"),
        (typed.Not(SPAN, always(between("0", "0.5"))), "eventually[0..5] x <= 0"),
        (
            typed.Not(SPAN, typed.Temporal(SPAN, "once", between("0", None), X)),
            "historically[0..start] x <= 0",
        ),
        (
            typed.Not(SPAN, typed.Until(SPAN, "until", between("0.1", "0.2"), X, Y)),
            "x <= 0 release[1..2] y < 0",
        ),
        (
            typed.Not(SPAN, typed.Until(SPAN, "since", between("0", "0.2"), X, Y)),
            "x <= 0 trigger[0..2] y < 0",
        ),
        (
            typed.Until(SPAN, "unless", between("0.1", "0.3"), X, Y),
            "always[0..3] x > 0 or (x > 0 until[1..3] y >= 0)",
        ),
        (typed.Edge(SPAN, "rise", X), "x > 0 and prev(x <= 0)"),
        (typed.Edge(SPAN, "fall", X), "x <= 0 and prev(x > 0)"),
        (typed.Not(SPAN, typed.Edge(SPAN, "rise", X)), "x <= 0 or prev(x > 0)"),
    ],
)
def test_negation_sinks_into_predicates(formula: typed.Formula, text: str) -> None:
    assert lowered(formula) == (text, [])


def test_shift_of_an_edge_is_false_at_the_first_sample() -> None:
    rise = GRID.lower(typed.Edge(SPAN, "rise", X), [])
    assert isinstance(rise, ir.BoolOp)
    assert isinstance(rise.items[1], ir.Shift)
    assert rise.items[1].outside is False


@pytest.mark.parametrize(
    ("lo", "hi", "opened", "window"),
    [
        ("0.2", "0.5", "[]", "[2..5]"),
        ("0.2", "0.5", "(]", "[3..5]"),
        ("0.2", "0.5", "[)", "[2..4]"),
        ("0.2", "0.5", "()", "[3..4]"),
        ("0.2", None, "[]", "[2..end]"),
        ("0.2", None, "(]", "[3..end]"),
    ],
)
def test_bounds_on_the_grid(lo: str, hi: str | None, opened: str, window: str) -> None:
    assert lowered(always(between(lo, hi, opened))) == (f"always{window} x > 0", [])


@pytest.mark.parametrize("opened", ["[]", "(]", "[)", "()"])
@pytest.mark.parametrize("negated", [False, True])
@pytest.mark.parametrize(
    ("op", "outward"), [("always", True), ("eventually", False), ("historically", True), ("once", False)]
)
def test_bounds_off_the_grid_are_rounded_for_the_polarity(
    op: str, outward: bool, negated: bool, opened: str
) -> None:
    formula: typed.Formula = typed.Temporal(SPAN, op, between("0.15", "0.55", opened), X)
    text, sink = lowered(typed.Not(SPAN, formula) if negated else formula)
    assert ("[1..6]" if outward is not negated else "[2..5]") in text
    assert [finding.code for finding in sink] == ["W304", "W304"]
    assert sink[0].message == "0.15 s is not a whole number of 0.1 s steps"
    assert sink[0].help == ("use 0.1 s or 0.2 s, or a dt that fits",)


def test_until_and_release_off_the_grid() -> None:
    interval = between("0.15", "0.55")
    assert "until[2..5]" in lowered(typed.Until(SPAN, "until", interval, X, Y))[0]
    assert "release[1..6]" in lowered(typed.Until(SPAN, "release", interval, X, Y))[0]


def test_a_bound_of_both_polarities_is_reported_once() -> None:
    late = typed.Temporal(SPAN, "always", between("0", "0.55"), X)
    assert codes(typed.Logic(SPAN, "<->", (late, Y))) == ["W304"]


def test_horizon_steps_and_seconds_add_up() -> None:
    hi = typed.Time(seconds=Fraction("-0.2"), steps=Fraction(1), horizons=Fraction(2))
    assert lowered(always(typed.Interval(typed.Time(), hi)))[0] == "always[0..11] x > 0"


@pytest.mark.parametrize(
    ("interval", "code"),
    [
        (between("0.2", "0.2", "[)"), "E305"),
        (between("0.2", "0.3", "()"), "E305"),
        (between("0.5", "0.2"), "E301"),
        (between("-0.1", "0.2"), "E302"),
        (between("0", "1e18"), "E005"),
        (between("1e30", None), "E005"),
    ],
)
def test_intervals_without_samples(interval: typed.Interval, code: str) -> None:
    assert codes(always(interval)) == [code]


def test_nothing_between_two_samples() -> None:
    inside = between("0.22", "0.28")
    assert codes(typed.Temporal(SPAN, "eventually", inside, X)) == ["W304", "W304", "E305"]
    assert codes(always(inside)) == ["W304", "W304"]


def test_what_the_grid_must_say() -> None:
    horizon = typed.Interval(typed.Time(), typed.Time(horizons=Fraction(1)))
    steps = typed.Interval(typed.Time(), typed.Time(steps=Fraction(3)))
    assert codes(always(horizon), Grid(Fraction(1, 10), None)) == ["E311"]
    assert codes(always(between("0", "1")), Grid(None, 5)) == ["E311"]
    assert lowered(always(steps), Grid()) == ("always[0..3] x > 0", [])
    assert lowered(always(horizon), Grid(None, 5)) == ("always[0..5] x > 0", [])


def test_unless_in_unless_is_lowered_twice_not_three_times() -> None:
    def work(depth: int) -> int:
        formula: typed.Formula = X
        for _ in range(depth):
            formula = typed.Until(SPAN, "unless", between("0", "0.1"), formula, Y)
        return effort(lambda: GRID.lower(formula, []))

    assert work(9) < 2.5**2 * work(7)


def test_an_absolute_interval_is_judged_at_the_first_sample_wherever_it_stands() -> None:
    early = typed.Temporal(SPAN, "eventually", replace(between("0", "0.2"), clock="start"), X)
    formula = typed.Until(SPAN, "until", between("0", "0.1"), Y, typed.Not(SPAN, early))
    assert lowered(formula)[0] == "y >= 0 until[0..1] at the start (always[0..2] x <= 0)"
    node = GRID.lower(formula, [])
    assert node.reach.future == 2
    x, y = np.array([-1.0, -2.0, -3.0, 4.0])[:, None], np.ones((4, 1))
    np.testing.assert_array_equal(defined(node, 4), [True, True, True, False])
    value = robustness_signal(node, {"x": x, "y": y}, ops=NUMPY, end="truncate")
    np.testing.assert_array_equal(value[:, 0], 1.0)
