"""Array operations of torch, with gradients, on any device. Every method is one or two torch operations."""

from __future__ import annotations

import operator
from collections.abc import Hashable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache, reduce
from itertools import pairwise
from typing import Any, cast, final

import torch
from torch import Tensor

from stlc.compile.backends.torch.extrema import (
    by_kernel,
    choice,
    reduction,
    small_windows,
)
from stlc.compile.backends.torch.guarded import lerp, sifted
from stlc.compile.ir.functions import FUNCTIONS
from stlc.compile.namespace import Mask, Ops, Pick, ScanByRows, Sliding


class _MaskedRows(torch.autograd.Function):
    """Autograd function: copy of an array in which some rows are replaced by a constant.

    `where` are ranges of these rows, which have no gradient.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, where: Sequence[range], value: float) -> Tensor:
        ctx.where = where
        out = x.clone()
        for rows in where:
            out[rows.start : rows.stop] = value
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return _MaskedRows.apply(grad, ctx.where, 0.0), None, None  # type: ignore[no-untyped-call]


class _SmoothMax(torch.autograd.Function):
    """Autograd function: `log(sum(exp(k x))) / k` over axis 0, which is kept with length 1, and its gradient.

    The gradient is the second result, so that it can be differentiated in turn. Infinite values have gradient
    0 and cause no NaN.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, k: float) -> tuple[Tensor, Tensor]:
        top = x.amax(dim=0, keepdim=True) if k > 0 else x.amin(dim=0, keepdim=True)
        unbounded = torch.isinf(top)
        shares = ((x - top.masked_fill(unbounded, 0.0)) * k).clamp_max_(0.0).exp_()
        total = shares.sum(dim=0, keepdim=True)
        shares.div_(total.masked_fill(unbounded, torch.inf))
        ctx.k = k
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(shares)
        return top + total.log_() / k, shares

    @staticmethod
    def backward(ctx: Any, grad: Tensor | None, by_shares: Tensor | None) -> tuple[Tensor | None, None]:
        (shares,) = ctx.saved_tensors
        total = None if grad is None else grad * shares
        if by_shares is not None:
            moved = shares * by_shares
            bent = ctx.k * (moved - shares * moved.sum(dim=0, keepdim=True))
            total = bent if total is None else total + bent
        return total, None


class _SmoothMax2(torch.autograd.Function):
    """Autograd function: `log(exp(k a) + exp(k b)) / k` for operands of the same shape, and its gradients.

    The gradients are the other results, as for `_SmoothMax`.
    """

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor, k: float) -> tuple[Tensor, Tensor, Tensor]:
        top = torch.maximum(a, b) if k > 0 else torch.minimum(a, b)
        unbounded = torch.isinf(top)
        gap = (a - b).masked_fill_(unbounded, torch.inf)
        left = torch.sigmoid(gap * k)
        right = (1.0 - left).masked_fill_(unbounded, 0.0)
        left.masked_fill_(unbounded, 0.0)
        ctx.k = k
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(left, right)
        return top + torch.log1p(torch.exp(gap.abs_() * -abs(k))) / k, left, right

    @staticmethod
    def backward(
        ctx: Any, grad: Tensor | None, by_left: Tensor | None, by_right: Tensor | None
    ) -> tuple[Tensor | None, Tensor | None, None]:
        left, right = ctx.saved_tensors
        by_a, by_b = (None, None) if grad is None else (grad * left, grad * right)
        for part, sign in ((by_left, ctx.k), (by_right, -ctx.k)):
            if part is not None:
                bent = part * left * right * sign
                by_a, by_b = (bent, -bent) if by_a is None else (by_a + bent, by_b - bent)
        return by_a, by_b, None


