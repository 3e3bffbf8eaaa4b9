from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from helpers import reference
from helpers.formula_strategies import GRID, NAMES, formulas, traces
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.graph import RobustnessGraph, evaluate, planned, robustness_signal
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.simplify import simplify
from stlc.compile.semantics.semantics import Exact, LogSumExp, Semantics
from stlc.signature import Column, Signature

Env = dict[str, np.ndarray]
PAST = (ir.PastTemporal, ir.Since)


def lowered(formula: typed.Formula) -> ir.Formula:
    sink: list = []
    out = GRID.lower(formula, sink)
    assert not sink
    return out


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


def as_torch(env: Env, dtype: torch.dtype = torch.float64, *, grad: bool = False) -> dict[str, torch.Tensor]:
    return {name: torch.tensor(value, dtype=dtype, requires_grad=grad) for name, value in env.items()}


@settings(max_examples=30)
@given(formulas(), traces())
def test_cut_windows_give_the_definition(formula: typed.Formula, env: Env) -> None:
    signal = robustness_signal(lowered(formula), env, ops=NUMPY, end="truncate")
    np.testing.assert_allclose(signal, expected(formula, env, "truncate"), atol=1e-9, rtol=0)


@settings(max_examples=30)
@given(formulas(bounded_only=True), traces(high=20))
def test_strict_is_the_definition_or_undefined(formula: typed.Formula, env: Env) -> None:
    signal = robustness_signal(lowered(formula), env, ops=NUMPY, end="strict")
    np.testing.assert_allclose(signal, expected(formula, env, "strict"), atol=1e-9, rtol=0)


@settings(max_examples=24)
@given(formulas(), traces(high=20))
def test_strict_with_windows_to_the_end(formula: typed.Formula, env: Env) -> None:
    signal = robustness_signal(lowered(formula), env, ops=NUMPY, end="strict")
    np.testing.assert_allclose(signal, expected(formula, env, "strict"), atol=1e-9, rtol=0)


@settings(max_examples=15)
@given(formulas(), traces(high=8))
def test_bounds_over_all_continuations(formula: typed.Formula, env: Env) -> None:
    node = lowered(formula)
    for end, side in (("lower", 0), ("upper", 1)):
        signal = robustness_signal(node, env, ops=NUMPY, end=end)
        np.testing.assert_allclose(signal, expected(formula, env, "open", side), atol=1e-9, rtol=0)


@settings(max_examples=15)
@given(formulas(), traces(high=8, batch=1))
def test_both_bounds_at_once(formula: typed.Formula, env: Env) -> None:
    node = lowered(formula)
    twice = {name: np.repeat(column, 2, axis=1) for name, column in env.items()}
    low, high = (robustness_signal(node, env, ops=NUMPY, end=end) for end in ("lower", "upper"))
    both = robustness_signal(node, twice, ops=NUMPY, end="both")
    np.testing.assert_array_equal(both, np.concatenate([low, high], axis=1))


