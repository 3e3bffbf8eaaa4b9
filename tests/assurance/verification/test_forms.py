"""Affine forms contain the values at every point of the box, for given values of the shared symbols."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers import formula_strategies as random_formulas
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.assurance.verification import judged
from stlc.assurance.verification.forms import FORMS, Forms, ranges, tanh
from stlc.assurance.verification.judged import Judge
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir

BATCH, SYMBOLS = 5, 3


def drawn(rng: np.random.Generator, width: float) -> Forms:
    generators = rng.normal(size=(int(rng.integers(0, SYMBOLS + 1)), BATCH)) * width
    rest = np.abs(rng.normal(size=BATCH)) * width * (rng.random() < 0.5)
    return Forms(rng.integers(-16, 16, BATCH) / 8.0, generators, rest)


def value(form: Forms, symbols: np.ndarray, own: np.ndarray) -> Any:
    return form.centre + np.tensordot(symbols[: len(form.generators)], form.generators, 1) + own * form.rest


def check(num: ir.Num, seed: int, width: float) -> None:
    rng = np.random.default_rng(seed)
    env = {name: drawn(rng, width) for name in random_formulas.NAMES}
    program = ArrayProgram({"out": num})
    found = program(env, FORMS)["out"]
    low, high = found.range.low, found.range.high
    for _ in range(8):
        symbols = rng.choice([-1.0, 1.0, rng.uniform(-1, 1)], SYMBOLS)
        point = {name: value(form, symbols, rng.uniform(-1, 1, BATCH)) for name, form in env.items()}
        exact = program(point, NUMPY)["out"]
        assert ((low <= exact) & (exact <= high)).all()
        linear = value(found, symbols, np.zeros(BATCH))
        with np.errstate(invalid="ignore"):
            off = np.abs(exact - linear) > found.rest + 1e-9 * (1.0 + np.abs(found.centre) + found.radius)
        assert not off.any()


@settings(max_examples=36, deadline=None)
@given(random_formulas.numbers, st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.05, 0.5, 3.0]))
def test_random_numbers_stay_within_their_forms(num: ir.Num, seed: int, width: float) -> None:
    check(num, seed, width)


@pytest.mark.bench
@settings(max_examples=5000, deadline=None)
@given(random_formulas.numbers, st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.05, 0.5, 3.0]))
def test_many_random_numbers(num: ir.Num, seed: int, width: float) -> None:
    check(num, seed, width)


def symbol(low: float, high: float) -> Forms:
    half = 0.5 * (high - low)
    return Forms(np.array([low + half]), np.array([[half]]), np.zeros(1))


def test_dependent_quantities_cancel() -> None:
    x = symbol(-1.0, 1.0)
    assert FORMS.sub(x, x).radius == 0.0
    assert FORMS.gt(FORMS.add(x, 0.1), x).sure.all()


@pytest.mark.parametrize(("low", "high"), [(0.0, 4.0), (1.0, 1.1), (0.0, 1e-9), (-1e-12, 1.0)])
def test_roots_of_what_is_not_negative(low: float, high: float) -> None:
    x = symbol(low, high)
    found = FORMS.sqrt(x)
    for share in np.linspace(-1, 1, 41):
        exact = np.sqrt(max(float(value(x, np.array([share]), np.zeros(1))[0]), 0.0))
        linear = float(value(found, np.array([share]), np.zeros(1))[0])
        assert abs(exact - linear) <= found.rest[0] + 1e-12


def test_roots_of_what_may_be_negative_are_undefined_there_alone() -> None:
    x = Forms(np.array([0.45, 1.0]), np.array([[0.55, 0.5]]), np.zeros(2))
    with FORMS.quiet():
        found = FORMS.sqrt(x)
    assert np.isnan([found.range.low[0], found.range.high[0]]).all()
    alone = FORMS.sqrt(x.at(np.array([1])))
    assert (found.range.low[1], found.range.high[1]) == (alone.range.low[0], alone.range.high[0])


def test_what_follows_a_relu_has_a_root() -> None:
    found = FORMS.sqrt(FORMS.maximum(symbol(-1.0, 1.0), 0.0))
    assert found.range.high[0] >= 1.0
    with FORMS.quiet():
        lower = FORMS.sqrt(FORMS.add(FORMS.maximum(symbol(-1.0, 1.0), 0.0), -0.5))
    assert np.isnan(lower.range.low[0])


@pytest.mark.parametrize(
    "kept",
    [
        lambda x: FORMS.maximum(x, 1e-18),
        lambda x: FORMS.clamp(x, 1e-18, None),
        lambda x: FORMS.clamp(x, 1e-18, 1.0),
        lambda x: -FORMS.minimum(-x, -1e-18),
    ],
)
def test_a_divisor_that_is_kept_away_from_zero_is_never_zero(kept: Callable[[Forms], Forms]) -> None:
    """So `sweep` divides by the squared length of a segment, however short."""
    found = FORMS.clamp(FORMS.div(symbol(-1.0, 1.0), kept(symbol(-1e-9, 2e-9))), 0.0, 1.0).range
    assert 0.0 <= found.low[0] <= found.high[0] <= 1.0


def test_the_tangent_is_followed() -> None:
    for low, high in ((-3.0, 2.0), (0.5, 0.6), (-9.0, 9.0), (2.0, 2.0)):
        x = symbol(low, high)
        found = tanh(x)
        for share in np.linspace(-1, 1, 41):
            exact = np.tanh(value(x, np.array([share]), np.zeros(1)))
            assert np.abs(exact - value(found, np.array([share]), np.zeros(1))) <= found.rest


def test_what_is_not_finite_may_be_anything() -> None:
    box = FORMS.div(Forms.point(np.ones(1)), symbol(-1.0, 1.0))
    found = INTERVALS.margin(box.range)
    assert (found.low[0], found.high[0]) == (-np.inf, np.inf)
    assert ranges([box, box]).shape == (2, 1)


@pytest.mark.parametrize(
    "function",
    [
        *(FORMS.abs, FORMS.square, FORMS.sin, FORMS.cos, FORMS.relu, FORMS.tanh, FORMS.sigmoid, FORMS.exp),
        lambda x: FORMS.clamp(x, 0.0, 1.0),
        lambda x: FORMS.minimum(x, Forms.point(np.ones(1))),
        lambda x: FORMS.mod(x, 2.0),
        lambda x: FORMS.where(FORMS.gt(symbol(-1.0, 1.0), 0.0), x, 1.0),
    ],
)
def test_what_is_computed_from_an_undefined_form_is_undefined(function: Callable[[Forms], Forms]) -> None:
    with FORMS.quiet():
        for undefined in (
            FORMS.div(Forms.point(np.ones(1)), symbol(-1.0, 1.0)),
            FORMS.log(symbol(-1.0, 1.0)),
        ):
            found = function(undefined).range
            assert np.isnan(found.low).all()
            assert np.isnan(found.high).all()


def test_a_choice_without_the_undefined_branch_is_known() -> None:
    with FORMS.quiet():
        undefined = FORMS.log(symbol(-1.0, 1.0))
        assert FORMS.where(FORMS.gt(symbol(1.0, 2.0), 0.0), 3.0, undefined).range.low[0] == pytest.approx(3.0)
        truth = FORMS.gt(undefined, 0.0)
    assert (truth.sure.item(), truth.possible.item()) == (False, True)


@pytest.mark.parametrize(
    "num",
    [
        ir.Op("abs", (ir.Op("log", (ir.Signal("x"),)),)),
        ir.Op("abs", (ir.ShiftedSignal("x", 1),)),  # beyond the last sample a predicate is false
    ],
)
def test_a_margin_that_may_be_undefined_proves_nothing(num: ir.Num) -> None:
    verdicts = Judge([ir.Predicate(num)], end="truncate")({"x": [symbol(-0.5, 1.0)]}, 1)
    assert verdicts.low.tolist() == [-np.inf]


def test_formulas_over_many_samples_are_bounded_in_parts_as_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    history = {"x": [symbol(0.1 * i - 1.0, 1.5) for i in range(12)]}
    read = ir.Op("sub", (ir.Signal("x"), ir.ShiftedSignal("x", 1)))
    formulas = [ir.Predicate(read), ir.Predicate(ir.Op("abs", (ir.Signal("x"),)))]
    judge = Judge(formulas, end="truncate")
    whole = judge.bounds(history)
    monkeypatch.setattr(judged, "_ROOM", 2)
    parts, alone = judge.bounds(history), Judge(formulas, end="truncate", shifts=False).bounds(history)
    np.testing.assert_array_equal(parts.low, whole.low)
    np.testing.assert_array_equal(parts.high, whole.high)
    assert whole.low[:, 0].tolist() == pytest.approx([-0.1, 0.0], abs=1e-6)  # one symbol: a known difference
    assert alone.low[0, 0] < -2.0
    assert alone.low[1, 0] == whole.low[1, 0]