class _Accumulated(torch.autograd.Function):
    """Autograd function: running sum of `start` (1, …) and `x` (count, …). Faster than `cumsum`."""

    @staticmethod
    def forward(_ctx: Any, start: Tensor, x: Tensor) -> Tensor:
        out = x.new_empty(len(x) + 1, *x.shape[1:])
        rows = out.unbind(0)
        rows[0].copy_(start[0])
        for before, after, added in zip(rows, rows[1:], x.unbind(0), strict=False):
            torch.add(before, added, out=after)
        return out

    @staticmethod
    def backward(_ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        if torch.is_grad_enabled():  # the gradient is to be differentiated in turn
            below = grad.flip(0).cumsum(0).flip(0)
        else:
            below = grad.clone(memory_format=torch.contiguous_format)
            for row, later in pairwise(below.unbind(0)[::-1]):
                later.add_(row)
        return below[:1], below[1:]


@lru_cache(maxsize=4096)
def _constant(value: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(value, dtype=dtype, device=device)


def _pair(a: Tensor | float, b: Tensor | float) -> tuple[Tensor, Tensor]:
    """Return both operands as tensors, for torch functions that do not accept a float."""
    if isinstance(a, Tensor):
        return a, b if isinstance(b, Tensor) else _constant(b, a.dtype, a.device)
    assert isinstance(b, Tensor)
    return _constant(a, b.dtype, b.device), b


@final
class TorchOps(ScanByRows):
    """Implementation of `stlc.compile.namespace.Ops` for torch tensors.

    Results keep dtype and device. Operands are `(time, batch)`, or of any shapes that broadcast. Reductions
    over time give `(1, batch)`.
    """

    name = "torch"

    @property
    def guarded(self) -> Ops:
        """The same operations with gradients that are finite where values are infinite or NaN."""
        return _GUARDED

    add = staticmethod(operator.add)
    sub = staticmethod(operator.sub)
    mul = staticmethod(operator.mul)
    div = staticmethod(operator.truediv)
    pow = staticmethod(operator.pow)
    expm1 = staticmethod(torch.expm1)
    log1p = staticmethod(torch.log1p)
    sigmoid = staticmethod(torch.sigmoid)
    minimum = staticmethod(torch.minimum)
    maximum = staticmethod(torch.maximum)
    gt = staticmethod(operator.gt)
    ge = staticmethod(operator.ge)
    both = staticmethod(operator.and_)
    either = staticmethod(operator.or_)
    where = staticmethod(torch.where)

    def atan2(self, a: Tensor | float, b: Tensor | float) -> Tensor:
        return torch.atan2(*_pair(a, b))

    def axpy(self, a: Tensor | float, b: Tensor, factor: float) -> Tensor:
        return torch.add(a, b, alpha=factor) if isinstance(a, Tensor) else b * factor + a

    def addcmul(self, a: Tensor | float, b: Tensor, c: Tensor, factor: float) -> Tensor:
        return torch.addcmul(_pair(a, b)[0], b, c, value=factor)

    def clamp(self, x: Tensor, low: float | None, high: float | None) -> Tensor:
        """Clamp `x` to [low, high]; the gradient at a bound is 1."""
        return torch.clamp(x, low, high)

    def norm(self, *components: Tensor | float) -> Tensor:
        like = next(part for part in components if isinstance(part, Tensor))
        first, *others = (_pair(part, like)[0] for part in components)
        total = first * first
        for part in others:
            total = torch.addcmul(total, part, part)
        if not total.requires_grad:
            return total.sqrt()
        positive = total > 0.0
        return torch.where(positive, torch.where(positive, total, 1.0).sqrt(), total)

    def settled(self, weight: Tensor, mask: Mask) -> Tensor:
        return weight + (self.number(mask, weight) - weight.detach())

    def number(self, mask: Mask, like: Tensor) -> Tensor:
        out: Tensor = mask.to(like.dtype)
        return out

    def lerp(self, no: Tensor | float, yes: Tensor | float, weight: Tensor) -> Tensor:
        return torch.lerp(*_pair(no, yes), weight)

    def margin(self, x: Tensor) -> Tensor:
        return x

    def infinite(self, mask: Mask, like: Tensor) -> Tensor:
        """Array that is +inf where `mask` is True, else -inf, without gradient."""
        return torch.where(mask, self.constant(torch.inf, like), self.constant(-torch.inf, like))

    def straight_through(self, rho: Tensor, strict: bool, slope: float) -> Tensor:
        hard = torch.heaviside(rho.detach(), self.constant(0.0 if strict else 1.0, rho))
        if not rho.requires_grad:
            return hard
        soft = torch.sigmoid(rho * self.constant(2.0 * slope, rho))
        return soft + (hard - soft.detach())

    def amin(self, x: Tensor) -> Tensor:
        """Minimum over axis 0, which is kept with length 1; equal operands share the gradient."""
        return reduction(x, "min")

    def amax(self, x: Tensor) -> Tensor:
        """Maximum over axis 0, which is kept with length 1; equal operands share the gradient."""
        return reduction(x, "max")

    def sum(self, x: Tensor) -> Tensor:
        return x.sum(dim=0, keepdim=True)

    def cummin(self, x: Tensor) -> Tensor:
        return torch.cummin(x, dim=0).values

    def cummax(self, x: Tensor) -> Tensor:
        return torch.cummax(x, dim=0).values

    def accumulate(self, start: Tensor, x: Tensor) -> Tensor:
        if torch.compiler.is_exporting():  # a single operation
            return torch.cat((start, x)).cumsum(0)
        out: Tensor = _Accumulated.apply(start, x)  # type: ignore[no-untyped-call]
        return out

    def split(self, x: Tensor) -> Sequence[Tensor]:
        return torch.chunk(x, len(x))

    def repeat(self, x: Tensor, count: int) -> Tensor:
        return x.expand(count, *x.shape[1:])

    def join(self, items: Sequence[Tensor], pick: Pick) -> Tensor:
        """Exact minimum or maximum of arrays.

        If several operands are equal, they may share the gradient, or one of them gets all of it.
        """
        if torch.compiler.is_exporting():  # the choice must not depend on the batch size
            return reduce(torch.minimum if pick == "min" else torch.maximum, items)
        return choice(items, pick)

    def windows(self, operands: Sequence[Tensor], pick: Pick, window: Sliding) -> Tensor | None:
        """Exact extrema over sliding windows, or `until`; None if the caller must use other operations.

        If several values are equal, one of them may get the whole gradient.
        """
        first = operands[0]
        on_gpu = len(operands) == 2 and first.is_cuda
        if first.ndim != 2 or on_gpu or torch.compiler.is_exporting():
            return None
        found = small_windows(operands, pick, window)
        return by_kernel(operands, pick, window) if found is None else found

    def softmax(self, x: Tensor, k: float) -> Tensor:
        """Smooth maximum (`k` > 0) or smooth minimum (`k` < 0) over axis 0, which is kept with length 1."""
        out, _ = _SmoothMax.apply(x, k)  # type: ignore[no-untyped-call]
        return out  # type: ignore[no-any-return]

    def softmax2(self, a: Tensor, b: Tensor, k: float) -> Tensor:
        """Smooth maximum (`k` > 0) or smooth minimum (`k` < 0) of two arrays of the same shape."""
        out, _, _ = _SmoothMax2.apply(a, b, k)  # type: ignore[no-untyped-call]
        return out  # type: ignore[no-any-return]

    def kind(self, like: Tensor) -> Hashable:
        """Return (dtype, device) of `like`; arrays with equal keys can share converted constants."""
        return like.dtype, like.device

    def constant(self, value: float, like: Tensor) -> Tensor:
        """Return a zero-dimensional tensor, since torch would convert a Python number in every operation."""
        return _constant(value, like.dtype, like.device)

    def full(self, shape: tuple[int, ...], value: float, like: Tensor) -> Tensor:
        """Array of a constant; infinite if the dtype cannot represent the value."""
        return self.constant(value, like).expand(shape).clone()

    def cat(self, parts: Sequence[Tensor]) -> Tensor:
        return torch.cat(list(parts))

    def stack(self, parts: Sequence[Tensor]) -> Tensor:
        return torch.stack(list(parts))

    def counted(self, first: int, count: int, like: Tensor) -> Tensor:
        """Array with the numbers `first`, `first + 1`, …, `first + count - 1` along time."""
        numbers = torch.arange(first, first + count, dtype=like.dtype, device=like.device)
        return numbers.view(-1, *(1,) * (like.ndim - 1)).expand(count, *like.shape[1:])

    def empty(self, shape: tuple[int, ...], like: Tensor) -> Tensor:
        """Uninitialized tensor that is writable also outside of inference mode."""
        with torch.inference_mode(False):
            return like.new_empty(shape)

    def flip(self, x: Tensor) -> Tensor:
        return x.flip(0)

    def rows(self, where: Sequence[range], x: Tensor, value: float) -> Tensor:
        if where and torch.compiler.is_exporting():
            mask = torch.tensor([any(row in each for each in where) for row in range(len(x))])
            return torch.where(mask.view(-1, *(1,) * (x.ndim - 1)), value, x)
        out: Tensor = _MaskedRows.apply(x, where, value) if where else x  # type: ignore[no-untyped-call]
        return out

    def columns(self, x: Tensor) -> Sequence[Tensor]:
        """Split trajectories `(batch, time, dim)` into tensors `(time, batch)`, one per state.

        The tensors are views of one copy.
        """
        return x.permute(2, 1, 0).contiguous().unbind(0)

    def quiet(self) -> AbstractContextManager[object]:
        """Empty context, since torch does not warn of invalid operations."""
        return nullcontext()


for _function in FUNCTIONS.values():
    if _function.torch:
        setattr(TorchOps, _function.name, staticmethod(getattr(torch, _function.torch)))

TORCH: Ops = cast("Ops", TorchOps())


class _GuardedOps:
    """Torch operations with gradients that are finite where values are infinite or NaN."""

    def __getattr__(self, name: str) -> Any:
        found = sifted(getattr(TORCH, name))
        setattr(self, name, found)
        return found

    def lerp(self, no: Tensor | float, yes: Tensor | float, weight: Tensor) -> Tensor:
        return lerp(*_pair(no, yes), weight)

    def straight_through(self, rho: Tensor, strict: bool, slope: float) -> Tensor:
        """Return 1 where a condition holds, else 0; a condition whose margin is NaN does not hold."""
        known: Tensor = torch.nan_to_num(rho, -torch.inf, torch.inf, -torch.inf)
        return TORCH.straight_through(known, strict, slope)  # type: ignore[no-any-return]


_GUARDED = cast("Ops", _GuardedOps())
