"""Emitted gradients equal those of torch: functions, conditions, the steps of a system."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.emitted import (
    OPERATIONS,
    STEPS,
    adjoint_of,
    choosing,
    follower,
    gradients_agree,
    near_switches,
    slopes_agree,
)
from helpers.formula_strategies import NAMES

from stlc.compile.backends.c.emit import Motion
from stlc.compile.ir import nodes as ir
from stlc.controller.problem.kernel import ObjectiveSlopes
from stlc.native import compiler

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler here")


@pytest.mark.apart
def test_every_function_has_the_gradient_of_torch() -> None:
    columns = tuple(ir.Signal(name) for name in NAMES)
    nums: list[ir.Num] = [ir.Op(name, columns[:arity]) for name, arity in OPERATIONS.items()]
    positive = ir.Op("abs", (columns[0],))
    nums += [ir.Op("sqrt", (positive,)), ir.Op("log", (positive,)), ir.Op("pow", (positive, columns[1]))]
    nums += [
        ir.Op(name, (ir.Op("mul", (ir.Const(0.9), ir.Op("sin", (columns[0],)))),))
        for name in ("asin", "acos")
    ]
    cond = ir.BoolOp("or", (ir.Predicate(columns[0], strict=True), ir.Predicate(columns[1], sign=-1)))
    nums += [ir.Where(cond, columns[2], ir.Op("neg", (columns[1],)))]
    window = ir.Window(0, STEPS)
    rules = [ir.Temporal("always", window, ir.Predicate(num)) for num in nums]
    gradients_agree(rules, np.random.default_rng(1).normal(0, 2, (STEPS + 1, 60, 3)), 3)


def test_predicates_on_states_and_the_elapsed_time_have_the_gradient_of_torch() -> None:
    """A margin of a guard that grows along a plan, a predicate on time alone, and a freeze of the time."""
    x, y, elapsed = ir.Signal("x"), ir.Signal("y"), ir.Signal(ir.ELAPSED)
    ramp = ir.Op("min", (ir.Op("mul", (elapsed, ir.Const(0.2))), ir.Const(1.0)))
    late = ir.Predicate(ir.Op("sub", (elapsed, ir.Const(3.0))))
    frozen = ir.Predicate(ir.Op("sub", (y, ir.Op("mul", (x, ir.FrozenVar("t0"))))))
    inside = ir.Freeze((("t0", elapsed),), ir.Temporal("always", ir.Window(0, 1), frozen))
    rules = [
        ir.Temporal("always", ir.Window(0, STEPS), ir.Predicate(ir.Op("sub", (x, ramp)))),
        ir.Temporal("eventually", ir.Window(0, STEPS), ir.BoolOp("and", (ir.Predicate(y), late))),
        ir.Temporal("always", ir.Window(0, STEPS - 1), inside),
    ]
    gradients_agree(rules, np.random.default_rng(1).normal(0, 2, (STEPS + 1, 60, 3)), 3)


def test_a_remainder_has_the_slope_of_torch_where_the_quotient_rounds_up() -> None:
    points = np.array([[1.0, 0.1, 0.0], [9.0, -0.3, 0.0], [-1.0, 0.1, 0.0], [0.6, 0.2, 0.0], [0.7, 3.0, 0.0]])
    slopes_agree([ir.Op("mod", (ir.Signal("x"), ir.Signal("y")))], points)


@pytest.mark.apart
@pytest.mark.parametrize("soft", [False, True])
def test_branches_that_are_not_taken_and_are_singular_have_no_gradient(soft: bool) -> None:
    x, y, z = (ir.Signal(name) for name in NAMES)
    far = ir.Predicate(ir.Op("sub", (ir.Op("abs", (y,)), ir.Const(0.1))))
    quotient = ir.Op("div", (z, y))
    branches = [
        quotient,
        ir.Op("mul", (x, ir.Op("sin", (quotient,)))),
        ir.Op("atan2", (y, y)),
        ir.Op("add", (ir.Op("log", (ir.Op("abs", (y,)),)), ir.Op("pow", (y, ir.Const(-1.5))))),
    ]
    nums: list[ir.Num] = [ir.Where(far, branch, z) for branch in branches]
    points = np.array([[0.3, 0.0, 0.7], [0.3, 0.5, 0.2]])
    for num in nums:
        if soft:
            motion = Motion(("state",), NAMES, (), {"state": num}, 1, 0.1)
            by_state = np.zeros((1, 2, 2))
            by_state[0, 1] = 1.0
            outcome = ObjectiveSlopes(np.zeros((2, 1)), by_state, 500.0)
            rule = ir.Predicate(ir.Signal("state"))
            found = adjoint_of(motion, [rule]).pull(np.zeros((2, 1)), points[:, None].copy(), outcome)
        else:
            trace = np.broadcast_to(points, (STEPS + 1, 2, 3)).copy()
            rule = ir.Temporal("always", ir.Window(1, 1), ir.Predicate(num))
            ones = ObjectiveSlopes(np.ones((2, 1)), None, 5.0)
            plans = trace[1:].transpose(1, 0, 2)
            found = adjoint_of(follower(), [rule]).pull(trace[0], plans, ones)
        assert found[0, 0].tolist() == [0.0, 0.0, 1.0], num
        assert np.isfinite(found).all()


def test_the_gradient_through_conditions_of_a_step_is_that_of_a_tanh() -> None:
    x, u = ir.Signal("x"), ir.Signal("u")
    after = ir.Where(ir.Predicate(x, strict=True), ir.Op("add", (x, u)), ir.Op("mul", (ir.Const(2.0), u)))
    motion = Motion(("x",), ("u",), (), {"x": after}, 1, 0.1)
    x0, plans, slope = np.array([[0.3], [-0.2]]), np.array([[[1.0]], [[3.0]]]), 4.0
    by_x = np.zeros((1, 2, 2))
    by_x[0, 1] = 1.0
    rule = ir.Predicate(x)
    found = adjoint_of(motion, [rule]).pull(x0, plans, ObjectiveSlopes(np.zeros((2, 1)), by_x, slope))
    assert found[:, 0, 0].tolist() == [1.0, 2.0]
    two = Motion(("x",), ("u",), (), {"x": after}, 2, 0.1)
    plans = np.array([[[0.1], [0.7]], [[0.1], [0.7]]])
    by_x = np.zeros((1, 3, 2))
    by_x[0, 2] = 1.0
    found = adjoint_of(two, [rule]).pull(x0, plans, ObjectiveSlopes(np.zeros((2, 1)), by_x, slope))
    first = np.array([0.3 + 0.1, 2 * 0.1])
    bump = 0.5 * slope / np.cosh(slope * first) ** 2
    through = 1.0 + bump * ((first + 0.7) - 2 * 0.7)
    np.testing.assert_allclose(found[:, 0, 0], np.array([1.0, 2.0]) * through, rtol=1e-12)


def test_choices_have_the_slope_of_torch_at_switches_and_near_them() -> None:
    slopes_agree(choosing(60, 0), near_switches(np.random.default_rng(0), 60))


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1, 40))
def test_many_choices_have_the_slope_of_torch(first: int) -> None:
    slopes_agree(choosing(150, first), near_switches(np.random.default_rng(first), 100))


@pytest.mark.parametrize("strict", [True, False])
def test_what_is_always_true_is_taken_whatever_the_strictness_of_its_parts(strict: bool) -> None:
    x, y, z = (ir.Signal(name) for name in NAMES)
    always = ir.BoolOp("or", (ir.Predicate(ir.Const(0.0), strict=not strict), ir.Predicate(y, strict=strict)))
    slopes_agree([ir.Where(always, z, x), ir.Indicator(always)], near_switches(np.random.default_rng(1), 60))


def test_equal_operands_share_the_slope() -> None:
    x, y, z = (ir.Signal(name) for name in NAMES)
    both = ir.BoolOp("and", (ir.Predicate(x), ir.Predicate(y)))
    choice = ir.Where(both, ir.Const(3.0), z)
    motion = Motion(("state",), NAMES, (), {"state": choice}, 1, 0.1)
    by_state, slope = np.zeros((1, 2, 1)), 2.0
    by_state[0, 1] = 1.0
    point = np.array([[[0.25, 0.25, 1.0]]])
    outcome = ObjectiveSlopes(np.zeros((1, 1)), by_state, slope)
    found = adjoint_of(motion, [ir.Predicate(ir.Signal("state"))]).pull(np.zeros((1, 1)), point, outcome)
    bump = 0.5 * slope / np.cosh(slope * 0.25) ** 2
    np.testing.assert_allclose(found[0, 0], [bump, bump, 0.0], rtol=1e-12)


def test_no_gradient_goes_through_fixed_states_and_broken_rows() -> None:
    x, u = ir.Signal("x"), ir.Signal("u")
    motion = Motion(("x",), ("u",), (), {"x": ir.Op("add", (x, u))}, 3, 0.1)
    rule = ir.Temporal("always", ir.Window(0, 3), ir.Predicate(x))
    x0, plans = np.array([[0.0], [np.nan]]), np.full((2, 3, 1), -1.0)
    ones = np.ones((2, 1))
    found = adjoint_of(motion, [rule]).pull(x0, plans, ObjectiveSlopes(ones, None, 5.0))
    assert found[:, :, 0].tolist() == [[1.0] * 3, [0.0] * 3]
    assert not adjoint_of(motion, [rule], fixed=["x"]).pull(x0, plans, ObjectiveSlopes(ones, None, 5.0)).any()
