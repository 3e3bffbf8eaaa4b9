"""Plans with which searches begin."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.controller.problem.task import Task

PIECES = 3
MOST = 2048
"""Maximum size of the plan library."""
RANDOM = 12
"""Maximum number of constant pieces of a random plan."""
MODERATE = 0.6
"""Share of the control ranges in which random plans lie."""


def extremes(task: Task, generator: torch.Generator) -> Tensor:
    """Plans of 3 constant pieces, each control at the low end, middle or high end of its range: (k, T, m).

    If there are too many of these plans, `generator` draws some of them.
    """
    low, high = task.system.control_low, task.system.control_high
    levels = torch.stack((low, 0.5 * (low + high), high))
    shape = (PIECES, len(low))
    if 3 ** (PIECES * len(low)) <= MOST:
        pick = torch.tensor(list(product(range(3), repeat=PIECES * len(low)))).view(-1, *shape)
    else:
        pick = torch.randint(3, (MOST, *shape), generator=generator)
    pieces = levels.gather(0, pick.flatten(0, 1)).view(-1, *shape)
    return pieces.repeat_interleave(-(-task.horizon // PIECES), 1)[:, : task.horizon]


def random_plans(task: Task, count: int, generator: torch.Generator) -> Tensor:
    """Draw piecewise constant plans with random numbers of pieces, (count, T, m) float64."""
    low, high = task.system.control_low.double(), task.system.control_high.double()
    number = torch.randint(1, RANDOM + 1, (count, 1), generator=generator)
    begins = torch.rand(count, task.horizon, generator=generator) < number / task.horizon
    piece = begins.cumsum(1)[..., None].expand(-1, -1, len(low))
    levels = torch.rand(count, task.horizon + 1, len(low), generator=generator).double()
    return 0.5 * (low + high) + MODERATE * (high - low) * (levels.gather(1, piece) - 0.5)
