"""Planner `levels`: constant plans at equal steps between the bounds of the controls."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True, slots=True)
class Levels:
    """Constant plans.

    Attributes:
        count: number of plans.
    """

    count: int = 9

    def prepare(self, task):
        """Return the solver."""
        low, high = task.system.control_low.double(), task.system.control_high.double()

        def solve(search):
            rows = search.open()
            with search.charged(rows):
                share = torch.linspace(0, 1, self.count, dtype=torch.float64)[None, :, None, None]
                search.offer(rows, (low + (high - low) * share).expand(len(rows), -1, task.horizon, -1))
            search.ended[rows] = True

        return solve


PLANNER = Levels
