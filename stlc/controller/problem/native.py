"""Native code of a task, built from its dynamics and requirements: verdicts, local search and gradients.

The verdicts are those of the torch graph, tens of times faster; one training step in torch is some thousand
small array operations, here it is two calls. Without a compiler, on another device, or for formulas that have
no C form, torch does the same work, and `torch_reasons` says why.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.c.emit import Motion, emit
from stlc.compile.backends.c.numbers import Untranslatable
from stlc.native import Adjoint, Climb, Kernel, Outcome, Stop, load, never, why_none
from stlc.toolchain import compiler

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task


@dataclass(frozen=True, slots=True)
class Effort:
    """How much a native climb tries.

    Attributes:
        generations: of changed plans per row.
        enough: a row is left alone once its robustness reaches this.
        seed: of the changes.
        threads: to share the rows among; the result does not depend on it.
        stop: ends the climb before all rows are done.
    """

    generations: int
    enough: float
    seed: int
    threads: int = 1
    stop: Stop = never


def motion_of(task: Task) -> Motion:
    """One exact step of a task's system, as the C emitters read it."""
    step = task.system.exact_step
    return Motion(task.names, task.system.control_names, step.lets, step.next, task.horizon, task.dt)


class NativeJudge:
    """Judges plans of one task on the processor.

    Attributes:
        kernel: built for the task's dynamics and requirements.
        names: of the state columns.
    """

    def __init__(self, kernel: Kernel, task: Task) -> None:
        self.kernel = kernel
        self.names = task.names
        self.rules = len(task.rules)
        controls = task.system.controls
        turns = torch.tensor([control.squash == "angle" for control in controls])
        low, high = task.system.control_low, task.system.control_high
        self._bounds = torch.stack((low, high, turns.to(low.dtype))).double().numpy()
        self._factors = np.array([rule.weight / rule.scale for rule in task.rules])

    @classmethod
    def of(cls, task: Task) -> NativeJudge | None:
        """The kernel of a task, built if need be; None where torch has to do its work."""
        try:
            library = load(emit(motion_of(task), [rule.formula for rule in task.rules]))
        except Untranslatable:
            return None
        if library is None:
            return None
        return cls(Kernel(library, states=len(task.names), rules=len(task.rules), steps=task.horizon), task)

    def judge(self, x0: Tensor, u: Tensor, *, columns: bool) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Robustness per requirement (B, R), and the states (T+1, B) by name where they are wanted.

        Args:
            x0: (B, n); the kernel computes in float64, the results have the dtype of `x0`.
            u: (B, T, m).
            columns: whether the states are wanted.
        """
        rho, seen = self.kernel.judge(
            x0.detach().double().numpy(),
            u.detach().double().numpy(),
            threads=torch.get_num_threads(),
            columns=columns,
        )
        each = torch.from_numpy(rho).to(x0.dtype)
        if seen is None:
            return each, {}
        return each, dict(zip(self.names, torch.from_numpy(seen).to(x0.dtype).unbind(0), strict=True))

    def climb(
        self,
        x0: Tensor,
        plans: Tensor,
        bank: Tensor,
        effort: Effort,
    ) -> tuple[Tensor, Tensor]:
        """Improve plans by hill climbing on the exact robustness.

        Args:
            x0: (B, n).
            plans: where to start, (B, T, m).
            bank: plans that solved other states, (k, T, m); may be empty.
            effort: how much is tried.

        Returns:
            Plans (B, T, m) and their robustness (B,), in the dtype of `x0`.
        """
        arrays = [tensor.detach().double().contiguous().numpy() for tensor in (x0, plans, bank)]
        how = Climb(
            self._bounds,
            self._factors,
            arrays[2],
            effort.generations,
            effort.enough,
            effort.seed,
            effort.stop,
        )
        best, rho = self.kernel.climb(arrays[0], arrays[1], how, threads=effort.threads)
        return torch.from_numpy(best).to(x0.dtype), torch.from_numpy(rho).to(x0.dtype)


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


def torch_reasons(task: Task, device: str, *, searches: bool, smooth: bool) -> Mapping[str, str]:
    """Why torch does the work: for each part of a training a reason, or "" where it runs as C.

    The parts are `verdicts` of plans, `search` for better ones and the `gradient` of robustness.

    Args:
        task: specification and system.
        device: of torch, by its type.
        searches: whether the training searches for plans.
        smooth: whether its objective is smooth, for which there is no native gradient.
    """
    if device != "cpu":
        return dict.fromkeys(("verdicts", "search", "gradient"), f"the device is {device}")
    rules = [rule.formula for rule in task.rules]
    judged = "" if task.native is not None else _reason(lambda: emit(motion_of(task), rules))
    if smooth:
        gradient = "the paper's objective is smooth"
    elif judged or task.gradient is not None:
        gradient = judged
    else:
        gradient = _reason(lambda: emit_adjoint(motion_of(task), rules))
    searched = {"search": judged} if searches else {}
    return {"verdicts": judged, **searched, "gradient": gradient}


def _reason(text: Callable[[], str]) -> str:
    """Why there is no library of a text."""
    if compiler() is None:
        return "there is no C compiler"
    try:
        return why_none(text())
    except Untranslatable as why:
        return f"{why} has no C form"
