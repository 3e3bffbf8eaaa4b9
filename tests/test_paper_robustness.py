"""The paper's traffic specification: robustness and its gradient equal the definitions."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import reference

from stlc.compile.backends.array.graph import RobustnessGraph
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import Compiled, compile_spec
from stlc.grammar.spec import Spec
from stlc.source import Source

GRID = Grid(Fraction(1, 10), 25)
TRAJECTORIES = 60


@pytest.fixture(scope="module")
def traffic() -> Compiled:
    path = Path(__file__).parents[1] / "specs" / "traffic.stl"
    return compile_spec(Spec.parse(Source("specs/traffic.stl", path.read_text())), grid=GRID)


@pytest.fixture(scope="module")
def graph(traffic: Compiled) -> RobustnessGraph:
    return RobustnessGraph(traffic.requirements, traffic.signature)


def trajectories(names: tuple[str, ...]) -> np.ndarray:
    """Random walks, `(batch, time, dim)`, all situations of the specification among them."""
    rng = np.random.default_rng(5)
    shape = (TRAJECTORIES, GRID.horizon + 1)

    def walk(low: float, high: float, step: float) -> np.ndarray:
        return rng.uniform(low, high, (shape[0], 1)) + np.cumsum(rng.normal(0, step, shape), axis=1)

    def fixed() -> np.ndarray:
        return np.repeat(rng.integers(0, 2, (shape[0], 1)), shape[1], axis=1).astype(float)

    columns = {
        "x": walk(-4, 2, 0.2),
        "sign": fixed(),
        "tau": np.abs(walk(-1, 8, 0.2)),
        "dx": walk(-2, 6, 0.2),
        "yielding": fixed(),
    }
    return np.stack([columns[name] for name in names], axis=-1)


def test_robustness_is_the_definition(traffic: Compiled, graph: RobustnessGraph) -> None:
    x = trajectories(traffic.signature.names)
    wanted = np.empty((TRAJECTORIES, len(traffic.requirements)))
    for i, states in enumerate(x):
        trace = reference.Trace(dict(zip(traffic.signature.names, states.T, strict=True)), GRID)
        for j, rule in enumerate(traffic.requirements):
            low, high = reference.robustness(rule.typed.formula, trace)
            assert low == high
            wanted[i, j] = low
    assert {-1.0, 1.0} == set(np.sign(wanted).ravel())
    for form in (x, torch.tensor(x)):
        np.testing.assert_allclose(np.asarray(graph.per_requirement(form)), wanted, atol=1e-9, rtol=0)
        np.testing.assert_allclose(np.asarray(graph.robustness(form)), wanted.min(1), atol=1e-9, rtol=0)
    single = graph.robustness(torch.tensor(x, dtype=torch.float32))
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single, wanted.min(1), atol=1e-5)


def test_verdicts_are_those_of_boolean_semantics(traffic: Compiled, graph: RobustnessGraph) -> None:
    x = trajectories(traffic.signature.names)
    rho = graph.per_requirement(x)
    for i, states in enumerate(x[:25]):
        trace = reference.Trace(dict(zip(traffic.signature.names, states.T, strict=True)), GRID)
        for j, rule in enumerate(traffic.requirements):
            assert reference.holds(rule.typed.formula, trace) is bool(rho[i, j] > 0)


@pytest.mark.parametrize("smoothing", [None, 20.0])
def test_gradient_is_the_central_difference(
    traffic: Compiled, graph: RobustnessGraph, smoothing: float | None
) -> None:
    x = trajectories(traffic.signature.names)
    tensor = torch.tensor(x, requires_grad=True)
    graph.robustness(tensor, smoothing=smoothing).sum().backward()
    step = 1e-6
    moving = np.array([name in ("x", "tau", "dx") for name in traffic.signature.names])
    rng = np.random.default_rng(6)
    for _ in range(20):
        direction = rng.normal(size=x.shape) * moving  # an enum stands on the kink of its distance
        ends = [graph.robustness(x + side * step * direction, smoothing=smoothing) for side in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step)
        gradient = (tensor.grad.numpy() * direction).sum((1, 2))
        np.testing.assert_allclose(gradient, slope, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("k", [10.0, 100.0, 500.0])
def test_smooth_tends_to_exact(traffic: Compiled, graph: RobustnessGraph, k: float) -> None:
    """At most log(n) / k apart for every nesting: requirements, implication, time, implication."""
    x = trajectories(traffic.signature.names)
    apart = np.abs(graph.robustness(x, smoothing=k) - graph.robustness(x))
    assert apart.max() <= (math.log(4) + math.log(3) + math.log(26) + math.log(2)) / k
    assert apart.max() > 0
