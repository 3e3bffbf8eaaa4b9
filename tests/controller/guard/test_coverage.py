"""Theorem 1 against counting: prefixes that work are drawn, and the grid is searched for one near enough."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.controller.guard.candidates import grid_of
from stlc.controller.guard.coverage import RADII, Axis, axes_of, chance, chances
from stlc.controller.problem.task import Task
from stlc.runtime.prefixes import SAMPLINGS, PrefixGrid, Sampling

DRAWN = 20_000


def even(name: str, low: float, high: float, count: int) -> Axis:
    return Axis(name, low, high, tuple(np.linspace(low, high, count).tolist()))


def counted(axes: list[Axis], radius: float, length: int) -> float:
    """The share of uniformly drawn prefixes with a grid point within the radius, counted."""
    rng = np.random.default_rng(0)
    low, high = (np.array([getattr(axis, end) for axis in axes]) for end in ("low", "high"))
    drawn = rng.uniform(low, high, (DRAWN, length, len(axes)))
    met = np.zeros(DRAWN, dtype=bool)
    for prefix in product(product(*(axis.values for axis in axes)), repeat=length):
        met |= (np.abs(drawn - np.array(prefix)) <= radius * (high - low)).all((1, 2))
    return float(met.mean())


@pytest.mark.parametrize(
    ("axes", "radius", "length"),
    [
        ([even("a", -10, 10, 5)], 0.05, 1),
        ([even("a", -10, 10, 5)], 0.1, 3),
        ([even("a", -10, 10, 5)], 0.3, 2),
        ([even("a", -0.5, 0.5, 4), even("b", -3, 3, 5)], 0.08, 2),
        ([Axis("a", 0.0, 1.0, (0.1, 0.15, 0.7)), even("b", -3, 3, 3)], 0.06, 1),
    ],
)
def test_the_count_is_what_is_covered_and_at_least_the_bound(
    axes: list[Axis], radius: float, length: int
) -> None:
    found = chance(axes, radius, length)
    share = counted(axes, radius, length)
    slack = 4.0 * (found.exact * (1.0 - found.exact) / DRAWN) ** 0.5 + 1e-9
    assert share == pytest.approx(found.exact, abs=slack)
    if all(axis.values[0] == axis.low for axis in axes):
        assert found.bound <= found.exact + 1e-12
        assert share >= found.bound - slack


def test_the_papers_product_may_promise_too_much() -> None:
    axes = [even("fine", 0, 1, 21), even("coarse", 0, 1, 3)]
    found = chance(axes, 0.1, 1)
    assert found.theorem == pytest.approx(3.8 * 0.2)
    assert counted(axes, 0.1, 1) == pytest.approx(0.4, abs=0.02)
    assert (found.bound, found.exact) == pytest.approx((0.2, 0.4))


@given(
    count=st.integers(2, 9),
    radius=st.floats(0.0, 0.6),
    length=st.integers(1, 4),
    low=st.floats(-5, 5),
    width=st.floats(0.1, 20),
)
def test_probabilities_are_probabilities(
    count: int, radius: float, length: int, low: float, width: float
) -> None:
    found = chance([even("a", low, low + width, count)], radius, length)
    assert 0.0 <= found.bound <= found.exact + 1e-9 <= 1.0 + 2e-9
    assert found.candidates == count**length
    if radius >= 0.5 / (count - 1) + 1e-9:
        assert found.exact == pytest.approx(1.0)


def test_of_a_task(car_task: Task) -> None:
    grid = grid_of(car_task)
    (axis,) = axes_of(car_task, grid)
    assert (axis.name, axis.low, axis.high) == ("u", -10.0, 10.0)
    found = chances(car_task, grid)
    assert len(found) == len(RADII) * len(grid.lengths)
    by_length = [[each.exact for each in found if each.length == length] for length in grid.lengths]
    assert all(row == sorted(row) for row in by_length)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_of_a_sample_at_least_that_much_is_met(sampling: Sampling) -> None:
    axes = [even("a", -1, 1, 6), even("b", 0, 1, 6)]
    grid = PrefixGrid(tuple(axis.values for axis in axes), (2,), 100, 400, sampling)
    found = chance(axes, 0.1, 2, grid.samples)
    assert found.sampled
    assert found.candidates == 400
    rng = np.random.default_rng(0)
    low, high = (np.array([getattr(axis, end) for axis in axes]) for end in ("low", "high"))
    drawn = rng.uniform(low, high, (20_000, 2, 2))
    met = np.zeros(len(drawn), dtype=bool)
    for prefix in grid.prefixes(2):
        met |= (np.abs(drawn - prefix) <= 0.1 * (high - low)).all((1, 2))
    assert 0.2 < found.exact < met.mean() + 0.01
    assert found.exact < chance(axes, 0.1, 2).exact
