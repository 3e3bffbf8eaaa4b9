"""Timing of functions, interleaved so that other load affects all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median
from typing import TypeVar

import numpy as np
import torch

from stlc.controller.training.loop import keep_freed_memory

Item = TypeVar("Item")
Measured = TypeVar("Measured")

_SLICE = 0.01
"""Minimum duration of one measurement in seconds."""
WARM = 5
"""Number of first measurements that are repeated, as they warm the caches."""


@dataclass(frozen=True, slots=True)
class Times:
    """Milliseconds of decisions.

    Attributes:
        median: of them.
        p99: 99th percentile.
        samples: how many.
    """

    median: float
    p99: float
    samples: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Times | None:
        """Statistics of times in seconds; None for an empty list."""
        if not seconds:
            return None
        median, p99 = np.quantile(1e3 * np.asarray(seconds), (0.5, 0.99))
        return cls(float(median), float(p99), len(seconds))


def interleaved(functions: Sequence[Callable[[], object]], seconds: float) -> list[list[float]]:
    """Processor times of each function in seconds, one per round.

    Args:
        functions: to time.
        seconds: total duration; at least three rounds are made.
    """
    often = [_repeats(function) for function in functions]
    samples: list[list[float]] = [[] for _ in functions]
    stop = time.monotonic() + seconds
    while len(samples[0]) < 3 or time.monotonic() < stop:
        for function, repeats, found in zip(functions, often, samples, strict=True):
            found.append(_timed(function, repeats) / repeats)
    return samples


def after_warm_up(measure: Callable[[Item], Measured], items: Sequence[Item]) -> list[Measured]:
    """Measurements of all items; the first few are measured twice, as their first time warms the caches."""
    return [measure(item) for item in (*items[:WARM], *items)][min(WARM, len(items)) :]


def ratio(some: Sequence[float], others: Sequence[float]) -> float:
    """Median over rounds of the ratio of two functions' times."""
    return median(a / b for a, b in zip(some, others, strict=True))


def _repeats(function: Callable[[], object]) -> int:
    """Number of calls of a function per measurement, after warm-up calls."""
    function()
    once = _timed(function, 1)
    return max(int(_SLICE / max(once, 1e-9)), 1)


def _timed(function: Callable[[], object], repeats: int) -> float:
    start = time.process_time()
    for _ in range(repeats):
        function()
    return time.process_time() - start


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread of torch and keep freed memory, so that page faults are not timed."""
    keep_freed_memory()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
