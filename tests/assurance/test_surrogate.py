"""Gaussian process of the robustness, and the search that it guides."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from stlc.assurance.portfolio import Portfolio
from stlc.assurance.search_space import Point, SearchSpace, SignalBlock
from stlc.assurance.strategies import Strategy, UniformSampling
from stlc.assurance.surrogate import (
    CANDIDATES,
    RobustnessProcess,
    SurrogateSearch,
    _normal_scores,
)

DIM = 6
TARGET = np.linspace(0.15, 0.85, DIM)


def bowl(point: Point) -> float:
    return float(((point - TARGET) ** 2).sum())


def least(strategy: Strategy, count: int) -> float:
    values = []
    for _ in range(count):
        point = strategy.propose()
        assert point is not None
        assert ((point >= 0.0) & (point <= 1.0)).all()
        values.append(bowl(point))
        strategy.tell(point, values[-1])
    return min(values)


def test_a_process_predicts_a_smooth_function_and_is_unsure_far_away():
    generator, process = np.random.default_rng(0), RobustnessProcess()
    points = 0.5 * generator.random((60, 2))
    process.fit(points, np.sin(6.0 * points[:, 0]) + points[:, 1])
    near = 0.05 + 0.4 * generator.random((30, 2))
    means, deviations = process.predict(near)
    assert means == pytest.approx(np.sin(6.0 * near[:, 0]) + near[:, 1], abs=0.05)
    assert process.predict(np.ones((1, 2)))[1][0] > 5.0 * deviations.max()


def test_chattering_is_noise():
    generator, process = np.random.default_rng(1), RobustnessProcess()
    points, values = generator.random((150, 2)), generator.standard_normal(150)
    process.fit(points, values)
    means, _ = process.predict(points)
    assert means.std() < 0.5 * values.std()


def test_the_search_needs_fewer_simulations_than_sampling():
    found = [least(SurrogateSearch(SearchSpace(DIM), np.random.default_rng(seed)), 40) for seed in range(3)]
    drawn = [least(UniformSampling(SearchSpace(DIM), np.random.default_rng(seed)), 400) for seed in range(3)]
    assert np.mean(found) < 0.7 * np.mean(drawn)


def test_no_point_is_simulated_twice_and_infinite_values_do_no_harm():
    strategy = SurrogateSearch(SearchSpace(1), np.random.default_rng(2))
    for end in (0.0, 1.0):
        strategy.observe(np.array([end]), -1.0)
    strategy.observe(np.array([0.3]), np.inf)
    known = {0.0, 1.0, 0.3}
    for _ in range(12):
        point = strategy.propose()
        assert float(point[0]) not in known
        known.add(float(point[0]))
        strategy.tell(point, 1.0)


def test_rounding_of_the_machine_decides_nothing():
    # The same values but for rounding errors give the same points.
    proposed = []
    for error in (0.0, 1e-13):
        strategy = SurrogateSearch(SearchSpace(DIM), np.random.default_rng(3))
        for _ in range(12):
            point = strategy.propose()
            strategy.tell(point, bowl(point) * (1.0 + error))
        proposed.append(strategy.propose())
    assert np.array_equal(*proposed)
    assert CANDIDATES > DIM


def searched(portfolio: Portfolio, count: int, value: Callable[[str, int], float]) -> list[str]:
    """Names of the strategies of `count` points; `value`: guidance value by the strategy and the index."""
    names: list[str] = []
    for index in range(count):
        proposal = portfolio.next()
        names.append(proposal.strategy.name)
        portfolio.tell(proposal, float(value(names[-1], index)))
    return names


def test_a_search_begins_with_vertices_and_opposite_constants():
    blocks = tuple(
        SignalBlock(name, tuple(range(at, at + 8))) for name, at in (("throttle", 0), ("brake", 8))
    )
    portfolio = Portfolio(SearchSpace(16, blocks), np.random.default_rng(0), lambda _: None)
    names, points = [], []
    for index in range(80):
        proposal = portfolio.next()
        names.append(proposal.strategy.name)
        points.append(proposal.point)
        portfolio.tell(proposal, float(index % 7))
    constant = ["constant vertices"] * 2
    assert names[:10] == [*["alternating vertices"] * 2, *constant, "coarse", *constant, *["coarse"] * 3]
    assert [(point[0], point[8]) for point in points[2:4]] == [(1.0, 0.0), (0.0, 1.0)]
    assert names[10:].count("surrogate") == pytest.approx(2 / 3 * 70, abs=4)  # more, without a gradient
    assert "periodic" in names


@pytest.mark.parametrize(("scatter", "count"), [(1.0, 16), (0.01, 3)])
def test_the_best_vertex_of_one_input_is_perturbed_while_robustness_scatters_there(
    scatter: float, count: int
):
    space = SearchSpace(8, (SignalBlock("reference", tuple(range(8))),))
    portfolio = Portfolio(space, np.random.default_rng(0), lambda _: None)
    names = searched(
        portfolio, 30, lambda name, k: 1.0 + (scatter if name == "perturbation" else 1.0) * (k % 7)
    )
    assert names[:4] == [*["alternating vertices"] * 2, *["constant vertices"] * 2]
    assert names[4 : 4 + count] == ["perturbation"] * count
    assert names[4 + count :][:4] == ["coarse"] * 4


@pytest.mark.parametrize(("value", "near"), [(lambda _: 1.0, 1.0), (lambda k: k % 7, math.inf)])
def test_perturbations_end_where_robustness_is_flat_or_points_are_not_admissible(value, near):
    space = SearchSpace(8, (SignalBlock("reference", tuple(range(8))),))
    portfolio = Portfolio(space, np.random.default_rng(0), lambda _: None)
    names = searched(portfolio, 18, lambda name, k: near if name == "perturbation" else value(k))
    assert names.count("perturbation") == 3


@pytest.mark.parametrize("batch", [2, 4, 13])
def test_points_of_a_batch_are_told_late_and_the_gradient_is_followed_all_the_same(batch: int):
    """With workers, a search proposes several points before it is told the first of them."""
    space = SearchSpace(8, (SignalBlock("reference", tuple(range(8))),))
    portfolio = Portfolio(space, np.random.default_rng(0), lambda point: point - 0.5)
    names, waiting = [], []
    while len(names) < 40:
        waiting += [portfolio.next() for _ in range(batch)]
        names += [each.strategy.name for each in waiting[-batch:]]
        for each in waiting:
            portfolio.tell(each, float(len(names) * each.point.sum() % 3.0))
        waiting = []
    assert "gradient" in names


def test_a_strategy_that_is_left_out_has_no_turn():
    space = SearchSpace(8, (SignalBlock("reference", tuple(range(8))),))
    for without in ("coarse", "surrogate", "constant vertices", "periodic"):
        portfolio = Portfolio(space, np.random.default_rng(0), lambda _: None, without=(without,))
        assert without not in searched(portfolio, 60, lambda _, k: k % 7)


def test_equal_values_have_equal_scores():
    scores = _normal_scores(np.array([2.0, 1.0, 2.0, np.inf, np.inf, 2.0]))
    assert len(np.unique(scores)) == 3
    assert scores[1] < scores[0] == scores[2] == scores[5] < scores[3] == scores[4]
    assert _normal_scores(np.ones(8)) == pytest.approx(0.0)
    with_ranks = _normal_scores(np.array([0.3, -1.0, 7.0]))
    assert with_ranks == pytest.approx([0.0, -0.9674, 0.9674], abs=1e-4)


def test_where_robustness_is_no_guide_points_are_random_and_one_in_twelve_is_a_vertex():
    space = SearchSpace(16, (SignalBlock("throttle", tuple(range(16))),))
    portfolio = Portfolio(space, np.random.default_rng(0), lambda _: None, graded=False)
    names = searched(portfolio, 24, lambda _, k: k % 7)
    assert names == (["uniform"] * 11 + ["vertices"]) * 2


def test_in_a_small_space_all_vertices_come_first():
    space = SearchSpace(3, (SignalBlock("reference", (0, 1, 2)),))
    portfolio = Portfolio(space, np.random.default_rng(0), lambda _: None)
    names, points = [], []
    for _ in range(60):
        proposal = portfolio.next()
        names.append(proposal.strategy.name)
        points.append(proposal.point)
        portfolio.tell(proposal, float(np.abs(proposal.point - (0.05, 0.05, 0.95)).sum()))
    assert names[:8] == ["constant vertices"] * 8
    assert len({tuple(point) for point in points[:8]}) == 8
    assert names[8:11] == ["perturbation"] * 3  # the robustness does not scatter
    later = [names[11:].count(each) for each in ("surrogate", "uniform")]
    assert later == pytest.approx([34, 11], abs=2)
    near = [point for name, point in zip(names, points, strict=True) if name == "surrogate"]
    assert np.median(np.abs(np.array(near[-10:]) - (0.05, 0.05, 0.95))) < 0.1


def test_after_many_points_all_strategies_have_their_share(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("stlc.assurance.portfolio.SURROGATE_TURNS", 0)
    block = SignalBlock("throttle", tuple(range(8)))
    portfolio = Portfolio(SearchSpace(8, (block,)), np.random.default_rng(0), lambda _: None)
    names = searched(portfolio, 120, lambda name, k: 1.0 + k % 7 - (5.0 if name == "periodic" else 0.0))
    late = names[-60:]
    assert late.count("coarse") == pytest.approx(
        20, abs=3
    )  # more, as some strategies have nothing to propose
    assert late.count("periodic") > 20 > late.count("surrogate") >= 3
