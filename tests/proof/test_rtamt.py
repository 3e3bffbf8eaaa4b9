"""Against RTAMT, on what both languages can say: every operator, at every sample."""

from __future__ import annotations

import pytest
from proof.amounts import seeds
from proof.cases import Case
from proof.draw import Taste
from proof.peer import values

COUNT = 2_000
COMMON = Taste(constants=False, off_grid=False, plain=True, depth=3)


@pytest.mark.parametrize("numbers", seeds(COUNT, 50))
def test_rtamt_says_the_same(numbers: range) -> None:
    compared = 0
    for seed in numbers:
        case = Case(seed, COMMON)
        if case.samples < 2:  # RTAMT does not judge a single sample
            continue
        found = case.monitor().robustness(case.signals, end="truncate")
        case.same(found, values(case.formula, case.signals), "RTAMT")
        compared += 1
    assert compared > 0.8 * len(numbers)
