"""Grids of prefixes, and samples of those that are too large."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.runtime.prefixes import GOLDEN, SAMPLINGS, PrefixGrid, Sampling, below, generators, words

MASK = (1 << 64) - 1


def grid(sizes: list[int], **changed: object) -> PrefixGrid:
    values = tuple(tuple(10.0 * i + np.linspace(0, 1, size)) for i, size in enumerate(sizes))
    return PrefixGrid(values, (1, 2), 100, **changed)  # type: ignore[arg-type]


def splitmix(number: int) -> int:
    word = number * GOLDEN & MASK
    word = (word ^ (word >> 30)) * 0xBF58476D1CE4E5B9 & MASK
    word = (word ^ (word >> 27)) * 0x94D049BB133111EB & MASK
    return word ^ (word >> 31)


def test_a_grid_that_fits_is_tried_whole_and_in_order() -> None:
    found = grid([2, 3], samples=36)
    actions = list(product(*found.values))
    assert found.prefixes(2).tolist() == [list(map(list, pair)) for pair in product(actions, repeat=2)]
    assert (found.size(2), found.count(2)) == (36, 36)


def test_a_prefix_of_one_action_may_have_any_length() -> None:
    found = PrefixGrid(((0.5,), (-1.0,)), (70,), 100)
    assert found.prefixes(70).tolist() == [[[0.5, -1.0]] * 70]


def test_prefixes_of_one_control_lie_in_memory_in_order() -> None:
    """Parts that do not; torch.export keeps them with a warning."""
    assert grid([5]).prefixes(2).flags.c_contiguous


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_one_that_does_not_is_sampled(sampling: Sampling) -> None:
    found = grid([2, 3], samples=35, sampling=sampling)
    tried = found.prefixes(2)
    assert tried.shape == (35, 2, 2)
    assert (found.size(2), found.count(2)) == (36, 35)
    for i, values in enumerate(found.values):
        assert set(tried[:, :, i].ravel()) == set(values)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_memory_is_that_of_the_sample_however_large_the_grid_is(sampling: Sampling) -> None:
    found = grid([7] * 12, samples=5000, sampling=sampling)
    assert found.size(2) == 7**24
    tried = found.prefixes(2)
    assert tried.shape == (5000, 2, 12)
    shares = np.array([(tried[:, :, i, None] == np.array(found.values[i])).mean(0) for i in range(12)])
    assert np.abs(shares - 1 / 7).max() < (0.002 if sampling == "lattice" else 0.03)


def test_points_of_the_lattice_are_spread_evenly() -> None:
    """In two dimensions every box of a 16 x 16 grid gets its share; random points miss some by far."""

    def worst(sampling: Sampling) -> int:
        index = below(words(sampling, 25_600, 2), np.array([16, 16], dtype=np.uint64))
        count = np.bincount(index[:, 0] * 16 + index[:, 1], minlength=256)
        return int(np.abs(count - 100).max())

    assert worst("lattice") <= 5
    assert worst("random") > 20


@given(st.integers(1, 50), st.integers(1, 9))
def test_words_are_those_of_whole_numbers(count: int, dims: int) -> None:
    """As a slow reference in unbounded integers; the exported C wraps around as NumPy does."""
    roots = generators(dims)
    assert words("lattice", count, dims).tolist() == [
        [k * root & MASK for root in roots] for k in range(1, count + 1)
    ]
    assert words("random", count, dims).tolist() == [
        [splitmix(k * dims + d + 1) for d in range(dims)] for k in range(count)
    ]


def test_generators_are_square_roots_of_primes() -> None:
    for root, prime in zip(generators(6), (2, 3, 5, 7, 11, 13), strict=True):
        assert root / 2**64 == pytest.approx(prime**0.5 % 1.0, abs=1e-15)


def test_random_words_are_known() -> None:
    """The first numbers of splitmix64 from seed 0, as its reference implementation prints them."""
    assert words("random", 1, 3).tolist() == [[0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]]


@given(st.integers(1, 1 << 31), st.integers(0, MASK))
def test_below_is_below(bound: int, word: int) -> None:
    found = below(np.array([word], dtype=np.uint64), np.array([bound], dtype=np.uint64))
    assert 0 <= int(found[0]) < bound
