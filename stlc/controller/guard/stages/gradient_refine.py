"""Gradient refinement: gradient ascent from the policy's and the previous plan."""

from __future__ import annotations

from time import perf_counter

import torch
from torch import Tensor

from stlc.controller.guard.candidates import REPAIRED, Candidates, Deadline
from stlc.controller.guard.stages import GuardStage, Rejected, Setup, Tried
from stlc.controller.search.ascent import SEED, GradientAscent


class GradientRefine(GuardStage):
    """Guard stage: gradient ascent from the policy's and the previous plan, in half of the time left."""

    def __init__(self, setup: Setup) -> None:
        self.task = setup.task
        self.ascent = GradientAscent(setup.task, torch.Generator().manual_seed(SEED), target=setup.target)

    def wanted(self, best: Candidates) -> Tensor:
        """Mask of all agents: the stage always searches."""
        return torch.ones_like(best.is_safe)

    def propose(self, rejected: Rejected, rows: Tensor, deadline: Deadline) -> Candidates:
        """Return the best refined plan of each agent; store the two best ones for the next stage."""
        plans = [rejected.plan] if rejected.previous is None else [rejected.plan, rejected.previous]
        x, starts = rejected.x[rows], torch.stack(plans, 1)[rows]
        refined = self.ascent.refine(x, starts, 0.5 * (perf_counter() + deadline.until))
        found = Candidates.judged(self.task, x, refined, REPAIRED)
        rejected.tried.append(Tried(rows, found))
        return found.pick(torch.zeros_like(rows))


STAGE = GradientRefine