@settings(max_examples=15)
@given(formulas(), traces(low=2, high=6), st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_bounds_hold_for_every_continuation(formula: typed.Formula, env: Env, seed: int, more: int) -> None:
    """A longer trace stays within the bounds of its prefix, `end` apart, which then is another sample."""
    node = lowered(formula)
    if any(getattr(n, "window", ir.Window(0, 0)).hi is None for n in node.walk() if not isinstance(n, PAST)):
        return
    rng = np.random.default_rng(seed)
    longer = {name: np.concatenate([c, rng.normal(size=(more, c.shape[1]))]) for name, c in env.items()}
    for end in ("lower", "upper"):
        before = robustness_signal(node, env, ops=NUMPY, end=end)
        after = robustness_signal(node, longer, ops=NUMPY, end=end)[: len(before)]
        assert (after >= before).all() if end == "lower" else (after <= before).all()


@settings(max_examples=24)
@given(formulas(), traces(high=20))
def test_simplify_keeps_robustness(formula: typed.Formula, env: Env) -> None:
    node = lowered(formula)
    slim = simplify(node)
    assert simplify(slim) == slim
    cut = robustness_signal(node, env, ops=NUMPY, end="truncate")
    np.testing.assert_array_equal(robustness_signal(slim, env, ops=NUMPY, end="truncate"), cut)
    strict = robustness_signal(node, env, ops=NUMPY)
    again = robustness_signal(slim, env, ops=NUMPY)
    inside = ~np.isnan(strict)
    np.testing.assert_array_equal(again[inside], strict[inside])


@settings(max_examples=15)
@given(formulas(), traces(high=20))
def test_torch_agrees_with_numpy(formula: typed.Formula, env: Env) -> None:
    node = simplify(lowered(formula))
    for semantics in (Exact(), LogSumExp(20.0)):
        one = robustness_signal(node, env, ops=NUMPY, semantics=semantics)
        other = robustness_signal(node, as_torch(env), ops=TORCH, semantics=semantics)
        assert other.dtype == torch.float64
        np.testing.assert_allclose(other.numpy(), one, atol=1e-9, rtol=1e-12)


@settings(max_examples=15)
@given(formulas(bounded_only=True), traces(low=3, high=20), st.data())
def test_an_instant_is_a_row_of_the_signal(formula: typed.Formula, env: Env, data: st.DataObject) -> None:
    node = lowered(formula)
    signal = robustness_signal(node, env, ops=NUMPY)
    start = data.draw(st.integers(0, len(signal) - 1))
    count = data.draw(st.integers(1, len(signal) - start))
    if np.isnan(signal[start : start + count]).any():
        with pytest.raises(ValueError, match="beyond the end"):
            evaluate([node], env, ops=NUMPY, start=start, count=count)
        return
    (rows,) = evaluate([node], env, ops=NUMPY, start=start, count=count)
    np.testing.assert_array_equal(rows, signal[start : start + count])


@settings(max_examples=24)
@given(formulas(), traces(high=16))
def test_the_sign_is_the_boolean_verdict(formula: typed.Formula, env: Env) -> None:
    signal = robustness_signal(lowered(formula), env, ops=NUMPY, end="truncate")
    for b in range(signal.shape[1]):
        trace = reference.Trace({name: column[:, b] for name, column in env.items()}, GRID, "truncate")
        for t in range(len(signal)):
            if signal[t, b] != 0:
                assert reference.holds(formula, trace, t) is bool(signal[t, b] > 0)


def generic(env: Env, seed: int) -> Env:
    """The same trace moved off all ties."""
    rng = np.random.default_rng(seed)
    return {name: column + rng.uniform(-0.05, 0.05, column.shape) for name, column in env.items()}


@settings(max_examples=18)
@given(formulas(), traces(low=4, high=12, batch=1), st.integers(0, 999))
def test_gradient_is_the_central_difference(formula: typed.Formula, env: Env, seed: int) -> None:
    node = simplify(lowered(formula))
    env = generic(env, seed)
    for semantics in (Exact(), LogSumExp(10.0)):
        tensors = as_torch(env, grad=True)
        (value,) = evaluate([node], tensors, ops=TORCH, semantics=semantics, end="truncate")
        if not torch.isfinite(value).all() or not value.requires_grad:
            continue
        value.sum().backward()
        direction = {n: np.random.default_rng(seed + 1).normal(size=c.shape) for n, c in env.items()}
        step = 1e-6
        ends = []
        for side in (1, -1):
            moved = {n: c + side * step * direction[n] for n, c in env.items()}
            ends.append(evaluate([node], moved, ops=NUMPY, semantics=semantics, end="truncate")[0].sum())
        slope = (ends[0] - ends[1]) / (2 * step)
        gradient = sum(
            float((tensors[n].grad * torch.tensor(direction[n])).sum())
            for n in env
            if tensors[n].grad is not None
        )
        assert gradient == pytest.approx(slope, abs=2e-5)


@settings(max_examples=15)
@given(formulas(truth=False), traces(high=16), st.sampled_from([1.0, 20.0, 500.0]))
def test_smooth_is_near_exact(formula: typed.Formula, env: Env, k: float) -> None:
    node = lowered(formula)
    exact = robustness_signal(node, env, ops=NUMPY, end="truncate")
    smooth = robustness_signal(node, env, ops=NUMPY, semantics=LogSumExp(k), end="truncate")
    slack = looseness(node, len(exact)) / k
    finite = np.isfinite(exact)
    assert (np.abs(smooth[finite] - exact[finite]) <= slack + 1e-9).all()
    np.testing.assert_array_equal(smooth[~finite], exact[~finite])


def looseness(node: ir.Formula, samples: int) -> float:
    """Sum along the deepest path of log(number of operands): how far nested smooth operators may be off."""
    inner = max((looseness(part, samples) for part in node.operands), default=0.0)
    match node:
        case ir.BoolOp(_, items):
            return inner + math.log(len(items))
        case ir.Temporal() | ir.PastTemporal():
            return inner + math.log(samples)
        case ir.Until() | ir.Since():
            return inner + math.log(samples) + math.log(2 * samples + 1) + 3 * math.log(2)
        case _:
            return inner


def test_smooth_operators_are_stable_and_one_sided() -> None:
    column = torch.tensor([[1000.0], [999.0], [1000.0]], requires_grad=True)
    x = ir.Signal("x")
    top = ir.Temporal("eventually", ir.Window(0, 2), ir.Predicate(x))
    low = ir.Temporal("always", ir.Window(0, 2), ir.Predicate(x))
    up, down = evaluate([top, low], {"x": column}, ops=TORCH, semantics=LogSumExp(500.0))
    assert up.dtype == torch.float32
    assert 1000.0 <= up.item() <= 1000.0 + math.log(3) / 500 + 1e-3
    assert 999.0 - math.log(3) / 500 - 1e-3 <= down.item() <= 999.0
    (up + down).sum().backward()
    np.testing.assert_allclose(column.grad.ravel(), [0.5, 1.0, 0.5], atol=1e-3)


@pytest.mark.parametrize("semantics", [Exact(), LogSumExp(500.0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_infinite_operands_carry_no_gradient(semantics: Exact | LogSumExp, dtype: torch.dtype) -> None:
    """A guard is +-inf; what is behind it gets a gradient, itself it gets none, and nothing is NaN."""
    clock, x = ir.Signal("clock"), ir.Signal("x")
    outside = ir.Predicate(ir.Op("sub", (clock, ir.Const(2.0))), sign=-1, strict=True, guard=True)
    body = ir.BoolOp("or", (outside, ir.Predicate(x)))
    held = ir.Until("until", ir.Window(0, 3), body, ir.BoolOp("and", (body, ir.Predicate(clock, guard=True))))
    env = {
        "clock": torch.arange(5.0, dtype=dtype)[:, None].requires_grad_(),
        "x": torch.tensor([[3.0], [1.0], [2.0], [5.0], [4.0]], dtype=dtype, requires_grad=True),
    }
    always = ir.Temporal("always", ir.Window(0, 4), body)
    values = evaluate([always, held, ir.BoolOp("or", (always, held))], env, ops=TORCH, semantics=semantics)
    assert values[0].item() == pytest.approx(2.0, abs=1e-3)
    torch.cat(values)[0].sum().backward()
    assert env["clock"].grad is None or not env["clock"].grad.any()
    np.testing.assert_allclose(env["x"].grad.ravel(), [0, 0, 1, 0, 0], atol=1e-6)
    for value in values[1:]:
        env["x"].grad = None
        (again,) = evaluate([ir.BoolOp("and", (held, always))], env, ops=TORCH, semantics=semantics)
        again.sum().backward()
        assert torch.isfinite(env["x"].grad).all()
        assert not torch.isnan(value).any()


@given(formulas(truth=False), traces(low=3, high=9), st.sampled_from([None, 50.0, 500.0]))
@settings(max_examples=24)
def test_gradients_are_never_nan(formula: typed.Formula, env: Env, k: float | None) -> None:
    tensors = as_torch(env, torch.float32, grad=True)
    semantics = Exact() if k is None else LogSumExp(k)
    node = simplify(lowered(formula))
    signal = robustness_signal(node, tensors, ops=TORCH, semantics=semantics, end="truncate")
    assert signal.dtype == torch.float32
    finite = signal[torch.isfinite(signal)]
    if finite.requires_grad and len(finite):
        finite.sum().backward()
        for column in tensors.values():
            assert column.grad is None or torch.isfinite(column.grad).all()


def test_predicates_are_read_only_where_they_are_needed() -> None:
    x, y = ir.Signal("x"), ir.Signal("y")
    node = ir.BoolOp("or", (ir.Predicate(x), ir.Temporal("always", ir.Window(0, 25), ir.Predicate(y))))
    plan = planned((node,), 51, range(1))
    steps = [step for step in plan.schedule.steps if isinstance(step.node, ir.Predicate)]
    assert sorted(step.run.count for step in steps) == [1, 26]
    assert not plan.batches


def test_predicates_over_one_stretch_share_a_program() -> None:
    twice = ir.Op("mul", (ir.Signal("x"), ir.Const(2.0)))
    more = ir.Predicate(ir.Op("sub", (twice, ir.Const(1.0))))
    node = ir.BoolOp(
        "or",
        (
            ir.Predicate(twice, sign=-1),
            ir.Temporal("always", ir.Window(0, 25), ir.BoolOp("and", (ir.Predicate(twice), more))),
        ),
    )
    plan = planned((node,), 51, range(1))
    assert sorted(batch.run.count for batch in plan.batches) == [1, 26]


def test_equal_parts_are_computed_once() -> None:
    p = ir.Temporal("always", ir.Window(0, 3), ir.Predicate(ir.Signal("x")))
    twin = ir.Temporal("always", ir.Window(0, 3), ir.Predicate(ir.Signal("x")))
    plan = planned((p, ir.BoolOp("or", (twin, ir.Predicate(ir.Signal("y"))))), 5, range(1))
    assert sum(isinstance(step.node, ir.Temporal) for step in plan.schedule.steps) == 1


def test_long_sequential_scan_and_log_depth_agree() -> None:
    rng = np.random.default_rng(3)
    node = ir.Until("until", ir.Window(2, None), ir.Predicate(ir.Signal("x")), ir.Predicate(ir.Signal("y")))
    wide = {"x": rng.normal(1.0, 1.0, (100, 70)), "y": rng.normal(size=(100, 70))}
    whole = robustness_signal(node, wide, ops=NUMPY, end="truncate")
    single = {name: column[:, :1] for name, column in wide.items()}
    np.testing.assert_array_equal(robustness_signal(node, single, ops=NUMPY, end="truncate"), whole[:, :1])


class Requirement(NamedTuple):
    formula: ir.Formula
    factor: float = 1.0

    def under(self, _: Semantics) -> ir.Formula:
        return self.formula


SIGNATURE = Signature(tuple(Column(name) for name in NAMES))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_graph_over_trajectories(dtype: type) -> None:
    x = np.random.default_rng(0).normal(size=(5, 4, 3)).astype(dtype)
    rules = [
        Requirement(ir.Temporal("always", ir.Window(0, 3), ir.Predicate(ir.Signal("x"))), factor=0.5),
        Requirement(ir.Predicate(ir.Signal("z"), sign=-1)),
    ]
    graph = RobustnessGraph(rules, SIGNATURE)
    each = np.stack([x[:, :, 0].min(1), -x[:, 0, 2]], axis=1)
    tensor = torch.tensor(x, requires_grad=True)
    for value in (graph.per_requirement(x), graph.per_requirement(tensor).detach().numpy()):
        assert value.dtype == dtype
        np.testing.assert_array_equal(value, each)
    whole = np.minimum(each[:, 0] / 2, each[:, 1])
    np.testing.assert_allclose(graph.robustness(x), whole, atol=1e-5)
    smooth = graph.robustness(tensor, smoothing=1e4)
    np.testing.assert_allclose(smooth.detach().numpy(), whole, atol=1e-3)
    smooth.sum().backward()
    assert tensor.grad is not None
    assert not tensor.grad[:, :, 1].any()
    np.testing.assert_allclose(
        tensor.grad.sum((1, 2)), np.where(each[:, 0] / 2 < each[:, 1], 0.5, -1.0), atol=1e-2
    )


def test_graph_without_requirements_is_satisfied() -> None:
    graph = RobustnessGraph([], SIGNATURE)
    x = np.zeros((2, 4, 3))
    assert (graph.robustness(x) == math.inf).all()
    assert graph.per_requirement(x).shape == (2, 0)


def test_graph_refuses_states_of_another_width() -> None:
    with pytest.raises(ValueError, match="2 columns where 3"):
        RobustnessGraph([], SIGNATURE).robustness(np.zeros((1, 4, 2)))


def test_graph_follows_the_device() -> None:
    """Tensors of the device "meta" do not mix with others: an array left on the CPU would show."""
    x = torch.zeros((5, 4, 3), device="meta", requires_grad=True)
    guard = ir.Predicate(ir.Op("sub", (ir.Signal("y"), ir.Const(0.5))), guard=True)
    body = ir.BoolOp("or", (guard, ir.Predicate(ir.Op("mod", (ir.Signal("x"), ir.Const(2.0))))))
    held = ir.PastTemporal(
        "once", ir.Window(0, None), ir.Until("until", ir.Window(1, 2), body, ir.Predicate(ir.Signal("z")))
    )
    graph = RobustnessGraph(
        [Requirement(body), Requirement(ir.Temporal("always", ir.Window(0, 1), held))], SIGNATURE
    )
    for smoothing in (None, 50.0):
        value = graph.robustness(x, smoothing)
        assert value.device.type == "meta"
        assert value.shape == (5,)
        value.sum().backward()
