"""Exact robustness and states of plans with gradients from emitted C, as a torch function.

One training step in torch is some thousand small array operations; this is two calls. The gradient is that of
exact minima and maxima with straight-through conditions (`switch.StraightThrough`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.c.numbers import Untranslatable
from stlc.controller.problem.kernel import NativeJudge, motion_of
from stlc.native import Adjoint, Outcome, load

if TYPE_CHECKING:
    from collections.abc import Mapping

    from stlc.controller.problem.task import Task


class NativeGradient:
    """Robustness and states of one task's plans, differentiable by the plans.

    Attributes:
        judge: gives the values.
        adjoint: gives the gradient.
    """

    def __init__(self, judge: NativeJudge, adjoint: Adjoint) -> None:
        self.judge = judge
        self.adjoint = adjoint

    @classmethod
    def of(cls, task: Task) -> NativeGradient | None:
        """For a task; None where torch has to differentiate."""
        if task.native is None:
            return None
        fixed = [timer.name for timer in task.system.timers]
        try:
            library = load(emit_adjoint(motion_of(task), [rule.formula for rule in task.rules], fixed=fixed))
        except Untranslatable:
            return None
        return None if library is None else cls(task.native, Adjoint(library))

    def __call__(self, x0: Tensor, u: Tensor, *, slope: float) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Robustness per requirement (B, R) and states (T+1, B) by name, differentiable by `u`.

        Args:
            x0: (B, n), not differentiated.
            u: (B, T, m).
            slope: of conditions, per unit, in the gradient.
        """
        each, columns = _Judged.apply(self, x0, u, slope)  # type: ignore[no-untyped-call]
        return each, dict(zip(self.judge.names, columns.unbind(0), strict=True))


class _Judged(torch.autograd.Function):
    """Values from `judge`, gradients from `pull`."""

    @staticmethod
    def forward(
        ctx: Any, native: NativeGradient, x0: Tensor, u: Tensor, slope: float
    ) -> tuple[Tensor, Tensor]:
        each, columns = native.judge.judge(x0, u, columns=True)
        ctx.native, ctx.slope = native, slope
        ctx.save_for_backward(x0, u)
        ctx.set_materialize_grads(False)
        return each, torch.stack(list(columns.values()))

    @staticmethod
    def backward(
        ctx: Any, by_each: Tensor | None, by_columns: Tensor | None
    ) -> tuple[None, None, Tensor, None]:
        x0, u = ctx.saved_tensors
        if by_each is None:
            by_each = u.new_zeros(len(u), ctx.native.judge.rules)
        gradient = ctx.native.adjoint.pull(
            *(part.detach().double().numpy() for part in (x0, u)),
            Outcome(
                by_each.double().numpy(),
                None if by_columns is None else by_columns.double().numpy(),
                ctx.slope,
            ),
            threads=torch.get_num_threads(),
        )
        return None, None, torch.from_numpy(gradient).to(u.dtype), None
