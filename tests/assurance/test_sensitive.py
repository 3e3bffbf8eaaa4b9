"""Local search in spaces most of whose coordinates have no effect."""

from __future__ import annotations

import numpy as np

from stlc.assurance.portfolio import Portfolio
from stlc.assurance.search_space import SearchSpace
from stlc.assurance.sensitive import SensitiveSearch

DIM = 600
GOOD = np.array([11, 97, 250, 399, 580])
TARGET = np.array([0.1, 0.9, 0.3, 0.7, 0.5])


def robustness(point: np.ndarray) -> float:
    return float(np.abs(point[GOOD] - TARGET).sum() - 0.1)


def searched(seed: int, *, random: bool, count: int = 300) -> tuple[float, Portfolio]:
    space = SearchSpace(DIM, sparse=True)
    portfolio = Portfolio(space, np.random.default_rng(seed), lambda _: None, random=random)
    least = np.inf
    for _ in range(count):
        proposal = portfolio.next()
        value = robustness(proposal.point)
        least = min(least, value)
        portfolio.tell(proposal, value)
    return least, portfolio


def test_the_search_is_better_than_sampling():
    pairs = [(searched(seed, random=False)[0], searched(seed, random=True)[0]) for seed in range(5)]
    learnt, sampled = np.mean(pairs, axis=0)
    assert learnt < 0.5 * sampled


def test_coordinates_without_effect_are_changed_less_often():
    space = SearchSpace(DIM, sparse=True)
    strategy = SensitiveSearch(space, np.random.default_rng(1))
    for _ in range(500):
        point = strategy.propose()
        assert point.shape == (DIM,)
        assert ((point >= 0.0) & (point <= 1.0)).all()
        strategy.tell(point, robustness(point))
    assert strategy.matters[GOOD].mean() > 10.0 * np.delete(strategy.matters, GOOD).mean()


def test_points_of_others_are_starts():
    strategy = SensitiveSearch(SearchSpace(DIM, sparse=True), np.random.default_rng(0))
    best = np.full(DIM, 0.5)
    best[GOOD] = TARGET
    for _ in range(30):
        strategy.observe(best, robustness(best))
    near = [strategy.propose() for _ in range(40)]
    assert sum(np.mean(point == best) > 0.5 for point in near) > 20


def test_a_part_of_a_sparse_space_is_sparse():
    assert SearchSpace(4, sparse=True).visible(1.0).space.sparse
