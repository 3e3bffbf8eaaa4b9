"""Gradients of robustness against central differences, for every semantics; `tools/proofs.py` runs many."""

from __future__ import annotations

import pytest
from proof.amounts import FULL, seeds
from proof.slopes import SMOOTHED, check_gradient


@pytest.mark.parametrize("numbers", seeds(FULL, 30))
def test_the_gradient_is_the_central_difference(numbers: range) -> None:
    few_are_left_out(numbers, "exact")


@pytest.mark.parametrize("name", SMOOTHED)
@pytest.mark.parametrize("numbers", seeds(FULL // 10, 12))
def test_the_gradient_of_the_other_semantics(numbers: range, name: str) -> None:
    few_are_left_out(numbers, name)


def few_are_left_out(numbers: range, name: str) -> None:
    counts = [check_gradient(seed, name) for seed in numbers]
    compared, ties = (sum(part) for part in zip(*counts, strict=True))
    assert compared > 2 * len(numbers)
    assert ties < 0.02 * compared
