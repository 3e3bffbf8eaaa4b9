"""`stlc bench robustness`: robustness of whole traces against one pass over memory, and against plain torch.

A pass is `x.clone()`, and with gradients its backward too, over one signal of the same size. Traces are
float32 on one thread; values are those at every sample, windows cut at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from stlc.bench.cases import CASES, Case
from stlc.bench.measure import interleaved, one_thread, ratio
from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.torch.ops import TORCH

SAMPLES = (20, 100, 1000, 10_000)
BATCHES = (1, 1000)

_MOST_PLAIN = 1 << 21
"""From so many numbers on plain torch is left out: it takes minutes, or all of the memory."""


@dataclass(frozen=True, slots=True)
class Timing:
    """One formula at one size.

    Attributes:
        case: name of the formula.
        samples: of a trace.
        batch: number of traces.
        width: of its windows, in steps.
        gradient: with the backward pass.
        seconds: processor time.
        passes: the same as a multiple of one pass over memory.
        plain: time of plain torch as a multiple of ours; None where it was left out.
    """

    case: str
    samples: int
    batch: int
    width: int
    gradient: bool
    seconds: float
    passes: float
    plain: float | None


def robustness_timings(
    samples: Iterable[int] = SAMPLES, batches: Iterable[int] = BATCHES, *, seconds: float = 0.3
) -> Iterator[Timing]:
    """Times of all cases, one after the other.

    Args:
        samples: lengths of traces.
        batches: numbers of traces.
        seconds: of measurement for each row, about.
    """
    lengths = tuple(samples)
    with one_thread():
        for batch in batches:
            for length in lengths:
                for case in CASES:
                    for gradient in (False, True):
                        yield _time(case, (length, batch), gradient=gradient, seconds=seconds)


def width_of(samples: int) -> int:
    """Steps of a window: a tenth of the trace, and at least 5."""
    return max(samples // 10, 5)


def _time(case: Case, shape: tuple[int, int], *, gradient: bool, seconds: float) -> Timing:
    x, y, data, weights = _arrays(shape)
    width = width_of(shape[0])
    formula = case.formula(width)
    todo: list[Callable[[], Tensor]] = [
        lambda: data.clone(),
        lambda: robustness_signal(formula, {"x": x, "y": y}, ops=TORCH, end="truncate"),
    ]
    if x.numel() <= _MOST_PLAIN:
        todo.append(lambda: case.plain(x, y, width))
    leaves = (x, y, data)
    wrapped = [_backward(each, weights, leaves) if gradient else _forward(each) for each in todo]
    floor, ours, *plain = interleaved(wrapped, seconds)
    slower = ratio(plain[0], ours) if plain else None
    return Timing(case.name, *shape, width, gradient, median(ours), ratio(ours, floor), slower)


def _arrays(shape: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    x, y, data, weights = (torch.randn(shape, generator=generator) for _ in range(4))
    return x.requires_grad_(), y.requires_grad_(), data.requires_grad_(), weights


def _forward(function: Callable[[], Tensor]) -> Callable[[], None]:
    def run() -> None:
        with torch.no_grad():
            function()

    return run


def _backward(
    function: Callable[[], Tensor], weights: Tensor, leaves: tuple[Tensor, ...]
) -> Callable[[], None]:
    def run() -> None:
        for leaf in leaves:
            leaf.grad = None
        function().backward(weights)  # type: ignore[no-untyped-call]

    return run
