"""Every registered semantics is held to one contract."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers.formula_strategies import GRID, formulas, traces
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import typed
from stlc.compile.namespace import Ops
from stlc.compile.semantics.semantics import (
    SEMANTICS,
    ArithmeticGeometricMean,
    Exact,
    GeneralizedMean,
    LogSumExp,
    Pick,
    Semantics,
    semantics_of,
)
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.diagnostics import UsageError

ALL = [SEMANTICS.get(name)() for name in SEMANTICS.names]
SOUND = [semantics for semantics in ALL if semantics.sound]
BOTH = pytest.mark.parametrize("pick", ["min", "max"])
Env = dict[str, np.ndarray]


def column(*values: float) -> np.ndarray:
    return np.array(values, dtype=float)[:, None]


@pytest.mark.parametrize("ops", [NUMPY, TORCH], ids=["numpy", "torch"])
@BOTH
@pytest.mark.parametrize("semantics", ALL, ids=SEMANTICS.names)
def test_contract(semantics: Semantics, pick: Pick, ops: Ops) -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(6, 3))
    data = x if ops is NUMPY else torch.tensor(x)
    reduced = semantics.reduce(data, pick, ops)
    assert reduced.shape == (1, 3)
    assert ((x.min(0) - 0.01 <= np.asarray(reduced)) & (np.asarray(reduced) <= x.max(0) + 0.01)).all()
    joined = semantics.join([data[i : i + 1] for i in range(6)], pick, ops)
    np.testing.assert_allclose(joined, reduced, atol=1e-12)
    merged = semantics.lift(data[:1], pick, ops)
    for i in range(1, 6):
        merged = semantics.merge(merged, semantics.lift(data[i : i + 1], pick, ops), pick, ops)
    np.testing.assert_allclose(semantics.finish(merged, pick, ops), reduced, atol=1e-12)
    one = semantics.join([data[:1], data[1:2]], pick, ops)
    np.testing.assert_allclose(semantics.pair(data[:1], data[1:2], pick, ops), one, atol=1e-12)
    np.testing.assert_allclose(semantics.join([data], pick, ops), x)
    alone = semantics.finish(semantics.lift(data, pick, ops), pick, ops)
    np.testing.assert_array_equal(alone, x)
    mirrored = semantics.reduce(-data, "max" if pick == "min" else "min", ops)
    np.testing.assert_allclose(-mirrored, reduced, atol=1e-12)
    single = data.astype(np.float32) if ops is NUMPY else data.float()
    again = semantics.reduce(single, pick, ops)
    assert again.dtype == single.dtype
    np.testing.assert_allclose(again, reduced, atol=1e-5)


@pytest.mark.parametrize("ops", [NUMPY, TORCH], ids=["numpy", "torch"])
@BOTH
@pytest.mark.parametrize("semantics", ALL, ids=SEMANTICS.names)
def test_infinite_operands_are_neutral_or_decide(semantics: Semantics, pick: Pick, ops: Ops) -> None:
    x = np.random.default_rng(1).normal(size=(6, 3))
    data = x if ops is NUMPY else torch.tensor(x, requires_grad=True)
    neutral = math.inf if pick == "min" else -math.inf
    rows = ops.full((1, 3), neutral, data)
    whole = semantics.reduce(ops.cat([data, rows]), pick, ops)
    np.testing.assert_allclose(plain(whole), plain(semantics.reduce(data, pick, ops)), atol=1e-12)
    assert (plain(semantics.pair(rows, rows, pick, ops)) == neutral).all()
    decided = semantics.pair(data[:1], -rows, pick, ops)
    assert (plain(decided) == -neutral).all()
    if ops is TORCH:
        torch.where(torch.isfinite(decided), decided, 0.0).sum().backward()
        whole.sum().backward()
        assert torch.isfinite(data.grad).all()
        assert data.grad.any()


def plain(x: np.ndarray | torch.Tensor) -> np.ndarray:
    return x.detach().numpy() if isinstance(x, torch.Tensor) else x


@pytest.mark.parametrize("semantics", SOUND, ids=lambda s: type(s).__name__)
@settings(max_examples=18)
@given(formulas(truth=False), traces(high=16))
def test_sound_semantics_keep_the_sign(semantics: Semantics, formula: typed.Formula, env: Env) -> None:
    node = GRID.lower(formula, [])
    exact = robustness_signal(node, env, ops=NUMPY, end="truncate")
    value = robustness_signal(node, env, ops=NUMPY, semantics=semantics, end="truncate")
    assert (value[exact > 0] > 0).all()
    assert (value[exact < 0] < 0).all()
    np.testing.assert_array_equal(value[np.isinf(exact)], exact[np.isinf(exact)])


def test_log_sum_exp_does_not_keep_the_sign() -> None:
    """Two operands just below 0 make a smooth maximum above it."""
    assert not LogSumExp.sound
    x = column(-0.001, -0.001)
    assert Exact().reduce(x, "max", NUMPY).item() < 0 < LogSumExp(100.0).reduce(x, "max", NUMPY).item()


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=9), st.floats(0.5, 500))
def test_log_sum_exp_brackets_the_extremum(values: list[float], k: float) -> None:
    x, smooth = column(*values), LogSumExp(k)
    slack = math.log(len(values)) / k + 1e-9
    top = smooth.reduce(x, "max", NUMPY).item()
    low = smooth.reduce(x, "min", NUMPY).item()
    assert max(values) <= top + 1e-9
    assert top <= max(values) + slack
    assert min(values) - slack <= low <= min(values) + 1e-9
    formula = math.log(sum(math.exp(k * (value - max(values))) for value in values)) / k + max(values)
    assert top == pytest.approx(formula, abs=1e-9)


operands = st.lists(st.floats(-9, 9).filter(lambda x: x == 0 or abs(x) > 1e-6), min_size=2, max_size=9)


@given(operands)
def test_arithmetic_geometric_mean_is_the_papers(values: list[float]) -> None:
    n = len(values)
    if min(values) > 0:
        wanted = math.prod(1 + x for x in values) ** (1 / n) - 1
    else:
        wanted = sum(min(x, 0.0) for x in values) / n
    value = ArithmeticGeometricMean().reduce(column(*values), "min", NUMPY).item()
    assert value == pytest.approx(wanted, rel=1e-9, abs=1e-12)
    if max(values) >= 0:  # the paper leaves a maximum of exactly 0 to the other case, which is negative
        wanted = sum(max(x, 0.0) for x in values) / n
    else:
        wanted = 1 - math.prod(1 - x for x in values) ** (1 / n)
    value = ArithmeticGeometricMean().reduce(column(*values), "max", NUMPY).item()
    assert value == pytest.approx(wanted, rel=1e-9, abs=1e-12)


@given(operands, st.sampled_from([1e-8, 1e-4, 0.1]), st.sampled_from([1, 2]))
def test_generalized_mean_is_the_papers(values: list[float], eps: float, p: int) -> None:
    n = len(values)
    product = math.prod(max(x, 0.0) ** 2 for x in values)
    power = sum(min(x, 0.0) ** (2 * p) for x in values) / n
    wanted = math.sqrt((eps**n + product) ** (1 / n)) - math.sqrt((eps**p + power) ** (1 / p))
    value = GeneralizedMean(eps, p).reduce(column(*values), "min", NUMPY).item()
    assert value == pytest.approx(wanted, rel=1e-6, abs=1e-7)
    assert value * min(values) > 0 or min(values) == 0 == value


@pytest.mark.parametrize("semantics", [GeneralizedMean(0.01), GeneralizedMean(0.01, 2)])
@pytest.mark.parametrize("values", [(0.5, 1.0, 2.0), (-0.5, 1.0, -2.0), (-0.3, 0.2, 4.0)])
def test_gradients_of_means_are_central_differences(semantics: Semantics, values: tuple[float, ...]) -> None:
    x = torch.tensor(column(*values), requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: semantics.reduce(x, "min", TORCH), (x,))
    assert torch.autograd.gradcheck(lambda x: semantics.reduce(x, "max", TORCH), (x,))


@pytest.mark.parametrize("semantics", [ArithmeticGeometricMean(), GeneralizedMean()])
def test_gradients_of_means_are_finite_at_zero(semantics: Semantics) -> None:
    for values in ((0.0, 0.0, 1.0), (0.0, -1.0, 2.0), (1e-30, 1e-30, 1.0), (0.0, 0.0, 0.0)):
        x = torch.tensor(column(*values), dtype=torch.float32, requires_grad=True)
        (semantics.reduce(x, "min", TORCH) + semantics.reduce(x, "max", TORCH)).sum().backward()
        assert torch.isfinite(x.grad).all(), values


def test_semantics_by_what_somebody_asks_for() -> None:
    assert semantics_of() == Exact()
    assert semantics_of(smoothing=20) == semantics_of("smooth", 20) == LogSumExp(20.0)
    assert semantics_of("agm") == ArithmeticGeometricMean()
    assert semantics_of(GeneralizedMean(0.1)) == GeneralizedMean(0.1)
    with pytest.raises(UsageError, match="exakt"):
        semantics_of("exakt")
    with pytest.raises(UsageError, match="no `smoothing`"):
        semantics_of("agm", 20)
    assert TOLERANCE == 1e-6
