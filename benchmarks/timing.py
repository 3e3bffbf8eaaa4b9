"""Timing of functions that take turns, so that other load on the machine affects all of them alike."""

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
"""Number of measurements that are made twice, because the first ones warm the caches."""


@dataclass(frozen=True, slots=True)
class Times:
    """Statistics of measured decision times, in milliseconds.

    Attributes:
        median: median of the times.
        p99: 99th percentile of the times.
        samples: number of measured times.
    """

    median: float
    p99: float
    samples: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Times | None:
        """Return the statistics of times in seconds; None for an empty list."""
        if not seconds:
            return None
        median, p99 = np.quantile(1e3 * np.asarray(seconds), (0.5, 0.99))
        return cls(float(median), float(p99), len(seconds))


def interleaved(functions: Sequence[Callable[[], object]], seconds: float) -> list[list[float]]:
    """Measure the processor time of each function, in rounds in which the functions take turns.

    Args:
        functions: the functions to time.
        seconds: total duration; at least three rounds are made.

    Returns:
        For each function, its processor time per call in seconds, one number per round.
    """
    often = [_repeats(function) for function in functions]
    samples: list[list[float]] = [[] for _ in functions]
    stop = time.monotonic() + seconds
    while len(samples[0]) < 3 or time.monotonic() < stop:
        for function, repeats, found in zip(functions, often, samples, strict=True):
            found.append(_timed(function, repeats) / repeats)
    return samples


def after_warm_up(measure: Callable[[Item], Measured], items: Sequence[Item]) -> list[Measured]:
    """Call `measure` for each of `items` and return the results.

    The first few items are measured twice, because their first measurement warms the caches.
    """
    return [measure(item) for item in (*items[:WARM], *items)][min(WARM, len(items)) :]


def ratio(some: Sequence[float], others: Sequence[float]) -> float:
    """Return the median of the ratios `some[i] / others[i]` of two functions' times in the same round."""
    return median(a / b for a, b in zip(some, others, strict=True))


def _repeats(function: Callable[[], object]) -> int:
    """Return the number of calls of a function per measurement, so that a measurement is not too short.

    The function is called twice to warm up.
    """
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
    """Context in which torch uses one thread, and freed memory is kept so that page faults are not timed."""
    keep_freed_memory()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
