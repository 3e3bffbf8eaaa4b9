"""`gradient`: gradient steps on the robustness of a plan, without a policy (STL_G of Meng and Fan 2023)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.controller.options import bounded
from stlc.controller.training.objective import Objective, guided_objective, loss, paper_objective
from stlc.diagnostics import usage
from stlc.dynamics.model.controls import raw_width, squash

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch, Solver


@dataclass(frozen=True, slots=True)
class GradientPlanner:
    """Gradient steps (Adam) on latent plans.

    The entries of a latent plan are unbounded numbers; they are mapped to the control ranges like the outputs
    of a policy network.

    Attributes:
        objective: `exact` for exact robustness, with gradients by generated C code; `paper` for smooth
            robustness, where tanh also smooths the jumps and conditions of the system.
        steps: number of gradient steps, after which the search begins anew from random latent plans.
        starts: number of latent plans per initial state; the first is 0, the others are drawn at random.
        rate: learning rate of Adam.
        slope: k in the smooth step (1 + tanh(k x)) / 2. Jumps and conditions of the system are true
            steps, with derivative 0 almost everywhere. If the objective is `exact`, gradients use the
            derivative of the smooth step instead.
    """

    objective: str = "exact"
    steps: int = bounded(50, 1, 10**9)
    starts: int = bounded(8, 1, 10**6)
    rate: float = bounded(0.1, 0, 1e6)
    slope: float = bounded(2.0, 1e-9, 1e9)

    def prepare(self, task: Task) -> Solver:
        """Return a function that searches for plans by gradient steps on the objective.

        The objective `exact` leaves out the performance terms of the system file.

        Raises:
            UsageError: U101, the objective is neither `exact` nor `paper`.
        """
        if self.objective not in ("exact", "paper"):
            raise usage(f"`objective={self.objective}` of planner `gradient` is neither `exact` nor `paper`")
        if self.objective == "paper":
            return partial(self._run, objective=paper_objective(task))
        gamma = task.system.decl.objective.gamma
        return partial(self._run, objective=guided_objective(gamma, slope=self.slope, performance_weight=0.0))

    def _run(self, search: PlanSearch, objective: Objective) -> None:
        first = True
        while len(rows := search.open()):
            for part in torch.split(rows, 512):
                self._descend(search, part, objective, first=first)
            first = False

    def _descend(self, search: PlanSearch, rows: Tensor, objective: Objective, *, first: bool) -> None:
        """Make gradient steps from random latent plans for the initial states `rows`.

        If `first` is True, one latent plan of each state is 0 instead.
        """
        task, controls = search.task, search.task.system.decl.controls
        shape = (len(rows), self.starts, task.system.horizon, raw_width(controls))
        raw = torch.randn(shape, generator=search.generator)
        if first:
            raw[:, 0] = 0.0
        raw = raw.requires_grad_(True)
        x0 = search.states[rows].float().repeat_interleave(self.starts, 0)
        adam = torch.optim.Adam([raw], lr=self.rate)
        for step in range(self.steps + 1):
            going = torch.isin(rows, search.open())
            if not bool(going.any()):
                return
            with search.charged(rows[going]):
                plans = squash(raw, controls)
                search.offer(rows[going], plans.detach()[going])
                if step < self.steps:
                    value = loss(task, objective, x0, plans.flatten(0, 1)).sum()
                    adam.zero_grad(set_to_none=True)
                    value.backward()  # type: ignore[no-untyped-call]
                    adam.step()


PLANNER = GradientPlanner
