"""Formulas whose robustness is timed, each also written by hand in plain torch.

Arrays are `(time, batch)`; windows are clipped at the end of the trace.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from stlc.compile.ir import nodes as ir

Plain: TypeAlias = Callable[[Tensor, Tensor, int], Tensor]
"""Signals x and y `(time, batch)` and the width of a window in steps -> robustness at every sample."""

_FEW = 1 << 12
"""Number of array elements up to which windows are unfolded."""


def plain_always_to_end(x: Tensor) -> Tensor:
    """Minimum from every sample to the end."""
    return torch.cummin(x.flip(0), dim=0).values.flip(0)


def plain_always(x: Tensor, width: int) -> Tensor:
    """Minimum over every sample and the `width` samples after it."""
    if x.numel() * (width + 1) <= _FEW:
        return _beside(x, width, math.inf).amin(-1)
    return -_van_herk(-x, width + 1)


def plain_eventually(x: Tensor, width: int) -> Tensor:
    """Maximum over every sample and the `width` samples after it."""
    if x.numel() * (width + 1) <= _FEW:
        return _beside(x, width, -math.inf).amax(-1)
    return _van_herk(x, width + 1)


def plain_until(left: Tensor, right: Tensor, width: int) -> Tensor:
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


def plain_conjunction(x: Tensor, thresholds: Sequence[float]) -> Tensor:
    """`x` above every threshold."""
    return torch.stack([x - threshold for threshold in thresholds]).amin(0)


def _beside(x: Tensor, width: int, fill: float) -> Tensor:
    return torch.nn.functional.pad(x, (0, 0, 0, width), value=fill).unfold(0, width + 1, 1)


def _van_herk(x: Tensor, rows: int) -> Tensor:
    """Sliding maxima over `rows` samples by van Herk's algorithm: block maxima forwards and backwards."""
    samples, batch = x.shape
    blocks = -(-(samples + rows - 1) // rows)
    padded = torch.nn.functional.pad(x, (0, 0, 0, blocks * rows - samples), value=-math.inf)
    cut = padded.view(blocks, rows, batch)
    heads = torch.cummax(cut, dim=1).values.view(-1, batch)
    tails = torch.cummax(cut.flip(1), dim=1).values.flip(1).reshape(-1, batch)
    return torch.maximum(tails[:samples], heads[rows - 1 : rows - 1 + samples])


@dataclass(frozen=True, slots=True)
class Case:
    """A formula over the signals `x` and `y`.

    Attributes:
        name: as it is printed; `w` stands for the width of its windows.
        formula: as a function of the window width in steps.
        plain: the same in plain torch.
    """

    name: str
    formula: Callable[[int], ir.Formula]
    plain: Plain


def _atom(name: str, above: float = 0.0) -> ir.Predicate:
    column = ir.Signal(name)
    return ir.Predicate(ir.Op("sub", (column, ir.Const(above))) if above else column)


def _over(op: str, hi: int | None, body: ir.Formula) -> ir.Temporal:
    return ir.Temporal("always" if op == "always" else "eventually", ir.Window(0, hi), body)


_TEN = tuple(0.1 * number for number in range(10))
CASES = (
    Case(
        "G[0,end] p",
        lambda _: _over("always", None, _atom("x")),
        lambda x, _, __: plain_always_to_end(x),
    ),
    Case(
        "G[0,w] p",
        lambda width: _over("always", width, _atom("x")),
        lambda x, _, width: plain_always(x, width),
    ),
    Case(
        "F[0,w] p",
        lambda width: _over("eventually", width, _atom("x")),
        lambda x, _, width: plain_eventually(x, width),
    ),
    Case(
        "G[0,end] F[0,w] p",
        lambda width: _over("always", None, _over("eventually", width, _atom("x"))),
        lambda x, _, width: plain_always_to_end(plain_eventually(x, width)),
    ),
    Case(
        "p U[0,w] q",
        lambda width: ir.Until("until", ir.Window(0, width), _atom("x"), _atom("y")),
        plain_until,
    ),
    Case(
        "p1 and ... and p10",
        lambda _: ir.BoolOp("and", tuple(_atom("x", above) for above in _TEN)),
        lambda x, _, __: plain_conjunction(x, _TEN),
    ),
)
"""All timed formulas."""
