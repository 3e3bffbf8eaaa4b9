from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.assurance.falsify import coverage
from stlc.assurance.search_space import SearchSpace, SignalBlock
from stlc.assurance.strategies import (
    AlternatingVertices,
    CoarseSampling,
    GradientVertices,
    InputVertices,
    PeriodicInputs,
    Perturbation,
    VertexSampling,
    neighbour,
    quantiles_of,
)
from stlc.assurance.surrogate import SurrogateSearch

TWO = SearchSpace(
    7,
    (
        SignalBlock("throttle", (0, 1, 2), fractions=(0.0, 1 / 3, 2 / 3)),
        SignalBlock("brake", (3, 4, 5), fractions=(0.0, 1 / 3, 2 / 3)),
    ),
)


def test_constant_vertices_hold_every_input_at_an_end():
    points = list(TWO.constant_vertices())
    assert len(points) == 8  # two inputs and one other number
    assert all(set(point[:3]) in ({0.0}, {1.0}) and set(point[3:6]) in ({0.0}, {1.0}) for point in points)
    assert len({tuple(point) for point in points}) == 8


def test_opposite_ends_come_first():
    two = SearchSpace(2, (SignalBlock("throttle", (0,)), SignalBlock("brake", (1,))))
    assert [tuple(point) for point in two.constant_vertices()] == [(1, 0), (0, 1), (1, 1), (0, 0)]


def test_many_other_numbers_stay_at_their_medians():
    space = SearchSpace(20, (SignalBlock("u", (0, 1)),))
    points = list(space.constant_vertices())
    assert [tuple(point[:3]) for point in points] == [(1.0, 1.0, 0.5), (0.0, 0.0, 0.5)]


def test_inputs_beyond_the_horizon_of_a_requirement_are_not_searched():
    part = TWO.visible(0.5)
    assert part.space.dim == 5
    assert [block.values for block in part.space.blocks] == [(0, 1), (2, 3)]
    assert part.whole(np.arange(5.0)).tolist() == [0.0, 1.0, 0.5, 2.0, 3.0, 0.5, 4.0]
    assert TWO.visible(1.0).space == TWO


@pytest.mark.parametrize(("lead", "acting"), [(0, [1, 1, 2, 4]), (1, [2, 2, 3, 5]), (2, [3, 3, 4, 5])])
def test_interpolated_values_act_before_their_time(lead, acting):
    """A line to the value at 3/4 begins at 1/2, and a cubic polynomial depends on one value more."""
    block = SignalBlock("throttle", tuple(range(5)), fractions=(0.0, 0.25, 0.5, 0.75, 1.0), lead=lead)
    assert [block.acting_before(share) for share in (0.0, 0.25, 0.5, 1.0)] == acting
    assert replace(block, times=(5, 6, 7)).acting_before(0.25) == 5


@given(st.integers(0, 1000))
def test_held_values_change_at_most_four_times(seed):
    labels = TWO.held(np.random.default_rng(seed), most=5)
    for block in TWO.blocks:
        own = labels[list(block.values)]
        assert (np.diff(own) >= 0).all()
        assert not set(own) & set(np.delete(labels, list(block.values)))


@given(
    st.integers(0, 200),
    st.sampled_from([CoarseSampling, VertexSampling, InputVertices, PeriodicInputs, SurrogateSearch]),
)
def test_strategies_stay_in_the_cube(seed, kind):
    generator = np.random.default_rng(seed)
    strategy = kind(TWO, generator)
    for _ in range(30):
        point = strategy.propose()
        assert point.shape == (7,)
        assert (point >= 0.0).all()
        assert (point <= 1.0).all()
        strategy.tell(point, float(generator.normal()))


LONG = SearchSpace(60, (SignalBlock("u", tuple(range(60)), fractions=tuple(np.arange(60) / 60)),))


