from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from helpers import reference
from helpers.formula_strategies import GRID, SPAN, formulas, traces
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array import frozen
from stlc.compile.backends.array.graph import evaluate, robustness_signal
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.schedule import IndexRange, TraceDomain, spanning
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.simplify import simplify
from stlc.diagnostics import TraceError

Env = dict[str, np.ndarray]

looking = formulas(held=())
bounded = formulas(held=(), bounded_only=True)


def expected(formula: typed.Formula, env: Env, end: str, side: int = 0) -> np.ndarray:
    """Reference robustness at every sample, NaN where undefined."""
    samples, batch = next(iter(env.values())).shape
    out = np.empty((samples, batch))
    for b in range(batch):
        trace = reference.Trace({name: column[:, b] for name, column in env.items()}, GRID, end)
        judge = reference.Robustness(trace)
        for t in range(samples):
            value = judge.at(formula, t)
            out[t, b] = math.nan if value is None else value[side]
    return out


def lowered(formula: typed.Formula) -> ir.Formula:
    sink: list = []
    out = GRID.lower(formula, sink)
    assert not sink
    return out


@settings(max_examples=15)
@given(looking, traces(high=10))
def test_cut_windows_give_the_definition(formula: typed.Formula, env: Env) -> None:
    wanted = expected(formula, env, "truncate")
    for node in (lowered(formula), simplify(lowered(formula))):
        signal = robustness_signal(node, env, ops=NUMPY, end="truncate")
        np.testing.assert_allclose(signal, wanted, atol=1e-9, rtol=0)


@settings(max_examples=15)
@given(bounded, traces(high=16))
def test_strict_is_the_definition_or_undefined(formula: typed.Formula, env: Env) -> None:
    signal = robustness_signal(lowered(formula), env, ops=NUMPY, end="strict")
    np.testing.assert_allclose(signal, expected(formula, env, "strict"), atol=1e-9, rtol=0)


@settings(max_examples=24)
@given(looking, traces(high=7))
def test_bounds_over_all_continuations(formula: typed.Formula, env: Env) -> None:
    node = lowered(formula)
    for end, side in (("lower", 0), ("upper", 1)):
        signal = robustness_signal(node, env, ops=NUMPY, end=end)
        np.testing.assert_allclose(signal, expected(formula, env, "open", side), atol=1e-9, rtol=0)


@settings(max_examples=15)
@given(looking, traces(low=2, high=10), st.sampled_from([1, 16, 60]))
def test_torch_agrees_whatever_is_laid_out_at_once(formula: typed.Formula, env: Env, most: int) -> None:
    node = simplify(lowered(formula))
    wanted = robustness_signal(node, env, ops=NUMPY, end="truncate")
    tensors = {name: torch.from_numpy(column) for name, column in env.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frozen, "_MOST", most)
        signal = robustness_signal(node, tensors, ops=TORCH, end="truncate")
    np.testing.assert_allclose(signal.numpy(), wanted, atol=1e-9, rtol=0)


@settings(max_examples=15)
@given(looking, traces(high=10))
def test_truth_goes_with_the_sign(formula: typed.Formula, env: Env) -> None:
    signal = robustness_signal(lowered(formula), env, ops=NUMPY, end="truncate")
    for b in range(signal.shape[1]):
        trace = reference.Trace({name: column[:, b] for name, column in env.items()}, GRID, "truncate")
        for t, rho in enumerate(signal[:, b]):
            if abs(rho) > 1e-9:
                assert reference.holds(formula, trace, t) == (rho > 0)


