"""Emitted gradients equal those of torch: functions, conditions, every operator, the steps of a system."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from emitted import OPERATIONS, STEPS, follower, translatable
from formula_strategies import GRID, NAMES, formulas
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from stlc.compile import ir
from stlc.compile.c_adjoint import emit_adjoint
from stlc.compile.c_numbers import Untranslatable
from stlc.compile.emit_c import Motion
from stlc.compile.graph import evaluate
from stlc.compile.lower import lower
from stlc.compile.ops_torch import TORCH
from stlc.compile.semantics import Exact
from stlc.native import Adjoint, Outcome, build, compiler

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler here")


def _adjoint(motion: Motion, rules: Sequence[ir.Formula], *, fixed: Sequence[str] = ()) -> Adjoint:
    path = build(emit_adjoint(motion, rules, fixed=fixed))
    assert path is not None
    return Adjoint(path)


def _expected(rules: Sequence[ir.Formula], trace: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Gradient of the weighted robustness by all samples but the first, (batch, time, 3), from torch."""
    x = torch.from_numpy(trace).requires_grad_()
    env = dict(zip(NAMES, x.unbind(2), strict=True))
    rows = evaluate(rules, env, ops=TORCH, semantics=Exact())
    parts = [
        torch.where(w != 0, w * row[0], 0.0) for w, row in zip(torch.from_numpy(weights.T), rows, strict=True)
    ]
    total = sum(part[torch.isfinite(part)].sum() for part in parts)
    if not isinstance(total, torch.Tensor) or not total.requires_grad:
        return np.zeros_like(trace)[1:].transpose(1, 0, 2)
    return torch.autograd.grad(total, x)[0][1:].permute(1, 0, 2).numpy()


def _compare(rules: Sequence[ir.Formula], trace: np.ndarray, seed: int) -> None:
    weights = np.random.default_rng(seed).uniform(0.5, 1.5, (trace.shape[1], len(rules)))
    x0, u = trace[0].copy(), trace[1:].transpose(1, 0, 2).copy()
    found = _adjoint(follower(), rules).pull(x0, u, Outcome(weights, None, 5.0))
    np.testing.assert_allclose(found, _expected(rules, trace, weights), rtol=1e-9, atol=1e-9)


@settings(max_examples=2, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
@given(st.lists(formulas(), min_size=10, max_size=10), st.integers(0, 2**31))
def test_random_formulas_have_the_gradient_of_torch(drawn: list[object], seed: int) -> None:
    lowered = [lower(formula, GRID, sink=[]) for formula in drawn]  # type: ignore[arg-type]
    rules = [rule for rule in lowered if rule is not None and translatable(rule)]
    _compare(rules, np.random.default_rng(seed).normal(0, 2, (STEPS + 1, 40, len(NAMES))), seed)


def test_every_function_has_the_gradient_of_torch() -> None:
    columns = tuple(ir.Col(name) for name in NAMES)
    nums: list[ir.Num] = [ir.Op(name, columns[:arity]) for name, arity in OPERATIONS.items()]
    positive = ir.Op("abs", (columns[0],))
    nums += [ir.Op("sqrt", (positive,)), ir.Op("log", (positive,)), ir.Op("pow", (positive, columns[1]))]
    nums += [
        ir.Op(name, (ir.Op("mul", (ir.Lit(0.9), ir.Op("sin", (columns[0],)))),)) for name in ("asin", "acos")
    ]
    cond = ir.Join("or", (ir.Atom(columns[0], strict=True), ir.Atom(columns[1], sign=-1)))
    nums += [ir.Where(cond, columns[2], ir.Op("neg", (columns[1],)))]
    window = ir.Window(0, STEPS)
    rules = [ir.Over("always", window, ir.Atom(num)) for num in nums]
    _compare(rules, np.random.default_rng(1).normal(0, 2, (STEPS + 1, 60, 3)), 3)


def test_the_gradient_through_conditions_of_a_step_is_that_of_a_tanh() -> None:
    x, u = ir.Col("x"), ir.Col("u")
    after = ir.Where(ir.Atom(x, strict=True), ir.Op("add", (x, u)), ir.Op("mul", (ir.Lit(2.0), u)))
    motion = Motion(("x",), ("u",), (), {"x": after}, 1, 0.1)
    x0, plans, slope = np.array([[0.3], [-0.2]]), np.array([[[1.0]], [[3.0]]]), 4.0
    by_x = np.zeros((1, 2, 2))
    by_x[0, 1] = 1.0
    rule = ir.Atom(x)
    found = _adjoint(motion, [rule]).pull(x0, plans, Outcome(np.zeros((2, 1)), by_x, slope))
    assert found[:, 0, 0].tolist() == [1.0, 2.0]
    two = Motion(("x",), ("u",), (), {"x": after}, 2, 0.1)
    plans = np.array([[[0.1], [0.7]], [[0.1], [0.7]]])
    by_x = np.zeros((1, 3, 2))
    by_x[0, 2] = 1.0
    found = _adjoint(two, [rule]).pull(x0, plans, Outcome(np.zeros((2, 1)), by_x, slope))
    first = np.array([0.3 + 0.1, 2 * 0.1])
    bump = 0.5 * slope / np.cosh(slope * first) ** 2
    through = 1.0 + bump * ((first + 0.7) - 2 * 0.7)
    np.testing.assert_allclose(found[:, 0, 0], np.array([1.0, 2.0]) * through, rtol=1e-12)


def test_no_gradient_goes_through_fixed_states_and_broken_rows() -> None:
    x, u = ir.Col("x"), ir.Col("u")
    motion = Motion(("x",), ("u",), (), {"x": ir.Op("add", (x, u))}, 3, 0.1)
    rule = ir.Over("always", ir.Window(0, 3), ir.Atom(x))
    x0, plans = np.array([[0.0], [np.nan]]), np.full((2, 3, 1), -1.0)
    ones = np.ones((2, 1))
    found = _adjoint(motion, [rule]).pull(x0, plans, Outcome(ones, None, 5.0))
    assert found[:, :, 0].tolist() == [[1.0] * 3, [0.0] * 3]
    assert not _adjoint(motion, [rule], fixed=["x"]).pull(x0, plans, Outcome(ones, None, 5.0)).any()


def test_the_past_has_no_c_form() -> None:
    with pytest.raises(Untranslatable):
        emit_adjoint(follower(), [ir.Past("once", ir.Window(0, 3), ir.Atom(ir.Col("x")))])
