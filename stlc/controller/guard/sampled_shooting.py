"""Plans that begin with a few actions from a grid and go on as the policy plans from where these end.

The paper's backup policy tries all of them, T0 by T0. Here is a sample of each length, judged in one batch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.controller.guard.shooting import finite

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.runtime.prefixes import Grid


@dataclass(frozen=True, slots=True)
class Begun:
    """Plans from several beginnings, a row an agent.

    Attributes:
        plans: (agents, k, T, m) float64.
        rho: robustness of phi, (agents, k).
        safe: robustness of phi_safe, (agents, k).
        length: of the beginning that each has, (k,) int64.
    """

    plans: Tensor
    rho: Tensor
    safe: Tensor
    length: Tensor


class Beginnings:
    """Beginnings of plans for one task and policy, drawn once.

    Args:
        task: specification and system.
        policy: who finishes them.
        grid: values of the controls, and lengths.
        most: of one length; where the grid has more, a sample of them.
    """

    def __init__(self, task: Task, policy: Policy, grid: Grid, most: int) -> None:
        self.task, self.policy = task, policy
        few = replace(grid, samples=min(grid.samples, most))
        longest = max(grid.lengths, default=0)
        heads, lengths = [torch.zeros(0, longest, len(grid.values), dtype=torch.float64)], []
        for length in grid.lengths:
            some = torch.from_numpy(few.prefixes(length))
            heads.append(torch.cat((some, some.new_zeros(len(some), longest - length, some.shape[2])), 1))
            lengths += [length] * len(some)
        self.heads, self.lengths = torch.cat(heads), torch.tensor(lengths, dtype=torch.int64)
        self._most = max(grid.batch // max(len(self.heads), 1), 1)

    def finished(self, x: Tensor) -> Begun:
        """All plans from states (agents, n) float64, judged; at most `grid.batch` trajectories at a time."""
        parts = [self._finished(x[at : at + self._most]) for at in range(0, len(x), self._most)]
        plans, rho, safe = (torch.cat(column) for column in zip(*parts, strict=True))
        return Begun(plans, rho, safe, self.lengths.to(x.device))

    def _finished(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        count, longest, controls = self.heads.shape
        lengths = self.lengths.to(x.device).repeat(len(x))
        heads = self.heads.to(x).repeat(len(x), 1, 1)
        starts = x.repeat_interleave(count, 0)
        rows = torch.arange(len(starts), device=x.device)
        reached = self.task.rollout(starts, heads)[rows, lengths]
        tails = finite(self.policy.plan(reached).to(x.dtype), self.task)
        when = torch.arange(self.task.horizon, device=x.device)
        after = (when - lengths[:, None]).clamp(min=0)[..., None].expand(-1, -1, controls)
        plans = tails.gather(1, after)
        head = (when[:longest] < lengths[:, None])[..., None]
        plans[:, :longest] = torch.where(head, heads, plans[:, :longest])
        judged = self.task.judge(starts, plans, states=False)
        shape = (len(x), count)
        return plans.view(*shape, *plans.shape[1:]), judged.rho.view(shape), judged.safe.view(shape)
