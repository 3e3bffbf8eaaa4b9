"""The native kernel of a task: the same verdicts as the torch graph, tens of times faster.

It serves where no gradient is needed: choosing among plans, search, the backup policy, the guard. Without a
compiler, on another device, or for formulas that have no C form, torch does the same work.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from stlc.compile.c_numbers import Untranslatable
from stlc.compile.emit_c import Motion, emit
from stlc.native import Kernel, build

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from stlc.controller.task import Task


class NativeJudge:
    """Judges plans of one task on the processor.

    Attributes:
        kernel: built for the task's dynamics and requirements.
        names: of the state columns.
    """

    def __init__(self, kernel: Kernel, names: tuple[str, ...]) -> None:
        self.kernel = kernel
        self.names = names

    @classmethod
    def of(cls, task: Task) -> NativeJudge | None:
        """The kernel of a task, built if need be; None where torch has to do its work."""
        step = task.system.exact_step
        motion = Motion(task.names, task.system.control_names, step.lets, step.next, task.horizon, task.dt)
        try:
            path = build(emit(motion, [rule.formula for rule in task.rules]))
        except Untranslatable:
            return None
        if path is None:
            return None
        return cls(
            Kernel(path, states=len(task.names), rules=len(task.rules), steps=task.horizon), task.names
        )

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
