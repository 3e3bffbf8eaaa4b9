"""Windows over few numbers or few traces, by operations that torch has: how many there are is what counts.

Of a handful of numbers windows are laid side by side, which takes `rows * width` numbers: a few thousand at
most. Of a few traces blocks are scanned by running extrema, which are quick along time alone.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from stlc.compile.backends.array.extremum import Pick, Sliding, dual, neutral

_SMALL = 1 << 12
"""The most numbers in all windows together."""


def is_small(x: Tensor, window: Sliding) -> bool:
    """Whether the windows may be laid side by side."""
    return x.numel() * window.width <= _SMALL


def block_extrema(x: Tensor, pick: Pick, window: Sliding) -> Tensor:
    """Exact extrema of sliding windows: the end of one block and the beginning of the next."""
    blocks, length = window.shape
    filled = pad(x, (0, 0, 0, window.covered - window.rows), value=neutral(pick))[: window.covered]
    cut = filled.reshape(blocks, length, x.shape[1])
    run, choose = (torch.cummin, torch.minimum) if pick == "min" else (torch.cummax, torch.maximum)
    heads = run(cut, 1).values.reshape(-1, x.shape[1])
    tails = run(cut.flip(1), 1).values.flip(1).reshape(-1, x.shape[1])
    stop = window.width - 1
    return choose(tails[: window.count], heads[stop : stop + window.count])


def small_extrema(x: Tensor, pick: Pick, window: Sliding) -> Tensor:
    """Exact extrema of sliding windows: `(time, batch)` -> `(count, batch)`."""
    if window.to_end:
        turned = x.flip(0)
        running = torch.cummin(turned, 0) if pick == "min" else torch.cummax(turned, 0)
        return _first(running.values.flip(0), window.count)
    beside = _beside(x, neutral(pick), window)
    return beside.amin(dim=-1) if pick == "min" else beside.amax(dim=-1)


def small_until(left: Tensor, right: Tensor, pick: Pick, window: Sliding) -> Tensor:
    """Exact `until` and `release`: two of `(time, batch)` -> `(count, batch)`."""
    held, then = _beside(left, neutral(dual(pick)), window), _beside(right, neutral(pick), window)
    if pick == "max":
        return torch.minimum(torch.cummin(held, -1).values, then).amax(dim=-1)
    return torch.maximum(torch.cummax(held, -1).values, then).amin(dim=-1)


def _beside(x: Tensor, fill: float, window: Sliding) -> Tensor:
    """The windows, `(count, batch, width)`."""
    missing = window.count + window.width - 1 - window.rows
    filled = pad(x, (0, 0, 0, missing), value=fill) if missing > 0 else x
    return _first(filled.unfold(0, window.width, 1), window.count)


def _first(x: Tensor, count: int) -> Tensor:
    return x if x.shape[0] == count else x[:count]
