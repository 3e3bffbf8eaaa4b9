"""Gradients of the exact robustness against central differences, away from ties.

The robustness of a random formula is, almost everywhere, one predicate at one sample, so its gradient is the
slope of that predicate. Where a predicate has a kink within a step, or two of them meet, the slopes to both
sides differ: such points are left out, and there must be few of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from proof.cases import FULL, Case, seeds
from proof.draw import Taste

STEP = 1e-6
SMOOTH = Taste(smooth=True, constants=False, off_grid=False, depth=3)
MOVED = ("x", "y", "z", "q")


def moved(case: Case, name: str, place: tuple[int, ...], by: float) -> dict[str, Any]:
    changed = case.signals[name].copy()
    changed[place] += by
    return {**case.signals, name: changed}


@pytest.mark.parametrize("numbers", seeds(FULL, 60))
def test_the_gradient_is_the_central_difference(numbers: range) -> None:
    ties = compared = 0
    for seed in numbers:
        case = Case(seed, SMOOTH, longest=9, generic=True)
        monitor = case.monitor()
        at = seed % case.samples
        tensors = {
            name: torch.tensor(values, requires_grad=name in MOVED) for name, values in case.signals.items()
        }
        value = monitor.robustness(tensors, end="truncate", at=at)
        now = monitor.robustness(case.signals, end="truncate", at=at)
        case.same(value.item(), now, "torch and NumPy")
        if not np.isfinite(now):
            continue
        gradients = gradients_of(value, tensors)
        for name, place in places(gradients, seed):
            sides = [
                monitor.robustness(moved(case, name, place, by), end="truncate", at=at) - now
                for by in (STEP, -STEP)
            ]
            compared += 1
            if abs(sides[0] + sides[1]) > 0.01 * STEP:
                ties += 1
                continue
            slope = (sides[0] - sides[1]) / (2 * STEP)
            found = gradients[name][place]
            assert found == pytest.approx(slope, abs=2e-4), f"d/d{name}{place} at {at}\n{case}"
    assert compared > 3 * len(numbers)
    assert ties < 0.02 * compared


def gradients_of(value: torch.Tensor, tensors: dict[str, torch.Tensor]) -> dict[str, Any]:
    value.backward()
    return {
        name: np.zeros(tensors[name].shape) if tensors[name].grad is None else tensors[name].grad.numpy()
        for name in MOVED
    }


def places(gradients: dict[str, Any], seed: int) -> list[tuple[str, tuple[int, ...]]]:
    """Numbers to move: all that have a gradient, and one of every signal."""
    source = np.random.default_rng(seed)
    chosen = [(name, tuple(map(int, place))) for name in MOVED for place in np.argwhere(gradients[name])]
    return chosen + [
        (name, tuple(int(source.integers(size)) for size in gradients[name].shape)) for name in MOVED
    ]
