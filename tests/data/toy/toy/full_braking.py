"""Full braking."""

import torch

from stlc.controller.guard.candidates import REPAIRED, Candidates
from stlc.controller.guard.stages import GuardStage


class Braking(GuardStage):
    """The least control throughout."""

    def __init__(self, setup):
        self.task = setup.task

    def wanted(self, best):
        """Every agent."""
        return torch.ones_like(best.is_safe)

    def propose(self, rejected, rows, deadline):
        """Return the plans of the agents `rows`."""
        low = self.task.system.control_low.to(rejected.x)
        plans = low.expand(len(rows), self.task.horizon, -1)
        return Candidates.judged(self.task, rejected.x[rows], plans, REPAIRED)


STAGE = Braking
