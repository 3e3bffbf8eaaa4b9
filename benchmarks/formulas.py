"""Formulas whose robustness is timed; each formula is also written by hand in plain torch.

Arrays have the shape (time, batch). Time windows are cut at the end of the trace.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import TypeAlias

import torch
from torch import Tensor

from benchmarks.timing import interleaved, ratio
from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir

Plain: TypeAlias = Callable[[Tensor, Tensor, int], Tensor]
"""Signals x and y `(time, batch)` and the width of a window in steps -> robustness at every sample."""

_FEW = 1 << 12
"""Number of array elements up to which windows are laid out side by side in memory."""


def plain_always_to_end(x: Tensor) -> Tensor:
    """Return at each sample the minimum of `x` from this sample to the end."""
    return torch.cummin(x.flip(0), dim=0).values.flip(0)


def plain_always(x: Tensor, width: int) -> Tensor:
    """Return at each sample the minimum of `x` over this sample and the `width` samples after it."""
    if x.numel() * (width + 1) <= _FEW:
        return _beside(x, width, math.inf).amin(-1)
    return -_van_herk(-x, width + 1)


def plain_eventually(x: Tensor, width: int) -> Tensor:
    """Return at each sample the maximum of `x` over this sample and the `width` samples after it."""
    if x.numel() * (width + 1) <= _FEW:
        return _beside(x, width, -math.inf).amax(-1)
    return _van_herk(x, width + 1)


def plain_until(left: Tensor, right: Tensor, width: int) -> Tensor:
    """Return the robustness of "`left` until `right` within `width` samples" at each sample."""
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
    """Return the robustness of "`x` is above every threshold" at each sample."""
    return torch.stack([x - threshold for threshold in thresholds]).amin(0)


def _beside(x: Tensor, width: int, fill: float) -> Tensor:
    return torch.nn.functional.pad(x, (0, 0, 0, width), value=fill).unfold(0, width + 1, 1)


def _van_herk(x: Tensor, rows: int) -> Tensor:
    """Return the maxima over sliding windows of `rows` samples by van Herk's algorithm.

    The samples are divided into blocks of `rows` samples. A window extends over at most two blocks. So its
    maximum is that of a running maximum from the end of the first block and one from the start of the second.
    """
    samples, batch = x.shape
    blocks = -(-(samples + rows - 1) // rows)
    padded = torch.nn.functional.pad(x, (0, 0, 0, blocks * rows - samples), value=-math.inf)
    cut = padded.view(blocks, rows, batch)
    heads = torch.cummax(cut, dim=1).values.view(-1, batch)
    tails = torch.cummax(cut.flip(1), dim=1).values.flip(1).reshape(-1, batch)
    return torch.maximum(tails[:samples], heads[rows - 1 : rows - 1 + samples])


@dataclass(frozen=True, slots=True)
class Case:
    """A formula over the signals `x` and `y`, whose robustness is timed.

    Attributes:
        name: name as printed; `w` stands for the width of its time windows.
        formula: function that returns the formula for a given window width in steps.
        plain: function that computes the same robustness in plain torch.
    """

    name: str
    formula: Callable[[int], ir.Formula]
    plain: Plain


def _atom(name: str, above: float = 0.0) -> ir.Predicate:
    column = ir.Signal(name)
    return ir.Predicate(column - above if above else column)


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


# ------------------------------------------------------------------------------- timing

_MOST_PLAIN = 1 << 21
"""Number of array elements above which plain torch is not timed: it takes minutes, or exhausts the memory."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Measured time of the robustness of one formula on traces of one size.

    Attributes:
        formula: name of the formula.
        samples: number of samples per trace.
        traces: number of traces.
        width: width of the time windows in steps.
        gradient: whether the backward pass is included.
        seconds: processor time.
        passes: processor time divided by that of one pass over a signal in memory.
        plain: processor time of plain torch divided by `seconds`; None if plain torch was not timed.
    """

    formula: str
    samples: int
    traces: int
    width: int
    gradient: bool
    seconds: float
    passes: float
    plain: float | None

    @property
    def time(self) -> str:
        """Processor time as text with its unit."""
        return f"{self.seconds * 1e3:.2f} ms" if self.seconds >= 1e-3 else f"{self.seconds * 1e6:.0f} us"


def width_of(samples: int) -> int:
    """Return the width of a time window in steps: a tenth of the number of samples, and at least 5."""
    return max(samples // 10, 5)


def timing_of(case: Case, shape: tuple[int, int], *, gradient: bool, seconds: float) -> Timing:
    """Measure the time of a formula on arrays of shape (samples, traces), for about `seconds`.

    With `gradient`, the backward pass is included.
    """
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
