"""`sweep` against the segment itself, densely sampled and then narrowed down."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import reference
from helpers.resolving import formula, margin
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.compile.backends.array.graph import evaluate, robustness_signal
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid

GRID = Grid()
L_SHAPE = "polygon([0, 0], [4, 0], [4, 1], [1, 1], [1, 3], [0, 3])"
CONVEX = {
    "circle": "circle([1, 2], 1.5)",
    "box": "box([-1, -2], [1.5, 1])",
    "square": "polygon([0, 0], [2, 0], [2, 2], [0, 2])",
    "pentagon": "polygon([0, 0], [2, -1], [3, 1], [1.5, 3], [-0.5, 1.5])",
    "halfspace": "halfspace([3, 4], 10)",
    "dilated": "dilate(box([-1, -2], [1.5, 1]), 0.5)",
    "moving": "circle([x, y], 1.2)",
    "moving_box": "box([x, y], [x + 2, y + 1])",
}
SPACE = {"ball": "ball([1, 0, -1], 1.5)", "box": "box([-1, -2, 0], [1, 2, 1.5])"}

coordinate = st.one_of(st.integers(-4, 4).map(float), st.floats(-4, 4).map(lambda value: round(value, 3)))
places = st.tuples(coordinate, coordinate)


def columns(now, then, obstacle=((0.0, 0.0), (0.0, 0.0))) -> dict[str, np.ndarray]:
    """Two samples of the point, and of what may move."""
    name = "q" if len(now) == 3 else "p"
    rows = {f"{name}[{i}]": pair for i, pair in enumerate(zip(now, then, strict=True))}
    rows |= {"x": (obstacle[0][0], obstacle[1][0]), "y": (obstacle[0][1], obstacle[1][1])}
    return {key: np.array(pair, dtype=float)[:, None] for key, pair in rows.items()}


_CACHE: dict[str, ir.Num] = {}


def along(region: str, env: dict[str, np.ndarray], shares: np.ndarray) -> np.ndarray:
    """The signed distance at shares of the segment."""
    num = _CACHE.get(region)
    if num is None:
        point = "q" if "q[0]" in env else "p"
        num = _CACHE[region] = margin(f"sdist({point}, {region})")
    rows = {name: (1 - shares)[:, None] * x[0] + shares[:, None] * x[1] for name, x in env.items()}
    (values,) = evaluate([ir.Predicate(num)], rows, ops=NUMPY, count=len(shares))
    return values[:, 0]


def extreme(region: str, env: dict[str, np.ndarray], pick: str) -> float:
    """The least or greatest signed distance, narrowed down around the best of dense samples."""
    sign = 1.0 if pick == "min" else -1.0
    low, high = 0.0, 1.0
    for _ in range(9):
        shares = np.linspace(low, high, 201)
        values = sign * along(region, env, shares)
        best = int(np.argmin(values))
        width = (high - low) / 200
        low, high = max(shares[best] - width, 0.0), min(shares[best] + width, 1.0)
    return float(sign * values.min())


_FORMULAS: dict[str, ir.Formula] = {}


def robustness(text: str, env: dict[str, np.ndarray]) -> float:
    if text not in _FORMULAS:
        _FORMULAS[text] = GRID.lower(formula(text), [])
    return float(evaluate([_FORMULAS[text]], env, ops=NUMPY)[0][0, 0])


@pytest.mark.parametrize("region", CONVEX.values(), ids=CONVEX)
@settings(max_examples=12)
@given(now=places, then=places, obstacle=st.tuples(places, places))
def test_convex_regions_are_exact(region, now, then, obstacle) -> None:
    env = columns(now, then, obstacle)
    assert robustness(f"sweep(p) in {region}", env) == pytest.approx(extreme(region, env, "min"), abs=1e-7)
    assert robustness(f"sweep(p) not in {region}", env) == pytest.approx(
        -extreme(region, env, "max"), abs=1e-7
    )


@pytest.mark.parametrize("region", SPACE.values(), ids=SPACE)
@settings(max_examples=18)
@given(now=st.tuples(coordinate, coordinate, coordinate), then=st.tuples(coordinate, coordinate, coordinate))
def test_regions_in_space_are_exact(region, now, then) -> None:
    env = columns(now, then)
    assert robustness(f"sweep(q) in {region}", env) == pytest.approx(extreme(region, env, "min"), abs=1e-7)
    assert robustness(f"sweep(q) not in {region}", env) == pytest.approx(
        -extreme(region, env, "max"), abs=1e-7
    )


@settings(max_examples=18)
@given(now=places, then=places)
def test_a_polygon_that_is_not_convex(now, then) -> None:
    """Exact where it is satisfied, and of the right sign everywhere."""
    env = columns(now, then)
    inside, outside = extreme(L_SHAPE, env, "min"), -extreme(L_SHAPE, env, "max")
    for text, wanted in ((f"sweep(p) in {L_SHAPE}", inside), (f"sweep(p) not in {L_SHAPE}", outside)):
        found = robustness(text, env)
        if wanted >= 0:
            assert found == pytest.approx(wanted, abs=1e-7)
        elif wanted < -1e-6:
            assert found < 1e-9


@settings(max_examples=24)
@given(now=places, then=places)
def test_unions_and_intersections(now, then) -> None:
    env = columns(now, then)
    a, b = CONVEX["circle"], CONVEX["box"]
    both, either = f"intersect({a}, {b})", f"union({a}, {b})"
    assert robustness(f"sweep(p) in {both}", env) == pytest.approx(extreme(both, env, "min"), abs=1e-7)
    blocked = max(extreme(a, env, "max"), extreme(b, env, "max"))
    assert robustness(f"sweep(p) not in {either}", env) == pytest.approx(-blocked, abs=1e-7)
    assert robustness(f"sweep(p) in {either}", env) <= extreme(either, env, "min") + 1e-7
    outside = f"complement({either})"
    assert robustness(f"sweep(p) in {outside}", env) == robustness(f"sweep(p) not in {either}", env)


@settings(max_examples=18)
@given(st.lists(coordinate, min_size=1, max_size=6))
def test_a_number_sweeps_a_range(values) -> None:
    env = {"x": np.array(values)[:, None]}
    inside = robustness_signal(GRID.lower(formula("sweep(x) in [-1, 2]"), []), env, ops=NUMPY)[:, 0]
    outside = robustness_signal(GRID.lower(formula("sweep(x) not in [-1, 2]"), []), env, ops=NUMPY)[:, 0]
    for t, value in enumerate(values):
        ends = sorted((value, values[min(t + 1, len(values) - 1)]))
        assert inside[t] == pytest.approx(min(ends[0] + 1, 2 - ends[1]))
        deep = 1.5 - max(ends[0] - 0.5, 0.5 - ends[1], 0.0)
        assert outside[t] == pytest.approx(-deep)


def test_at_the_last_sample_it_is_the_point_itself() -> None:
    env = {"p[0]": np.array([[-3.0], [3.0]]), "p[1]": np.zeros((2, 1))}
    node = GRID.lower(formula("sweep(p) not in circle([0, 0], 1)"), [])
    for end in ("strict", "truncate", "lower", "upper"):
        signal = robustness_signal(node, env, ops=NUMPY, end=end)
        np.testing.assert_allclose(signal[:, 0], [-1.0, 2.0])


def test_what_jumps_over_a_wall_is_caught() -> None:
    env = {"p[0]": np.array([[0.0], [2.0]]), "p[1]": np.zeros((2, 1))}
    wall = "box([0.6, -5], [1.4, 5])"
    assert robustness(f"p not in {wall}", env) > 0
    assert robustness(f"always[0 steps, 1 steps] sweep(p) not in {wall}", env) == pytest.approx(-0.4)


@pytest.mark.parametrize("region", [*CONVEX.values(), L_SHAPE])
def test_gradients_are_central_differences(region) -> None:
    rng = np.random.default_rng(5)
    for text in (f"sweep(p) in {region}", f"sweep(p) not in {region}"):
        node = GRID.lower(formula(text), [])
        env = {name: rng.normal(size=(2, 40)) * 2 for name in ("p[0]", "p[1]", "x", "y")}
        tensors = {name: torch.tensor(x, requires_grad=True) for name, x in env.items()}
        (rho,) = evaluate([node], tensors, ops=TORCH)
        rho.sum().backward()
        for name, tensor in tensors.items():
            if tensor.grad is None:
                continue
            for t in range(2):
                moved = [
                    {**env, name: env[name] + step * (np.arange(2) == t)[:, None]} for step in (1e-6, -1e-6)
                ]
                up, down = (evaluate([node], each, ops=NUMPY)[0][0] for each in moved)
                np.testing.assert_allclose(tensor.grad[t].numpy(), (up - down) / 2e-6, atol=1e-4)


def test_standing_still_does_no_harm_to_gradients() -> None:
    for region in (*CONVEX.values(), L_SHAPE):
        for dtype in (torch.float32, torch.float64):
            tensors = {
                name: torch.full((2, 1), value, dtype=dtype, requires_grad=True)
                for name, value in (("p[0]", 0.4), ("p[1]", 0.3), ("x", 0.1), ("y", -0.2))
            }
            (rho,) = evaluate([GRID.lower(formula(f"sweep(p) not in {region}"), [])], tensors, ops=TORCH)
            rho.sum().backward()
            grads = [tensor.grad for tensor in tensors.values() if tensor.grad is not None]
            assert all(torch.isfinite(grad).all() for grad in grads)


def test_negation_is_not_the_same_as_not_in() -> None:
    env = {"p[0]": np.array([[-2.0], [0.0]]), "p[1]": np.zeros((2, 1))}
    circle = "circle([0, 0], 1)"
    assert robustness(f"not (sweep(p) in {circle})", env) == pytest.approx(1.0)
    assert robustness(f"sweep(p) not in {circle}", env) == pytest.approx(-1.0)


def test_the_reference_reads_it_too() -> None:
    node = formula("sweep(p) not in box([0, 0], [1, 1])")
    assert isinstance(node, typed.Predicate)
    trace = reference.Trace({"p[0]": [-1.0, 2.0], "p[1]": [0.5, 0.5]}, GRID)
    assert reference.robustness(node, trace) == (-0.5, -0.5)
    assert not math.isinf(reference.robustness(node, trace, 1)[0])
