"""Gradients that are finite where values are infinite or NaN.

A branch that is not taken, such as `x / y` in `y > 0 -> x / y < 2`, has the gradient 0, and 0 times an
infinite derivative is NaN. So a derivative that is not finite counts as 0. This holds for derivatives of any
order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


class _Sifted(torch.autograd.Function):
    """Autograd function: identity whose gradient is 0 where it would be infinite or NaN.

    With `clear`, values that are infinite or NaN are replaced by 0, too.
    """

    @staticmethod
    def forward(_ctx: Any, x: Tensor, clear: bool) -> Tensor:
        return torch.nan_to_num(x, 0.0, 0.0, 0.0) if clear else x.view_as(x)

    @staticmethod
    def backward(_ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        if not torch.is_grad_enabled():
            return torch.nan_to_num(grad, 0.0, 0.0, 0.0), None
        return _Sifted.apply(grad, True), None  # type: ignore[no-untyped-call]


def sift(x: Any) -> Any:
    """Return `x`, with a gradient that is 0 where it would be infinite or NaN."""
    if isinstance(x, Tensor) and x.requires_grad:
        return _Sifted.apply(x, False)  # type: ignore[no-untyped-call]
    return x


def sifted(kernel: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Return the operation `kernel` with derivatives that count as 0 where they are infinite or NaN."""
    return lambda *args: sift(kernel(*map(sift, args)))


def lerp(no: Tensor, yes: Tensor, weight: Tensor) -> Tensor:
    """Return `no + weight (yes - no)`, or the nearer of both where one of them is infinite or NaN."""
    known = torch.isfinite(yes - no)
    mixed = torch.lerp(torch.where(known, no, 0.0), torch.where(known, yes, 0.0), weight)
    return torch.where(known, mixed, torch.where(weight < 0.5, no, yes))
