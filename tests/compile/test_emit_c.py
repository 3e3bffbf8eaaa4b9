"""The emitted C equals the array evaluators: numbers, conditions, every operator of the future."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from emitted import OPERATIONS, STEPS, follower, translatable
from formula_strategies import GRID, NAMES, formulas
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from stlc.compile import ir
from stlc.compile.c_numbers import Untranslatable
from stlc.compile.emit_c import Motion, emit
from stlc.compile.graph import evaluate
from stlc.compile.lower import lower
from stlc.compile.ops_numpy import NUMPY
from stlc.compile.semantics import Exact
from stlc.native import Kernel, build, compiler

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler here")


def _kernel(motion: Motion, rules: Sequence[ir.Formula]) -> Kernel:
    path = build(emit(motion, rules))
    assert path is not None
    return Kernel(path, states=len(motion.states), rules=len(rules), steps=motion.steps)


def _judge(kernel: Kernel, trace: np.ndarray) -> np.ndarray:
    """Robustness of traces (time, batch, 3)."""
    rho, _ = kernel.judge(trace[0].copy(), trace[1:].transpose(1, 0, 2).copy())
    return rho


@settings(max_examples=3, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
@given(st.lists(formulas(), min_size=30, max_size=30), st.integers(0, 2**31))
def test_random_formulas_equal_the_evaluator(drawn: list[object], seed: int) -> None:
    lowered = [lower(formula, GRID, sink=[]) for formula in drawn]  # type: ignore[arg-type]
    rules = [rule for rule in lowered if rule is not None and translatable(rule)]
    rng = np.random.default_rng(seed)
    trace = np.round(rng.normal(0, 2, (STEPS + 1, 50, len(NAMES))) * 8) / 8
    found = _judge(_kernel(follower(), rules), trace)
    env = {name: trace[:, :, i].copy() for i, name in enumerate(NAMES)}
    expected = np.concatenate(evaluate(rules, env, ops=NUMPY, semantics=Exact()))
    np.testing.assert_allclose(found.T, expected, rtol=1e-9, atol=1e-9)


def test_every_function_equals_the_evaluator() -> None:
    columns = tuple(ir.Col(name) for name in NAMES)
    nums = [ir.Op(name, columns[:arity]) for name, arity in OPERATIONS.items()]
    positive = ir.Op("abs", (columns[0],))
    nums += [ir.Op("sqrt", (positive,)), ir.Op("log", (positive,)), ir.Op("pow", (positive, columns[1]))]
    nums += [ir.Op(name, (ir.Op("sin", (columns[0],)),)) for name in ("asin", "acos")]
    cond = ir.Join("or", (ir.Atom(columns[0], strict=True), ir.Atom(columns[1], sign=-1)))
    nums += [ir.Ind(cond), ir.Where(cond, columns[2], ir.Lit(0.1))]
    rules = [ir.Atom(num) for num in nums] + [ir.Atom(columns[0], guard=True)]
    rng = np.random.default_rng(1)
    trace = rng.normal(0, 2, (STEPS + 1, 200, 3))
    found = _judge(_kernel(follower(), rules), trace)
    env = {name: trace[:, :, i].copy() for i, name in enumerate(NAMES)}
    expected = np.concatenate(evaluate(rules, env, ops=NUMPY, semantics=Exact()))
    np.testing.assert_allclose(found.T, expected, rtol=1e-12, atol=1e-12)


def test_what_has_no_c_form_is_said() -> None:
    past = ir.Past("once", ir.Window(0, 3), ir.Atom(ir.Col("x")))
    late = [ir.Over("always", ir.Window(lo, hi), ir.Atom(ir.Col("x"))) for lo, hi in ((0, 99), (20, None))]
    for rule in (past, ir.Atom(ir.Extern("f", (ir.Col("x"),))), *late):
        with pytest.raises(Untranslatable):
            emit(follower(), [rule])
