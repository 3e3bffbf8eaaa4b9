"""What a controller computes, as a module that can be recorded for any number of agents."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from stlc.compile.backends.torch.ops import TORCH
from stlc.controller.problem.task import PlanVerdicts, Task, rank

if TYPE_CHECKING:
    from torch.export import ExportedProgram

    from stlc.controller.policies.policy import PlanNetwork


class Deciding(nn.Module):
    """States (B, n) -> the plan to follow (B, T, m), rho and safe (B,), requirements (B, R); all float64."""

    def __init__(self, task: Task, network: PlanNetwork) -> None:
        super().__init__()
        self.network = network
        self._task = task

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The policy's plan and its verdict, as `BestOfKPolicy.plan_judged` gives them."""
        plans = self.network(x).to(x.dtype)
        _, count, steps, controls = plans.shape
        starts = x[:, None].expand(-1, count, -1).reshape(-1, x.shape[1])
        flat = plans.reshape(-1, steps, controls)
        judged = judged_openly(self._task, starts, flat)
        score = rank(judged.rho, self._task.cost(judged), judged.safe).view(-1, count)
        best = score.argmax(1, keepdim=True)
        plan = plans.gather(1, best[:, :, None, None].expand(-1, 1, steps, controls))[:, 0]
        each = judged.requirements.view(-1, count, judged.requirements.shape[1])
        return (
            plan,
            judged.rho.view(-1, count).gather(1, best)[:, 0],
            judged.safe.view(-1, count).gather(1, best)[:, 0],
            each.gather(1, best[:, :, None].expand(-1, 1, each.shape[2]))[:, 0],
        )


def judged_openly(task: Task, x: Tensor, plans: Tensor) -> PlanVerdicts:
    """`Task.judge` in torch's operations alone, which can be recorded."""
    columns = task.system.rollout_columns(x, plans)
    each = task.graph.per_requirement_columns(columns, ops=TORCH)
    names = [rule.name for rule in task.rules]
    rho = task.graph.overall(each)
    safe = task.safety.overall(each[:, [names.index(rule.name) for rule in task.compiled.safety]])
    broken = ~torch.isfinite(plans).all(2).all(1) | torch.isnan(rho)
    rho, safe = rho.masked_fill(broken, -torch.inf), safe.masked_fill(broken, -torch.inf)
    return PlanVerdicts(rho, safe, each.masked_fill(broken[:, None], -torch.inf), plans, columns)


@contextmanager
def unmoved() -> Iterator[None]:
    """Within it, what torch's own export says of torch's own future is not repeated."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


def recorded(task: Task, network: PlanNetwork) -> ExportedProgram:
    """The controller as a program for any number of agents; states are float64."""
    module = Deciding(task, network).eval()
    x = task.sample(3, seed=0, dtype=torch.float64)
    with torch.no_grad(), unmoved():
        module(x)  # constants that are remembered are made here, not while recording
        batch = torch.export.Dim("batch", min=1)
        return torch.export.export(module, (x,), strict=False, dynamic_shapes=({0: batch},))
