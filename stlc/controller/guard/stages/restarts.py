"""Random restarts: a search for a safe plan that does not use the policy."""

from __future__ import annotations

from torch import Tensor

from stlc.controller.guard.candidates import REPAIRED, Candidates, Deadline
from stlc.controller.guard.stages import GuardStage, Rejected, Setup
from stlc.controller.search.feasibility import solve


class Restarts(GuardStage):
    """Guard stage: search for a safe plan by `feasibility.solve` until the deadline."""

    def __init__(self, setup: Setup) -> None:
        self.task, self.rescue = setup.task, setup.limits.rescue
        self._safety = setup.task.safety_task if setup.task.compiled.safety else setup.task

    def wanted(self, best: Candidates) -> Tensor:
        """Mask of the agents without a safe plan; all False if `Limits.rescue` is False."""
        return ~best.is_safe & self.rescue

    def propose(self, rejected: Rejected, rows: Tensor, deadline: Deadline) -> Candidates:
        """The best plan that the search has found for each agent, safe or not."""
        x = rejected.x[rows]
        plans = solve(self._safety, x, stop=lambda: deadline.over).plans
        return Candidates.judged(self.task, x, plans.to(x.device), REPAIRED)


STAGE = Restarts