def test_coarse_inputs_have_few_pieces_and_vertices_many_ends():
    coarse = CoarseSampling(LONG, np.random.default_rng(0))
    assert all(len(set(coarse.propose())) <= 5 for _ in range(50))
    vertices = VertexSampling(LONG, np.random.default_rng(1))
    share = np.isin(np.stack([vertices.propose() for _ in range(40)]), (0.0, 1.0)).mean()
    assert share == pytest.approx(2 / 3, abs=0.1)


def test_neighbours_change_whole_pieces():
    generator, good = np.random.default_rng(5), np.repeat([0.2, 0.6, 0.4], 20)
    moved = [np.flatnonzero(neighbour(LONG, generator, good) != good) for _ in range(60)]
    assert float(np.mean([len(each) for each in moved])) < 40
    assert sum(len(each) == 20 for each in moved) > 10
    assert np.mean([len(each) > 0 for each in moved]) > 0.9  # hardly a simulation is wasted on the same point


def test_perturbations_stay_close_to_the_best_point_and_inside():
    points = []
    best = np.array([0.0, 1.0, 0.0, 1.0, 0.3, 0.0, 1.0])
    for seed in range(20):
        strategy = Perturbation(TWO, np.random.default_rng(seed))
        assert strategy.propose() is None
        strategy.observe(np.full(TWO.dim, 0.5), 1.0)
        strategy.observe(best, 0.5)
        points += [strategy.propose() for _ in range(16)]
        assert strategy.propose() is None
    found = np.array(points)
    assert ((found >= 0.0) & (found <= 1.0)).all()
    assert (found[:, [0, 1, 2, 3, 5, 6]] != best[[0, 1, 2, 3, 5, 6]]).all()  # mirrored, not cut off
    assert 0.01 < np.abs(found - best).mean() < 0.05


def test_gradients_lead_to_vertices_while_that_makes_progress():
    def value(point):
        return float((point * np.linspace(-1, 1, 60)).sum() + 0.1 * (point**2).sum())

    def gradient(point):
        return np.linspace(-1, 1, 60) + 0.2 * point

    strategy = GradientVertices(LONG, np.random.default_rng(0), gradient)
    assert strategy.propose() is None  # nowhere to start
    strategy.observe(LONG.middle(), value(LONG.middle()))
    first = strategy.propose()
    assert set(first) == {0.0, 1.0}
    assert strategy.propose() is None  # until its value is known
    strategy.tell(first, value(first))
    second = strategy.propose()
    if second is not None:
        strategy.tell(second, value(second))
    assert strategy.best == pytest.approx(min(value(point) for point in (first, second) if point is not None))
    assert strategy.propose() is None
    nothing = GradientVertices(LONG, np.random.default_rng(0), lambda _: None)
    nothing.observe(LONG.middle(), 0.0)
    assert nothing.propose() is None


def test_half_periods_are_swept_before_the_best_is_refined():
    strategy = PeriodicInputs(LONG, np.random.default_rng(1))
    halves = []
    for _ in range(12):
        point = strategy.propose()
        runs = np.diff(np.flatnonzero(np.diff(point)))
        halves.append(float(runs.mean()) if runs.size else 60.0)
        strategy.tell(point, abs(halves[-1] - 9.0))
    assert len({round(each, 1) for each in halves}) >= 6
    best = min(abs(each - 9.0) for each in halves)
    for _ in range(40):
        point = strategy.propose()
        runs = np.diff(np.flatnonzero(np.diff(point)))
        value = abs(float(runs.mean()) - 9.0) if runs.size else 60.0
        best = min(best, value)
        strategy.tell(point, value)
    assert best < 0.5


def test_periodic_inputs_alternate_between_ends():
    strategy = PeriodicInputs(
        SearchSpace(40, (SignalBlock("u", tuple(range(40))),)), np.random.default_rng(1)
    )
    point = strategy.propose()
    assert set(point) == {0.0, 1.0}
    runs = np.diff(np.flatnonzero(np.diff(point)))
    assert runs.size == 0 or runs.max() - runs.min() <= 1