def _stand_by() -> typed.Formula:
    """`always (freeze p0 = x in always[0, 3 steps] abs(x - p0) <= 1)`."""
    gap = ir.Op("abs", (ir.Op("sub", (ir.Signal("x"), ir.FrozenVar("p0#0"))),))
    near = typed.Predicate(SPAN, ir.Op("sub", (ir.Const(1.0), gap)), strict=False)
    three = typed.Interval(typed.Time(), typed.Time(steps=Fraction(3)))
    body = typed.Freeze(SPAN, (("p0#0", ir.Signal("x")),), typed.Temporal(SPAN, "always", three, near))
    return typed.Temporal(SPAN, "always", typed.Interval(typed.Time(), typed.Time(steps=Fraction(9))), body)


def test_the_gradient_reaches_both_instants() -> None:
    x = torch.tensor([0.0, 0.1, 0.3, 0.2, 2.5, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7], dtype=torch.float64)
    x = x[:, None].requires_grad_()
    (rho,) = evaluate([simplify(lowered(_stand_by()))], {"x": x}, ops=TORCH)
    rho.sum().backward()
    assert rho.item() == pytest.approx(1.0 - 2.5)
    grad = x.grad[:, 0]
    assert grad[4].item() == pytest.approx(-1.0)
    assert grad[5].item() == pytest.approx(1.0)
    assert int((grad != 0).sum()) == 2


@settings(max_examples=12)
@given(looking, st.integers(0, 2**32 - 1))
def test_gradients_are_central_differences(formula: typed.Formula, seed: int) -> None:
    rng = np.random.default_rng(seed)
    env = {name: rng.normal(size=(8, 1)) for name in ("x", "y", "z")}
    node = simplify(lowered(formula))
    tensors = {name: torch.tensor(column, requires_grad=True) for name, column in env.items()}
    (rho,) = evaluate([node], tensors, ops=TORCH, start=3, end="truncate")
    if not torch.isfinite(rho).all() or not rho.requires_grad:
        return
    rho.sum().backward()

    def value(column: str, t: int, step: float) -> float:
        moved = {name: x.copy() for name, x in env.items()}
        moved[column][t] += step
        return evaluate([node], moved, ops=NUMPY, start=3, end="truncate")[0].item()

    for name, tensor in tensors.items():
        for t in range(8):
            slope = (value(name, t, 1e-6) - value(name, t, -1e-6)) / 2e-6
            own = 0.0 if tensor.grad is None else tensor.grad[t, 0].item()
            assert own == pytest.approx(slope, abs=1e-6)


def test_instants_beyond_the_trace_are_not_counted_one_by_one() -> None:
    """Two bound values, one of them defined a sample longer; everything after is one call."""
    asked: list[tuple[int, int]] = []

    def judge(_: ir.Formula, env: Env, run: IndexRange, __: TraceDomain) -> np.ndarray:
        asked.append((run.start, run.last))
        return np.zeros((run.count if run.count < 10 else 1, next(iter(env.values())).shape[1]))

    later = ir.ShiftedSignal("x", 1)
    body = ir.Predicate(ir.Op("sub", (ir.FrozenVar("y"), ir.FrozenVar("z"))))
    node = ir.Freeze((("y", ir.Signal("x")), ("z", later)), body)
    env = {"x": np.zeros((5, 1))}
    freezer = frozen.Freezer(TraceDomain(5, "lower"), env, NUMPY, judge)
    freezer.values(node, spanning(3, 1 << 40))
    assert asked[-1] == (5, (1 << 40) + 2)
    assert len(asked) == 3


def test_a_freeze_inside_another_looks_no_farther_than_a_formula_may() -> None:
    far = ir.Window(0, 1 << 40)
    later = ir.Predicate(ir.Op("sub", (ir.Signal("x"), ir.FrozenVar("y"))))
    inner = ir.Freeze((("y", ir.Signal("x")),), ir.Temporal("eventually", ir.Window(0, 2), later))
    node = ir.Freeze((("z", ir.Signal("x")),), ir.Temporal("always", far, inner))
    with pytest.raises(TraceError, match="E306"):
        evaluate([node], {"x": np.zeros((5, 1))}, ops=NUMPY, end="lower")
