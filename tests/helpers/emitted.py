"""Shared parts of the tests of emitted C."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import torch
from helpers.formula_strategies import GRID, NAMES, formulas, numbers, state_formulas
from helpers.reference import number
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.c.emit import Motion, emit
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.defined import defined
from stlc.compile.ir.simplify import simplify
from stlc.compile.semantics.switch import StraightThrough
from stlc.controller.problem.kernel import Adjoint, Kernel, ObjectiveSlopes, Sizes
from stlc.native import load

T = TypeVar("T")

STEPS = 14

OPERATIONS = {
    "add": 2, "sub": 2, "mul": 2, "div": 2, "mod": 2, "atan2": 2, "neg": 1, "square": 1, "abs": 1, "relu": 1,
    "floor": 1, "ceil": 1, "round": 1, "sign": 1, "sin": 1, "cos": 1, "tan": 1, "atan": 1, "exp": 1,
    "sinh": 1, "cosh": 1, "tanh": 1,
    "min": 3, "max": 3, "clip": 3, "norm": 3, "norm1": 3, "norminf": 3,
}  # fmt: skip
"""Functions of the table with how many arguments they are tried."""


def follower(steps: int = STEPS) -> Motion:
    """A system whose next state is its control: any trace is one of its rollouts."""
    controls = tuple(f"to_{name}" for name in NAMES)
    after = {name: ir.Signal(control) for name, control in zip(NAMES, controls, strict=True)}
    return Motion(NAMES, controls, (), after, steps, 0.1)


def sizes_of(motion: Motion, rules: int) -> Sizes:
    """The sizes of the arrays of a kernel."""
    return Sizes(len(motion.states), len(motion.controls), motion.steps, rules)


def kernel_of(motion: Motion, rules: Sequence[ir.Formula]) -> Kernel:
    """The built kernel."""
    library = load(emit(motion, rules))
    assert library is not None
    return Kernel(library, sizes_of(motion, len(rules)))


def adjoint_of(motion: Motion, rules: Sequence[ir.Formula], *, fixed: Sequence[str] = ()) -> Adjoint:
    """The built gradient."""
    library = load(emit_adjoint(motion, rules, fixed=fixed))
    assert library is not None
    return Adjoint(library, sizes_of(motion, len(rules)))


def gathered(
    strategy: st.SearchStrategy[T],
    count: int,
    keep: Callable[[T], bool] = lambda _: True,
    first: int | None = None,
) -> list[T]:
    """So many drawn values that are wanted, so that one C text may hold them all."""
    found: list[T] = []
    run = settings(
        max_examples=count,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
        database=None,
        deadline=None,
    )

    @run
    @given(strategy)
    def gather(value: T) -> None:
        if keep(value):
            found.append(value)

    (gather if first is None else seed(first)(gather))()
    return found


def planned(formula: typed.Formula) -> ir.Formula | None:
    """A formula as it is trained for; None where it looks beyond a plan of `STEPS` steps."""
    node = simplify(GRID.lower(formula, sink=[]))
    return node if defined(node, STEPS + 1)[0] else None


def planned_formulas(count: int) -> list[ir.Formula]:
    """Random formulas as they are trained for."""
    drawn = [*gathered(formulas(), count // 2), *gathered(formulas(held=()), count - count // 2)]
    return [node for node in map(planned, drawn) if node is not None]


def assert_every_kind(rules: Sequence[ir.Formula]) -> None:
    """Require a formula of every kind that training takes."""
    kinds = {type(node) for rule in rules for node in rule.walk()}
    temporal = {ir.Temporal, ir.PastTemporal, ir.Until, ir.Since, ir.Shift, ir.Freeze}
    assert kinds >= temporal | {ir.BoolOp, ir.Predicate}


def choosing(count: int, first: int) -> list[ir.Num]:
    """Numbers with choices and indicators, as resolving leaves them: constants are folded."""
    conditions = state_formulas(numbers)
    joined = st.builds(
        ir.BoolOp, st.sampled_from(["and", "or"]), st.tuples(conditions, conditions, conditions)
    )
    drawn = st.builds(ir.Where, conditions | joined, numbers, numbers) | st.builds(ir.Indicator, joined)
    return list(dict.fromkeys(gathered(drawn, count, _is_folded, first)))


def _is_folded(num: ir.Num) -> bool:
    for part in num.subexpressions():
        constant = all(isinstance(leaf, ir.Const) for leaf in part.leaves())
        if constant and not isinstance(part, ir.Const):
            return False
        if isinstance(part, ir.Indicator | ir.Where) and _decided(part.cond):
            return False
    return True


def _decided(cond: ir.Formula) -> bool:
    """True if an atom compares constants."""
    if isinstance(cond, ir.BoolOp):
        return any(map(_decided, cond.items))
    return isinstance(cond, ir.Predicate) and isinstance(cond.num, ir.Const)


def slopes_agree(nums: Sequence[ir.Num], points: np.ndarray, slope: float = 4.0) -> None:
    """Through conditions that step hard: the value is the exact one, the gradient of C is that of torch.

    Args:
        nums: over the columns of `formula_strategies`.
        points: values of the columns, (batch, 3).
        slope: of conditions.
    """
    states = tuple(f"state{i}" for i in range(len(nums)))
    motion = Motion(states, NAMES, (), dict(zip(states, nums, strict=True)), 1, 0.1)
    adjoint, batch = adjoint_of(motion, [ir.Predicate(ir.Signal(states[0]))]), len(points)
    for i, num in enumerate(nums):
        by_states = np.zeros((len(nums), 2, batch))
        by_states[i, 1] = 1.0
        outcome = ObjectiveSlopes(np.zeros((batch, 1)), by_states, slope)
        found = adjoint.pull(np.zeros((batch, len(nums))), points[:, None].copy(), outcome)[:, 0]
        x = torch.from_numpy(points.copy()).requires_grad_()
        env = dict(zip(NAMES, x.unbind(1), strict=True))
        value = ArrayProgram({"out": num})(env, TORCH, StraightThrough(slope))["out"].expand(batch)
        exact = [number(num, dict(zip(NAMES, map(float, row), strict=True))) for row in points]
        np.testing.assert_allclose(value.detach(), exact, rtol=1e-9, atol=1e-9, err_msg=str(num))
        expected = np.zeros((batch, len(NAMES)))
        if value.requires_grad:
            expected = torch.autograd.grad(value.sum(), x)[0].numpy()
        np.testing.assert_array_equal(np.isfinite(found), np.isfinite(expected), err_msg=str(num))
        known = np.isfinite(expected)
        np.testing.assert_allclose(found[known], expected[known], rtol=1e-7, atol=1e-9, err_msg=str(num))


def near_switches(points: np.random.Generator, batch: int) -> np.ndarray:
    """Values of the columns, (batch, 3): on ties and switches, within 1e-3 of them, and anywhere."""
    coarse = points.integers(-8, 9, (batch, 3)) / 4.0
    close = points.normal(0, 1e-3, (batch, 3)) * points.integers(0, 2, (batch, 1))
    return np.where(points.random((batch, 1)) < 0.75, coarse + close, points.normal(0, 2, (batch, 3)))


def traces_of(seed: int, batch: int) -> np.ndarray:
    """Random traces without ties, (time, batch, 3)."""
    return np.random.default_rng(seed).normal(0, 2, (STEPS + 1, batch, len(NAMES)))


def values_agree(rules: Sequence[ir.Formula], trace: np.ndarray) -> None:
    """The kernel judges traces as the evaluator does."""
    x0, u = trace[0].copy(), trace[1:].transpose(1, 0, 2).copy()
    found, _ = kernel_of(follower(), rules).judge(x0, u)
    env = {name: trace[:, :, i].copy() for i, name in enumerate(NAMES)}
    expected = np.concatenate(evaluate(rules, env, ops=NUMPY))
    np.testing.assert_allclose(found.T, expected, rtol=1e-9, atol=1e-9)


def gradients_agree(rules: Sequence[ir.Formula], trace: np.ndarray, seed: int) -> None:
    """The gradient of a weighted sum of robustness by the plan is that of torch."""
    weights = np.random.default_rng(seed).uniform(0.5, 1.5, (trace.shape[1], len(rules)))
    x0, u = trace[0].copy(), trace[1:].transpose(1, 0, 2).copy()
    found = adjoint_of(follower(), rules).pull(x0, u, ObjectiveSlopes(weights, None, 5.0))
    np.testing.assert_allclose(found, _expected(rules, trace, weights), rtol=1e-9, atol=1e-9)


def _expected(rules: Sequence[ir.Formula], trace: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Gradient by all samples but the first, (batch, time, 3), from torch."""
    x = torch.from_numpy(trace).requires_grad_()
    env = dict(zip(NAMES, x.unbind(2), strict=True))
    rows = evaluate(rules, env, ops=TORCH)
    parts = [w * row[0] for w, row in zip(torch.from_numpy(weights.T), rows, strict=True)]
    total = sum(part[torch.isfinite(part)].sum() for part in parts)
    if not isinstance(total, torch.Tensor) or not total.requires_grad:
        return np.zeros_like(trace)[1:].transpose(1, 0, 2)
    return torch.autograd.grad(total, x)[0][1:].permute(1, 0, 2).numpy()
