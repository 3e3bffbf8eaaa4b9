"""The native kernel of a task: the same verdicts as the torch graph, tens of times faster.

It serves where no gradient is needed: choosing among plans, search, the backup policy, the guard. Without a
compiler, on another device, or for formulas that have no C form, torch does the same work.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from stlc.compile.backends.c.emit import Motion, emit
from stlc.compile.backends.c.numbers import Untranslatable
from stlc.native import Climb, Kernel, Stop, load, never

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

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
