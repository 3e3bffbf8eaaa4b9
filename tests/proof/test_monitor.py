"""Random specifications, as text, on random traces: the monitor against the definitions.

`-m slow` runs 10,000 cases, the ordinary suite some dozens; `tools/proofs.py` any number.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from proof import monitored
from proof.amounts import FULL, seeds
from proof.cases import Case
from proof.levels import robustness

from stlc.monitor.verdict import Monitor


@pytest.mark.parametrize("numbers", seeds(FULL))
def test_every_value_is_the_definition(numbers: range) -> None:
    for seed in numbers:
        monitored.check_values(seed)


@pytest.mark.parametrize("numbers", seeds(FULL // 5, 30))
def test_the_other_evaluator_says_the_same(numbers: range) -> None:
    for seed in numbers:
        monitored.check_other(seed)


@pytest.mark.parametrize("numbers", seeds(FULL))
def test_truth_is_boolean_and_agrees_with_the_sign(numbers: range) -> None:
    for seed in numbers:
        monitored.check_truth(seed)


@pytest.mark.parametrize("numbers", seeds(FULL // 2))
def test_the_mission_clock(numbers: range) -> None:
    for seed in numbers:
        monitored.check_clock(seed)


@pytest.mark.parametrize("numbers", seeds(FULL // 5, 20))
def test_planning_windows(numbers: range) -> None:
    for seed in numbers:
        monitored.check_windows(seed)


def test_on_the_mission_clock_the_end_is_the_last_sample() -> None:
    text = "signal x\nrequire r: always[0, T] x > 0 and always@[5 steps, end] x > 1"
    x = np.array([1.0] * 5 + [3.0, 1.5, 3.0])
    assert Monitor(text, dt=1, horizon=2).robustness({"x": x}, at=0) == 0.5


def test_the_cases_are_worth_their_time() -> None:
    """Most random formulas are neither trivial nor undefined."""
    finite = []
    for seed in range(100):
        case = Case(seed)
        finite += [math.isfinite(v) for v in robustness(case.formula, case.record("truncate"))]
    assert sum(finite) / len(finite) > 0.7
