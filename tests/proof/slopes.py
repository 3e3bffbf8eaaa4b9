"""Gradients of robustness against central differences, away from ties, for every semantics.

The robustness of a random formula is, almost everywhere, one predicate at one sample, so its gradient is the
slope of that predicate. Where a predicate has a kink within a step, or two of them meet, the slopes to both
sides differ: such points are left out, and there must be few of them. The other semantics blend all of them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from proof.cases import Case
from proof.draw import Taste

from stlc.compile.semantics.semantics import LogSumExp, Semantics, semantics_of

STEP = 1e-6
SMOOTH = Taste(smooth=True, constants=False, off_grid=False, depth=3)
SMOOTHED = {"smooth": LogSumExp(5.0), "agm": semantics_of("agm"), "dgmsr": semantics_of("dgmsr")}
MOVED = ("x", "y", "z", "q")


def moved(case: Case, name: str, place: tuple[int, ...], by: float) -> dict[str, Any]:
    changed = case.signals[name].copy()
    changed[place] += by
    return {**case.signals, name: changed}


def check_gradient(seed: int, name: str) -> tuple[int, int]:
    """Numbers of slopes that were compared under a semantics, and of those left out."""
    case = Case(seed, SMOOTH, longest=9, generic=True)
    return compare(case, SMOOTHED.get(name, semantics_of("exact")))


def compare(case: Case, semantics: Semantics) -> tuple[int, int]:
    """Numbers of slopes that were compared, and of those left out."""
    monitor, at = case.monitor(), case.seed % case.samples

    def robustness(signals: dict[str, Any]) -> Any:
        return monitor.robustness(signals, end="truncate", at=at, semantics=semantics)

    tensors = {
        name: torch.tensor(values, requires_grad=name in MOVED) for name, values in case.signals.items()
    }
    value, now = robustness(tensors), robustness(case.signals)
    case.same(value.item(), now, "torch and NumPy")
    if not np.isfinite(now):
        return 0, 0
    gradients = gradients_of(value, tensors)
    moves, ties = places(gradients, case.seed), 0
    for name, place in moves:
        sides = [robustness(moved(case, name, place, by)) - now for by in (STEP, -STEP)]
        if abs(sides[0] + sides[1]) > 0.01 * STEP:
            ties += 1
            continue
        slope, found = (sides[0] - sides[1]) / (2 * STEP), gradients[name][place]
        close = math.isclose(found, slope, rel_tol=1e-6, abs_tol=2e-4)
        assert close, f"{found} instead of {slope}: d/d{name}{place} at {at}\n{case}"
    return len(moves), ties


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
