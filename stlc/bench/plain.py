"""Robustness in plain torch: what somebody writes who knows the formula and nothing of this library.

Arrays are `(time, batch)`; windows are cut at the end of the trace.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

_FEW = 1 << 12
"""Up to so many numbers windows are laid side by side."""


def always_to_end(x: Tensor) -> Tensor:
    """Least value from every sample on."""
    return torch.cummin(x.flip(0), dim=0).values.flip(0)


def always(x: Tensor, width: int) -> Tensor:
    """Least value of every sample and the `width` after it."""
    if x.numel() * (width + 1) <= _FEW:
        return _beside(x, width, math.inf).amin(-1)
    return -_van_herk(-x, width + 1)


def eventually(x: Tensor, width: int) -> Tensor:
    """Greatest value of every sample and the `width` after it."""
    if x.numel() * (width + 1) <= _FEW:
        return _beside(x, width, -math.inf).amax(-1)
    return _van_herk(x, width + 1)


def until(left: Tensor, right: Tensor, width: int) -> Tensor:
    """`left` until `right` within `width` samples."""
    if left.numel() * (width + 1) <= _FEW:
        held = torch.cummin(_beside(left, width, math.inf), -1).values
        return torch.minimum(held, _beside(right, width, -math.inf)).amax(-1)
    held, found = left, torch.minimum(left, right)
    for ahead in range(1, min(width, len(left) - 1) + 1):
        held = torch.minimum(held[:-1], left[ahead:])
        met = torch.minimum(held, right[ahead:])
        found = torch.cat([torch.maximum(found[: len(met)], met), found[len(met) :]])
    return found


def conjunction(x: Tensor, thresholds: Sequence[float]) -> Tensor:
    """`x` above every threshold."""
    return torch.stack([x - threshold for threshold in thresholds]).amin(0)


def _beside(x: Tensor, width: int, fill: float) -> Tensor:
    return torch.nn.functional.pad(x, (0, 0, 0, width), value=fill).unfold(0, width + 1, 1)


def _van_herk(x: Tensor, rows: int) -> Tensor:
    """Maxima of `rows` samples: running maxima of blocks, forwards and backwards."""
    samples, batch = x.shape
    blocks = -(-(samples + rows - 1) // rows)
    padded = torch.nn.functional.pad(x, (0, 0, 0, blocks * rows - samples), value=-math.inf)
    cut = padded.view(blocks, rows, batch)
    heads = torch.cummax(cut, dim=1).values.view(-1, batch)
    tails = torch.cummax(cut.flip(1), dim=1).values.flip(1).reshape(-1, batch)
    return torch.maximum(tails[:samples], heads[rows - 1 : rows - 1 + samples])
