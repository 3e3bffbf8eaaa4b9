"""Intervals contain the values at every point of the box: functions, expressions and formulas."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from helpers import formula_strategies as random_formulas
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array import interval
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.interval import (
    EPSILON,
    PRODUCT,
    SUM,
    TINY,
    Intervals,
    RoundingError,
    add,
    bound,
    div,
    mul,
)
from stlc.compile.backends.array.interval_ops import INTERVALS, IntervalOps, _anything
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS
from stlc.compile.ir.simplify import simplify
from stlc.compile.namespace import Ops, Sliding
from stlc.compile.semantics.kinds.smooth import LogSumExp
from stlc.compile.semantics.switch import StraightThrough, Tanh
from stlc.diagnostics import UsageError

X, Y, Z = map(ir.Signal, "xyz")
NAMED = sorted(name for name, function in FUNCTIONS.items() if function.kind != "sampler")
EXACT = ("neg", "abs", "min", "max", "clip", "relu", "floor", "ceil", "round", "sign", "norminf")
"""Functions without rounding error."""


def values(num: ir.Num, env: dict[str, Any], ops: Ops = NUMPY, **more: Any) -> Any:
    """Values of a number; as margins of predicates, all numbers where an interval may be undefined."""
    return ops.margin(ArrayProgram({"out": num}, **more)(env, ops)["out"])


def call(name: str) -> ir.Num:
    return ir.Op(name, (X, Y, Z)[: FUNCTIONS[name].least + (FUNCTIONS[name].most is None)])


def boxes(rng: np.random.Generator, count: int) -> Intervals:
    """Boxes of all magnitudes and widths, on both sides of 0 and around it, some with ends at 0 and 1."""
    centre = rng.normal(size=count) * 10.0 ** rng.integers(-3, 4, count)
    width = np.abs(rng.normal(size=count)) * 10.0 ** rng.integers(-9, 3, count)
    centre = np.where(rng.random(count) < 0.2, rng.integers(-3, 4, count), centre)
    width = np.where(rng.random(count) < 0.3, rng.integers(0, 3, count), width)
    return Intervals(centre - width, centre + width)


def inside(box: Intervals, rng: np.random.Generator) -> np.ndarray:
    """A point of each box: an end, the middle or any."""
    share = rng.choice([0.0, 1.0, 0.5, rng.random()], size=box.shape)
    return np.clip(box.low + share * (box.high - box.low), box.low, box.high)


@pytest.mark.parametrize("name", NAMED)
def test_every_function_of_the_table_contains_its_values(name: str) -> None:
    rng = np.random.default_rng(len(name))
    env = {key: boxes(rng, 3000) for key in "xyz"}
    found = values(call(name), env, INTERVALS)
    after = values(ir.Op("atan", (call(name),)), env, INTERVALS)
    assert not np.isnan(found.low).any()
    assert not np.isnan(found.high).any()
    known = 0
    for _ in range(12):
        with np.errstate(all="ignore"):
            point = values(call(name), {key: inside(box, rng) for key, box in env.items()})
        defined = ~np.isnan(point)
        known += int(defined.sum())
        assert ((found.low <= point) & (point <= found.high))[defined].all()
        for end in (found.low, found.high, after.low, after.high):
            assert np.isinf(end[~defined]).all()
    assert known > 300


@pytest.mark.parametrize("name", NAMED)
def test_a_box_without_width_is_the_value_up_to_rounding(name: str) -> None:
    rng = np.random.default_rng(7)
    env = {key: rng.uniform(0.1, 0.9, 500) + (key == "z") for key in "xyz"}
    found = values(call(name), {key: Intervals.point(each) for key, each in env.items()}, INTERVALS)
    point = values(call(name), env)
    if name in EXACT:
        assert found.low is found.high
        assert (found.low == point).all()
    assert (found.low <= point).all()
    assert (point <= found.high).all()
    assert (found.high - found.low <= 1e-14 * (1.0 + np.abs(point))).all()


FINITE = st.floats(-1e300, 1e300, allow_subnormal=True)


@settings(max_examples=48, deadline=None)
@given(st.lists(FINITE, min_size=4, max_size=4), st.lists(st.floats(0, 1), min_size=2, max_size=2))
def test_sums_products_and_quotients_contain_the_exact_values(ends: list[float], shares: list[float]) -> None:
    (a, b), (c, d) = sorted(ends[:2]), sorted(ends[2:])
    one, other = Intervals(np.array([a]), np.array([b])), Intervals(np.array([c]), np.array([d]))
    x, y = (
        Fraction(low) + Fraction(share) * (Fraction(high) - Fraction(low))
        for (low, high), share in zip(((a, b), (c, d)), shares, strict=True)
    )
    with np.errstate(all="ignore"):
        for found, exact in ((add(one, other), x + y), (mul(one, other), x * y)):
            assert holds(found, exact)
        assert holds(INTERVALS.square(one), x * x)
        if c <= 0 <= d:
            assert pair(INTERVALS.margin(div(one, other))) == UNKNOWN
        else:
            assert holds(div(one, other), x / y)


def holds(found: Intervals, exact: Fraction) -> bool:
    low, high = float(found.low[0]), float(found.high[0])
    return (low == -math.inf or Fraction(low) <= exact) and (high == math.inf or exact <= Fraction(high))


def floats(bits: list[int]) -> np.ndarray:
    """Finite numbers and their float64 neighbours, ascending."""
    found = np.array(bits, dtype=np.int64).view(np.float64)
    found = np.concatenate([-found, found])
    found = found[np.isfinite(found) & (np.abs(found) < 1e290)]
    return np.sort(np.concatenate([found, np.nextafter(found, np.inf), np.nextafter(found, -np.inf)]))


@given(st.lists(st.one_of(st.integers(0, 2**62), st.integers(0, 2**54)), min_size=1, max_size=20))
@pytest.mark.parametrize("error", [SUM, PRODUCT, RoundingError(10 * EPSILON, 8 * TINY)])
def test_moved_ends_ascend_with_the_computed_ones_and_pass_their_neighbours(error, bits) -> None:
    computed = floats(bits)
    found = Intervals(computed, computed, error)
    assert (np.diff(found.low) >= 0).all()
    assert (np.diff(found.high) >= 0).all()
    normal = np.abs(computed) >= 2.0**-1022
    moved = normal | (error.absolute > 0.0)
    assert (found.low <= np.where(moved, np.nextafter(computed, -np.inf), computed)).all()
    assert (found.high >= np.where(moved, np.nextafter(computed, np.inf), computed)).all()


def moved(x: Intervals) -> Intervals:
    """The same intervals, moved outward now."""
    return Intervals(x.low, x.high)


def selections(parts: list[Intervals]) -> list[Intervals]:
    """Extrema and other selections from arrays of shape (100, 4), and sums with some of them."""
    window = Sliding(100, 94, 7)
    padded = INTERVALS.cat([parts[1], INTERVALS.full((1, 4), math.inf, parts[1])])
    return [
        *(INTERVALS.join(parts, "min"), INTERVALS.join(parts, "max"), INTERVALS.cat(parts), padded),
        *(INTERVALS.windows(parts[:1], "min", window), INTERVALS.windows(parts[3:5], "max", window)),
        *(INTERVALS.minimum(*parts[:2]), INTERVALS.maximum(*parts[3:5]), -parts[2], parts[0][::-1]),
        *(INTERVALS.rows([range(50, 100)], parts[1], math.inf), add(padded, 1.0), mul(padded, padded)),
    ]


def test_selections_of_sums_are_those_of_moved_sums() -> None:
    rng = np.random.default_rng(5)
    sums = [add(boxes(rng, 400).reshape(100, 4), 0.1 * (k + 1)) for k in range(4)]
    sums += [mul(sums[0], 0.3), boxes(rng, 400).reshape(100, 4), add(Intervals.point(np.ones((100, 4))), 0.1)]
    with np.errstate(invalid="ignore"):
        late, early = selections(sums), selections([moved(each) for each in sums])
    for one, other in zip(late, early, strict=True):
        assert (one.low == other.low).all()
        assert (one.high == other.high).all()


def test_the_minimum_of_ten_sums_is_moved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    apart = interval._moved_apart
    monkeypatch.setattr(interval, "_moved_apart", lambda ends: calls.append(1) or apart(ends))
    atoms = tuple(ir.Predicate(ir.Op("sub", (X, ir.Const(0.1 * k)))) for k in range(1, 11))
    box = Intervals(np.zeros((20, 2)), np.ones((20, 2)))
    formula = ir.Temporal("always", ir.Window(0, 5), ir.BoolOp("and", atoms))
    (found,) = evaluate([formula], {"x": box}, ops=INTERVALS, count=15)
    assert pair(found[:1, 0]) == pytest.approx((-1.0, 0.0))
    assert len(calls) == 1


# ------------------------------------------------------------------------------- special cases


def one(low: float, high: float) -> Intervals:
    return Intervals(np.array([low]), np.array([high]))


def pair(found: Intervals) -> tuple[float, float]:
    return float(found.low[0]), float(found.high[0])


UNKNOWN = (-math.inf, math.inf)


@pytest.mark.parametrize(
    ("num", "box", "wanted"),
    [
        (ir.Op("div", (ir.Const(1.0), X)), (-1, 2), UNKNOWN),
        (ir.Op("div", (ir.Const(1.0), X)), (0, 2), UNKNOWN),
        (ir.Op("mod", (ir.Const(5.0), X)), (-1, 2), UNKNOWN),
        (ir.Op("sqrt", (X,)), (-1, 4), UNKNOWN),
        (ir.Op("log", (X,)), (-1, 4), UNKNOWN),
        (ir.Op("asin", (X,)), (0, 2), UNKNOWN),
        (ir.Op("tan", (X,)), (1, 2), UNKNOWN),
        (ir.Op("pow", (X, ir.Const(0.5))), (-1, 2), UNKNOWN),
        (ir.Op("pow", (X, ir.Const(-2.0))), (-1, 2), UNKNOWN),
        (ir.Op("sin", (X,)), (0, 10), (-1, 1)),
        (ir.Op("sin", (X,)), (1, 2), (math.sin(1), 1)),
        (ir.Op("sin", (X,)), (4, 5), (-1, math.sin(4))),
        (ir.Op("cos", (X,)), (-1, 0.5), (math.cos(1), 1)),
        (ir.Op("cos", (X,)), (3, 4), (-1, math.cos(4))),
        (ir.Op("sin", (X,)), (1e300, 1e300), (-1, 1)),
        (ir.Op("pow", (X, ir.Const(2.0))), (-3, 2), (0, 9)),
        (ir.Op("pow", (X, ir.Const(3.0))), (-3, 2), (-27, 18)),  # as x^2 * x
        (ir.Op("pow", (ir.Const(2.0), X)), (-1, 3), (0.5, 8)),
        (ir.Op("pow", (X, ir.Const(-2.0))), (-4, -2), (0.0625, 0.25)),
        (ir.Op("pow", (X, ir.Const(5.0))), (-3, 2), (-243, 32)),
        (ir.Op("pow", (X, X)), (-3, -3), (-1 / 27, -1 / 27)),
        (ir.Op("pow", (X, X)), (1, 2), (1, 4)),
        (ir.Op("mod", (X, ir.Const(3.0))), (4, 5), (1, 2)),
        (ir.Op("mod", (X, ir.Const(3.0))), (5, 7), (0, 3)),
        (ir.Op("mod", (X, ir.Const(-3.0))), (4, 5), (-2, -1)),
        (ir.Op("mod", (X, ir.Const(3.0))), (-1, 20), (0, 3)),
        (ir.Op("atan2", (ir.Const(1.0), X)), (-1, 1), (math.pi / 4, 3 * math.pi / 4)),
        (ir.Op("atan2", (X, ir.Const(-1.0))), (-1, 1), (-math.pi, math.pi)),
        (ir.Op("norm", (X, ir.Const(4.0))), (-3, 1), (4, 5)),
        (ir.Op("floor", (X,)), (0.5, 2.5), (0, 2)),
        (ir.Indicator(ir.Predicate(X)), (-1, 1), (0, 1)),
        (ir.Indicator(ir.Predicate(X)), (0, 1), (1, 1)),
        (ir.Indicator(ir.Predicate(X, strict=True)), (0, 1), (0, 1)),
        (ir.Indicator(ir.Predicate(X, sign=-1)), (1, 2), (0, 0)),
        (ir.Op("mul", (ir.Indicator(ir.Predicate(X, sign=-1)), X)), (1, math.inf), (0, 0)),
        (ir.Op("mul", (ir.Indicator(ir.Predicate(X)), X)), (-1, math.inf), (-1, math.inf)),
        (ir.Where(ir.Predicate(X), ir.Const(5.0), X), (-1, 1), (-1, 5)),
        (ir.Where(ir.Predicate(X), X, ir.Const(5.0)), (1, 2), (1, 2)),
    ],
)
def test_a_value_by_hand(num: ir.Num, box: tuple[float, float], wanted: tuple[float, float]) -> None:
    found = pair(values(num, {"x": one(*map(float, box))}, INTERVALS))
    assert found == pytest.approx(wanted, abs=1e-12)
    assert found[0] <= wanted[0]
    assert wanted[1] <= found[1]


@pytest.mark.parametrize("name", ["pow", "atan2"])
@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_the_sign_of_a_zero_is_known_for_exact_operands_only(name: str, zero: float) -> None:
    """The power has a pole at 0, and the angle a cut beside it; operations on boxes lose the sign."""
    num, others = call(name), np.array([-3.0, -2.0, -1.0])
    for first in (Intervals(np.full(3, zero), np.ones(3)), Intervals(np.full(3, zero), np.full(3, zero))):
        found = values(num, {"x": first, "y": Intervals.point(others)}, INTERVALS)
        for sign in (1.0, -1.0):
            with np.errstate(all="ignore"):
                point = values(num, {"x": np.full(3, sign * 0.0), "y": others})
            assert ((found.low <= point) & (point <= found.high)).all()
    with np.errstate(all="ignore"):
        exact = values(num, {"x": Intervals.point(np.full(3, zero)), "y": Intervals.point(others)}, INTERVALS)
        point = values(num, {"x": np.full(3, zero), "y": others})
    assert ((exact.low <= point) & (point <= exact.high)).all()
    assert name == "pow" or (exact.high - exact.low < 1e-13).all()


def test_every_function_has_a_tight_method() -> None:
    for name, function in FUNCTIONS.items():
        found = getattr(IntervalOps, name, None)
        assert function.numpy == "" or getattr(found, "func", None) is not _anything, name


def test_a_function_without_a_method_is_bounded_by_its_table_entry() -> None:
    assert pair(INTERVALS.margin(_anything(None, one(0.0, 1.0)))) == UNKNOWN
    assert pair(INTERVALS.margin(_anything((-1.0, 2.0), one(math.nan, math.nan)))) == UNKNOWN
    low, high = pair(_anything((-1.0, 2.0), one(0.0, 1.0), 3.0))
    assert (low, high) == pytest.approx((-1.0, 2.0))
    assert (low <= -1.0, high >= 2.0) == (True, True)


ROOT = ir.Op("sqrt", (X,))
HALVES = ir.Op("div", (ir.Const(1.0), X))


@pytest.mark.parametrize(
    "num",
    [
        *(ir.Op(name, (ROOT,)) for name in ("abs", "square", "sin", "cos", "relu", "sign", "atan", "tanh")),
        *(ir.Op(name, (HALVES,)) for name in ("sin", "cosh", "exp", "floor")),
        ir.Op("clip", (ROOT, ir.Const(0.0), ir.Const(1.0))),
        *(ir.Op(name, (HALVES, ir.Const(2.0))) for name in ("min", "max", "mod", "pow", "atan2", "norm")),
        *(ir.Op(name, (ir.Const(2.0), HALVES)) for name in ("min", "mod", "pow", "atan2", "norm", "div")),
        ir.Op("mul", (ROOT, ROOT)),
        ir.Where(ir.Predicate(Y), ROOT, ir.Const(1.0)),
    ],
)
def test_what_is_computed_from_an_undefined_value_is_not_bounded_again(num: ir.Num) -> None:
    box = {"x": one(-1.0, 4.0), "y": one(-1.0, 1.0)}
    assert pair(values(num, box, INTERVALS)) == UNKNOWN
    (found,) = evaluate([ir.Predicate(num)], box, ops=INTERVALS)
    assert pair(found) == UNKNOWN


def test_a_sine_of_what_may_be_infinite_is_undefined() -> None:
    assert pair(values(ir.Op("sin", (X,)), {"x": one(0.0, math.inf)}, INTERVALS)) == UNKNOWN
    assert pair(values(ir.Op("exp", (X,)), {"x": one(0.0, 1e9)}, INTERVALS))[1] == math.inf


def test_a_condition_on_an_undefined_value_is_unknown_and_its_choice_is_not() -> None:
    choice = ir.Where(ir.Predicate(ROOT), ir.Const(1.0), ir.Const(2.0))
    assert pair(values(choice, {"x": one(-1.0, 4.0)}, INTERVALS)) == pytest.approx((1.0, 2.0))
    aside = ir.Where(ir.Predicate(Y), ir.Const(1.0), ROOT)
    assert pair(values(aside, {"x": one(-1.0, 4.0), "y": one(1.0, 2.0)}, INTERVALS)) == (1.0, 1.0)


def test_a_root_of_squares_is_known_at_0() -> None:
    num = ir.Op("sqrt", (ir.Op("add", (ir.Op("square", (X,)), ir.Op("mul", (Y, Y)))),))
    found = pair(values(num, {"x": one(0.0, 0.0), "y": one(0.0, 0.0)}, INTERVALS))
    assert found[0] == 0.0
    assert found[1] == pytest.approx(0.0, abs=1e-150)


def test_numbers_and_arrays_are_operands() -> None:
    box, weights = Intervals(np.zeros(3), np.ones(3)), np.array([1.0, -2.0, 4.0])
    assert mul(box, weights).low == pytest.approx([0.0, -2.0, 0.0])
    assert add(box, weights).high == pytest.approx([2.0, -1.0, 5.0])
    assert float(add(0.25, 0.5).high) == pytest.approx(0.75)
    assert bound(add(box, -3.0)) == pytest.approx(4.0)
    assert (bound(weights), bound(Intervals.point([1.0, math.nan]))) == (4.0, math.inf)


def test_overflow_is_contained() -> None:
    huge = one(1e308, 1.5e308)
    with np.errstate(over="ignore", invalid="ignore"):
        assert pair(add(huge, huge))[1] == math.inf
        assert pair(mul(huge, huge))[1] == math.inf


@pytest.mark.parametrize("switch", [Tanh(2.0), StraightThrough()])
def test_smooth_switches_contain_their_values(switch: Any) -> None:
    rng = np.random.default_rng(3)
    num = ir.Where(ir.Predicate(ir.Op("sub", (X, Y))), ir.Op("mul", (X, Y)), ir.Op("add", (X, Y)))
    program, env = ArrayProgram({"out": num}), {"x": boxes(rng, 2000), "y": boxes(rng, 2000)}
    found = program(env, INTERVALS, switch)["out"]
    for _ in range(10):
        point = program({key: inside(box, rng) for key, box in env.items()}, NUMPY, switch)["out"]
        slack = 1e-12 * np.abs(point)  # NumPy blends by another formula, also within the hull
        assert ((found.low - slack <= point) & (point <= found.high + slack)).all()


def test_smooth_extrema_are_refused() -> None:
    with pytest.raises(UsageError, match="exact extrema"):
        evaluate(
            [ir.Temporal("always", ir.Window(0, 1), ir.Predicate(X))],
            {"x": Intervals.point(np.zeros((2, 1)))},
            ops=INTERVALS,
            semantics=LogSumExp(5.0),
        )


def test_sums_along_time_contain_theirs() -> None:
    rng = np.random.default_rng(4)
    box = boxes(rng, 300).reshape(100, 3)
    found = INTERVALS.sum(box)
    for _ in range(10):
        exact = [math.fsum(column) for column in inside(box, rng).T]
        assert (found.low[0] <= exact).all()
        assert (exact <= found.high[0]).all()


def test_indexing_keeps_both_ends() -> None:
    box = Intervals(np.arange(6.0).reshape(3, 2), np.arange(6.0).reshape(3, 2) + 1)
    assert (box.T.shape, box.ndim, len(box)) == ((2, 3), 2, 3)
    assert (box.swapaxes(0, 1).high == box.high.T).all()
    assert ((-box).low == -box.high).all()
    moved = 1.0 + (box - 1.0) * 2.0
    assert (moved.low <= 2 * box.low - 1).all()
    parts = INTERVALS.columns(Intervals(np.zeros((4, 5, 2)), np.ones((4, 5, 2))))
    assert [part.shape for part in parts] == [(5, 4), (5, 4)]
    assert INTERVALS.stack([box, box]).shape == (2, 3, 2)
    assert INTERVALS.empty((2, 2), box).shape == (2, 2)
    assert INTERVALS.settled(box, INTERVALS.gt(box[:1], 0.5)).shape == box.shape


# --------------------------------------------------------------------------- random formulas

widths = st.sampled_from([0.0, 0.01, 0.125, 0.5, 3.0])


def around(trace: dict[str, np.ndarray], width: float, rng: np.random.Generator) -> dict[str, Intervals]:
    sizes = {name: width * rng.random(x.shape) * (rng.random(x.shape) < 0.7) for name, x in trace.items()}
    return {name: Intervals(x - sizes[name], x + sizes[name]) for name, x in trace.items()}


def check_formula(
    formula: ir.Formula, trace: dict[str, np.ndarray], end: Any, width: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    box = around(trace, width, rng)
    count = len(trace["x"])
    (found,) = evaluate([formula], box, ops=INTERVALS, end=end, count=count)
    assert not np.isnan(found.low).any()
    assert not np.isnan(found.high).any()
    for _ in range(4):
        env = {name: inside(each, rng) for name, each in box.items()}
        (point,) = evaluate([formula], env, ops=NUMPY, end=end, count=count)
        defined = ~np.isnan(point)
        assert ((found.low <= point) & (point <= found.high))[defined].all()
    jumps = any(isinstance(node, ir.Predicate) and node.guard for node in formula.walk())
    if not width and not jumps:
        np.testing.assert_allclose(found.low, point, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.high, point, rtol=0, atol=1e-12)


def check_number(num: ir.Num, trace: dict[str, np.ndarray], width: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = around(trace, width, rng)
    found = values(num, box, INTERVALS)
    for _ in range(4):
        with np.errstate(all="ignore"):
            point = values(num, {name: inside(each, rng) for name, each in box.items()})
        defined = ~np.isnan(point)
        assert ((found.low <= point) & (point <= found.high))[defined].all()


ends = st.sampled_from(["truncate", "lower", "upper"])
seeds = st.integers(0, 2**32 - 1)
any_formula = random_formulas.formulas(held=())
any_trace = random_formulas.traces(1, 14, 3)


def lowered(written: Any) -> ir.Formula:
    return simplify(random_formulas.GRID.lower(written, []))


@settings(max_examples=48, deadline=None)
@given(any_formula, any_trace, ends, widths, seeds)
def test_bounds_of_random_formulas_contain_every_point(written, trace, end, width, seed) -> None:
    check_formula(lowered(written), trace, end, width, seed)


@settings(max_examples=48, deadline=None)
@given(random_formulas.numbers, any_trace, widths, seeds)
def test_bounds_of_random_numbers_contain_every_point(num, trace, width, seed) -> None:
    check_number(num, trace, width, seed)


@pytest.mark.bench
@settings(max_examples=10_000, deadline=None, suppress_health_check=list(HealthCheck))
@given(any_formula, any_trace, ends, widths, seeds)
def test_bounds_of_many_formulas(written, trace, end, width, seed) -> None:
    check_formula(lowered(written), trace, end, width, seed)


@pytest.mark.bench
@settings(max_examples=5000, deadline=None, suppress_health_check=list(HealthCheck))
@given(random_formulas.numbers, any_trace, widths, seeds)
def test_bounds_of_many_numbers(num, trace, width, seed) -> None:
    check_number(num, trace, width, seed)


def test_long_traces_use_the_same_algorithms() -> None:
    rng = np.random.default_rng(1)
    trace = {name: rng.normal(size=(3000, 40)) for name in "xy"}
    predicates = ir.Predicate(X), ir.Predicate(ir.Op("sub", (Y, ir.Const(0.25))))
    for formula in (
        ir.Temporal("always", ir.Window(0, 200), predicates[0]),
        ir.PastTemporal("once", ir.Window(3, 77), predicates[1]),
        ir.Until("until", ir.Window(2, 90), *predicates),
        ir.Since("since", ir.Window(0, None), *predicates),
    ):
        check_formula(formula, trace, "truncate", 0.5, 2)
