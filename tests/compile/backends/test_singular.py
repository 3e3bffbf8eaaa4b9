"""Gradients at singular points: finite wherever values are, and central differences wherever these agree."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
import pytest
import torch
from helpers.emitted import STEPS, adjoint_of, follower
from helpers.formula_strategies import NAMES
from numpy.typing import NDArray

from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS
from stlc.compile.semantics.semantics import Exact, LogSumExp, Semantics, semantics_of
from stlc.controller.problem.kernel import ObjectiveSlopes
from stlc.native import compiler

PARTIAL = [name for name, function in FUNCTIONS.items() if function.singular]
TOTAL = [
    "add",
    "sub",
    "mul",
    "neg",
    "abs",
    "min",
    "max",
    "norm",
    "square",
    "sin",
    "tanh",
    "relu",
    "clip",
    "floor",
]
POINTS = np.array([-1000.0, -2.0, -1.0, 0.0, 0.0, 0.0, 0.5, 1.0, 1.0, 2.0, 1000.0])
"""Values that signals take: zeros, ones, and numbers whose exponential overflows."""
STEP = 1e-6
READ = 5
"""Samples that the formulas read, from the first on."""


@dataclass(frozen=True, slots=True)
class Draw:
    """Random formulas over partial functions, in every construct that leaves a branch untaken."""

    source: np.random.Generator

    def number(self, depth: int) -> ir.Num:
        kind = self.source.integers(1, 10) if depth else self.source.integers(4)
        below = partial(self.number, depth - 1)
        match kind:
            case 0:
                return ir.Const(float(self.source.choice(POINTS)))
            case _ if kind < 3 or not depth:
                return ir.Signal(str(self.source.choice(NAMES)))
            case 3:
                return ir.Where(self.condition(depth - 1), below(), below())
            case 4:
                return ir.Op("mul", (ir.Indicator(self.condition(depth - 1)), below()))
            case _:
                function = FUNCTIONS[str(self.source.choice(PARTIAL if kind < 8 else TOTAL))]
                arity = function.most or int(self.source.integers(2, 4))
                return ir.Op(function.name, tuple(below() for _ in range(arity)))

    def condition(self, depth: int) -> ir.Formula:
        sign, strict = (1, -1)[self.source.integers(2)], bool(self.source.integers(2))
        return ir.Predicate(self.number(max(depth, 0)), sign=sign, strict=strict)

    def formula(self, depth: int) -> ir.Formula:
        below, kind = partial(self.formula, depth - 1), self.source.integers(6)
        window = ir.Window(0, int(self.source.integers(1, 3)))
        if not depth or kind == 0:
            return ir.Predicate(self.number(2), sign=(1, -1)[self.source.integers(2)])
        if kind < 3:
            return ir.BoolOp(("and", "or")[kind - 1], (below(), below()))
        if kind < 5:
            return ir.Temporal(("always", "eventually")[kind - 3], window, below())
        return ir.Until(("until", "release")[self.source.integers(2)], window, below(), below())

    def traces(self, batch: int) -> NDArray[np.float64]:
        """Samples (STEPS + 1, batch, 3) of the signals: singular points, and some others."""
        shape = (STEPS + 1, batch, len(NAMES))
        values = self.source.choice(POINTS, shape)
        generic = self.source.random(shape) < self.source.choice([0.2, 0.9], (batch, 1))
        return np.where(generic, self.source.normal(0.0, 1.0, shape), values)


def robustness(rule: ir.Formula, traces: torch.Tensor, semantics: Semantics) -> torch.Tensor:
    """Robustness at the first sample of traces (time, batch, 3): (batch,)."""
    (found,) = evaluate(
        [rule], dict(zip(NAMES, traces.unbind(2), strict=True)), ops=TORCH, semantics=semantics
    )
    return found[0].expand(traces.shape[1])


def gradient(rule: ir.Formula, at: NDArray[np.float64], semantics: Semantics) -> NDArray[np.float64]:
    """Gradient (time, batch, 3) of the finite values."""
    traces = torch.tensor(at, requires_grad=True)
    values = robustness(rule, traces, semantics)
    if not values.requires_grad:
        return np.zeros_like(at)
    values[torch.isfinite(values)].sum().backward()
    assert traces.grad is not None
    return traces.grad.numpy()


def differences(rule: ir.Formula, at: NDArray[np.float64], semantics: Semantics) -> NDArray[np.float64]:
    """Central differences (READ, batch, 3); NaN where those to both sides, or of two sizes, differ."""
    found = np.empty((READ, *at.shape[1:]))
    now = robustness(rule, torch.tensor(at), semantics).numpy()
    for sample, column in np.ndindex(READ, len(NAMES)):
        slopes = []
        for step in (STEP, -STEP, 8 * STEP, -8 * STEP):
            moved = torch.tensor(at)
            moved[sample, :, column] += step
            slopes.append((robustness(rule, moved, semantics).numpy() - now) / step)
        agree = np.ptp(slopes, 0) <= 1e-3 * np.maximum(1.0, np.abs(slopes[0])) + 1e-9 * np.abs(now) / STEP
        found[sample, :, column] = np.where(agree, np.mean(slopes, 0), np.nan)
    return found


def kinked(rule: ir.Formula, at: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Traces (batch,) on which a part of the formula has a kink: a tie, or a condition with margin 0."""
    margins = [node.num for node in rule.walk() if isinstance(node, ir.Predicate)]
    gaps: list[ir.Num] = []
    for num in (part for margin in margins for part in margin.subexpressions()):
        match num:
            case ir.Where(cond) | ir.Indicator(cond):
                gaps += [each.num for each in cond.walk() if isinstance(each, ir.Predicate)]
            case ir.Op("min" | "max" | "clip", args):
                gaps += [ir.Op("sub", pair) for pair in combinations(args, 2)]
            case ir.Op("abs" | "relu" | "norm" | "sqrt" | "pow" | "atan2", args):
                gaps += args
            case ir.Op("floor", (arg,)):
                gaps.append(ir.Op("mod", (arg, ir.Const(1.0))))
            case ir.Op("mod", _):
                gaps.append(num)
    env = {name: at[:READ, :, i] for i, name in enumerate(NAMES)}
    values = [ArrayProgram({"": num})(env, NUMPY)[""] for num in (*gaps, *margins)]
    met = np.any([value == 0.0 for value in values[: len(gaps)]], (0, 1)) if gaps else False
    ordered = np.sort(np.concatenate(values[len(gaps) :]), 0)
    return met | (ordered[1:] == ordered[:-1]).any(0)


