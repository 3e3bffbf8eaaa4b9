"""What tests of emitted C share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import torch
from formula_strategies import GRID, NAMES
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from stlc.compile import ir, typed
from stlc.compile.c_adjoint import emit_adjoint
from stlc.compile.defined import defined
from stlc.compile.emit_c import Motion, emit
from stlc.compile.graph import evaluate
from stlc.compile.lower import lower
from stlc.compile.ops_numpy import NUMPY
from stlc.compile.ops_torch import TORCH
from stlc.compile.simplify import simplify
from stlc.native import Adjoint, Kernel, Outcome, load

T = TypeVar("T")

STEPS = 14

OPERATIONS = {
    "add": 2, "sub": 2, "mul": 2, "div": 2, "mod": 2, "atan2": 2, "neg": 1, "square": 1, "abs": 1, "relu": 1,
    "floor": 1, "ceil": 1, "round": 1, "sign": 1, "sin": 1, "cos": 1, "tan": 1, "atan": 1, "exp": 1,
    "min": 3, "max": 3, "clip": 3, "norm": 3, "norm1": 3, "norminf": 3,
}  # fmt: skip
"""Functions of the table with how many arguments they are tried."""


def follower(steps: int = STEPS) -> Motion:
    """A system whose next state is its control: any trace is one of its rollouts."""
    controls = tuple(f"to_{name}" for name in NAMES)
    after = {name: ir.Col(control) for name, control in zip(NAMES, controls, strict=True)}
    return Motion(NAMES, controls, (), after, steps, 0.1)


def kernel_of(motion: Motion, rules: Sequence[ir.Formula]) -> Kernel:
    """The built kernel."""
    library = load(emit(motion, rules))
    assert library is not None
    return Kernel(library, states=len(motion.states), rules=len(rules), steps=motion.steps)


def adjoint_of(motion: Motion, rules: Sequence[ir.Formula], *, fixed: Sequence[str] = ()) -> Adjoint:
    """The built gradient."""
    library = load(emit_adjoint(motion, rules, fixed=fixed))
    assert library is not None
    return Adjoint(library)


def gathered(
    strategy: st.SearchStrategy[T], count: int, keep: Callable[[T], bool] = lambda _: True
) -> list[T]:
    """So many drawn values that are wanted, so that one C text may hold them all."""
    found: list[T] = []
    run = settings(max_examples=count, phases=[Phase.generate], suppress_health_check=list(HealthCheck))

    @run
    @given(strategy)
    def gather(value: T) -> None:
        if keep(value):
            found.append(value)

    gather()
    return found


def planned(formula: typed.Formula) -> ir.Formula | None:
    """A formula as it is trained for; None where it looks beyond a plan of `STEPS` steps."""
    node = simplify(lower(formula, GRID, sink=[]))
    return node if defined(node, STEPS + 1)[0] else None


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
    found = adjoint_of(follower(), rules).pull(x0, u, Outcome(weights, None, 5.0))
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