@given(st.lists(st.floats(0.0, 0.999), min_size=1, max_size=6))
def test_quantiles_of_switching_times_give_these_times(times):
    times = np.sort(times)
    rest, found = 1.0, []
    for index, uniform in enumerate(quantiles_of(times)):
        rest *= uniform ** (1.0 / (len(times) - index))
        found.append(1.0 - rest)
    assert np.allclose(found, times, atol=1e-9)


def test_coverage_of_a_grid_is_one_and_of_a_point_small():
    grid = np.stack(np.meshgrid(*[np.linspace(0.1, 0.9, 4)] * 2), -1).reshape(-1, 2)
    assert coverage(grid) == 1.0
    assert coverage(grid[:1]) == 1 / 16
    assert coverage(np.zeros((0, 2))) == 0.0
    assert coverage(np.zeros((3, 0))) == 1.0
    assert coverage(np.array([[0.0], [0.9]])) == 0.5


def test_vertices_of_inputs_differ_in_the_share_of_high_values():
    blocks = (
        SignalBlock("throttle", tuple(range(40)), fractions=tuple(np.arange(40) / 40)),
        SignalBlock("brake", tuple(range(40, 80)), tuple(range(80, 119))),
    )
    space = SearchSpace(121, blocks)  # the last two coordinates belong to no input
    drawn = InputVertices(space, np.random.default_rng(3))
    points = np.stack([drawn.propose() for _ in range(400)])
    assert 0.0 <= points.min() <= points.max() <= 1.0
    values, times, rest = points[:, :80], points[:, 80:119], points[:, 119:]
    at_end = (values == 0.0) | (values == 1.0)
    assert at_end.mean() == pytest.approx(2 / 3, abs=0.02)
    assert ((times > 0.0) & (times < 1.0)).all()  # switching times are never at an end
    assert np.isin(rest, (0.0, 1.0)).mean() == pytest.approx(2 / 3, abs=0.1)
    high, ends = (values == 1.0).reshape(400, 2, 40).sum(2), at_end.reshape(400, 2, 40).sum(2)
    shares = high / ends  # of each input at each point
    assert shares.std(0) == pytest.approx([12**-0.5] * 2, abs=0.04)  # uniform, rather than around 1/2
    assert abs(np.corrcoef(shares.T)[0, 1]) < 0.2


def test_alternating_vertices_switch_after_every_piece():
    blocks = (
        SignalBlock("throttle", tuple(range(6)), fractions=tuple(np.arange(6) / 6)),
        SignalBlock("brake", (6, 7, 8, 9), (10, 11, 12)),
    )
    space = SearchSpace(14, blocks)  # the last coordinate belongs to no input
    pairs = []
    for seed in range(40):
        alternating = AlternatingVertices(space, np.random.default_rng(seed))
        pairs.append((alternating.propose(), alternating.propose()))
        assert alternating.propose() is None
    points = np.concatenate(pairs)
    not_times = [*range(10), 13]
    assert all((first + second)[not_times].tolist() == [1.0] * 11 for first, second in pairs)
    for values in (points[:, :6], points[:, 6:10]):
        assert (np.abs(np.diff(values)) == 1.0).all()
        assert set(np.unique(values[:, 0])) == {0.0, 1.0}
    assert len(np.unique(points[:, [0, 6, 13]], axis=0)) == 8  # each begins at its own end
    drawn = np.random.default_rng(0).random((4000, 3))
    left = np.cumprod(drawn ** (1 / np.array([3, 2, 1])), 1)  # share of the duration after each time
    assert 1.0 - left.mean(0) == pytest.approx([0.25, 0.5, 0.75], abs=0.02)
    left = np.cumprod(points[0, 10:13] ** (1 / np.array([3, 2, 1])))
    assert 1.0 - left == pytest.approx([0.25, 0.5, 0.75])