def check(rule: ir.Formula, at: NDArray[np.float64], semantics: Semantics) -> NDArray[np.float64]:
    """Check the gradient of a formula in torch; return it where it is the only one, else NaN."""
    found = gradient(rule, at, semantics)[:READ]
    value = robustness(rule, torch.tensor(at), semantics).numpy()
    assert np.isfinite(found[:, np.isfinite(value)]).all(), rule
    with np.errstate(all="ignore"):
        smooth = differences(rule, at, semantics)
        rounding = 1e-7 * np.abs(value)[:, None] / STEP
        far = np.abs(found - smooth) > 1e-2 * np.maximum(1.0, np.abs(smooth)) + rounding
    known = np.isfinite(smooth) & (np.isfinite(value) & ~kinked(rule, at))[:, None]
    assert not (far & known).any(), (rule, np.argwhere(far & known)[:3])
    return np.where(known, found, np.nan)


def checked(seed: int, count: int, name: str) -> None:
    """Check random formulas at random traces, in torch and, if extrema are exact, in C."""
    draw = Draw(np.random.default_rng(seed))
    rules = [draw.formula(2) for _ in range(count)]
    at = draw.traces(8)
    semantics = {"exact": Exact(), "smooth": LogSumExp(5.0)}.get(name) or semantics_of(name)
    wanted = np.stack([check(rule, at, semantics) for rule in rules])
    known = np.isfinite(wanted)
    assert np.count_nonzero(wanted[known]) > count / 10
    if name != "exact" or compiler() is None:
        return
    plain = [i for i, rule in enumerate(rules) if not undefined(rule, at)]
    adjoint = adjoint_of(follower(), [rules[i] for i in plain])
    for place, i in enumerate(plain):
        weights = np.zeros((at.shape[1], len(plain)))
        weights[:, place] = 1.0
        plans = np.ascontiguousarray(at[1:].transpose(1, 0, 2))
        found = adjoint.pull(at[0].copy(), plans, ObjectiveSlopes(weights, None, 5.0))
        assert np.isfinite(found).all(), rules[i]
        found = found.transpose(1, 0, 2)[: READ - 1]
        near = np.isclose(found, wanted[i, 1:], rtol=1e-7, atol=1e-9)
        assert near[known[i, 1:]].all(), (rules[i], np.argwhere(~near & known[i, 1:])[:3])


def undefined(rule: ir.Formula, at: NDArray[np.float64]) -> bool:
    """True if a predicate is NaN somewhere: the C then takes a whole trace for broken, for all rules.

    It may be, too, if a part of it is constant; compiled specifications have no such parts.
    """
    env = {name: at[:, :, i] for i, name in enumerate(NAMES)}
    margins = [node.num for node in rule.walk() if isinstance(node, ir.Predicate)]
    inner = {part for num in margins for part in num.subexpressions() if not isinstance(part, ir.Const)}
    constant = any(all(isinstance(leaf, ir.Const) for leaf in part.leaves()) for part in inner)
    return constant or any(np.isnan(ArrayProgram({"": num})(env, NUMPY)[""]).any() for num in margins)


@pytest.mark.apart
@pytest.mark.parametrize("name", ["exact", "smooth", "agm", "dgmsr"])
def test_gradients_are_finite_and_central_differences(name: str) -> None:
    checked(0, 8, name)


def test_an_infinite_constant_has_no_gradient_where_it_is_not_taken() -> None:
    spread = ir.Op("add", (ir.Signal("z"), ir.Signal("y")))
    wild = ir.Op("mul", (spread, ir.Op("log", (ir.Const(0.0),))))
    rule = ir.BoolOp("or", (ir.Predicate(wild), ir.Predicate(ir.Signal("x"))))
    at = np.array([[[1.0, 2.0, 3.0]]])
    assert gradient(rule, at, Exact()).tolist() == [[[1.0, 0.0, 0.0]]]


@pytest.mark.parametrize("name", ["agm", "dgmsr"])
def test_the_mean_that_is_not_asked_for_may_overflow(name: str) -> None:
    huge = ir.Op("square", (ir.Op("square", (ir.Signal("y"),)),))
    inner = ir.BoolOp("or", (ir.Predicate(huge), ir.Predicate(ir.Signal("x"))))
    rule = ir.BoolOp("and", (inner, ir.Predicate(ir.Signal("x"))))
    found = gradient(rule, np.array([[[1.0, 1e70, 0.0]]]), semantics_of(name))
    assert np.isfinite(found).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 41))
def test_many_gradients_are_finite_and_central_differences(seed: int) -> None:
    checked(seed, 100, ("exact", "exact", "smooth", "agm", "dgmsr")[seed % 5])
