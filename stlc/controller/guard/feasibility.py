"""What can be done at all: a search for a satisfying plan, or a safe one, from each state."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import torch

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.training.local_search import THOROUGH, Searcher
from stlc.native import never

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.native import Stop

PASSES = 4
TRIES = 20_000
"""Plans that are tried for one start in one pass, where native code judges them."""
ENOUGH = 1e-4
PIECES = 3
MOST = 2048
"""Plans in the bank, at most."""


def savable(task: Task, x0: Tensor) -> Tensor:
    """Where some plan satisfies phi_safe, as far as a search finds one: (B, n) -> (B,) booleans."""
    if not task.compiled.safety:
        return torch.ones(len(x0), dtype=torch.bool)
    return solvable(safely(task), x0)


def solvable(task: Task, x0: Tensor) -> Tensor:
    """Where some plan satisfies phi, as far as a search finds one: (B, n) -> (B,) booleans."""
    return Hunt(task).plans(x0)[1]


class Hunt:
    """A search for plans of one task that knows of no policy; the same one gives the same plans again.

    Each pass climbs from another plan: from the middle of every control, then from plans that hold each
    control at an end of its range or in the middle of it, thirds of the horizon long. A start without a
    plan may have one that was not found; one with a plan has it, judged exactly.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.middle = 0.5 * (task.system.control_low + task.system.control_high)
        self.bank = extremes(task, torch.Generator().manual_seed(0))

    @torch.no_grad()
    def plans(self, x0: Tensor, enough: Stop = never) -> tuple[Tensor, Tensor]:
        """Plans (B, T, m) float64 from states (B, n), and which of them satisfy the specification, (B,).

        It ends once `enough` says so.
        """
        generator = torch.Generator().manual_seed(0)
        searcher = Searcher(self.task, generator, enough=ENOUGH)
        tries = THOROUGH if self.task.native is None else TRIES
        start = self.middle.expand(len(x0), self.task.horizon, -1)
        best, found = start.double().clone(), torch.zeros(len(x0), dtype=torch.bool)
        for _ in range(PASSES):
            still = torch.nonzero(~found).squeeze(1)
            if not len(still) or enough():
                break
            begun = x0[still].float(), start[still].clone()
            plans = searcher.repair(*begun, self.bank, tries=tries, stop=enough).plans
            best[still] = plans.double()
            found[still] = self.task.judge(x0[still].double(), best[still], states=False).rho >= -TOLERANCE
            start = self.bank[torch.randint(len(self.bank), (len(x0),), generator=generator)]
        return best, found


def safely(task: Task) -> Task:
    """The task of phi_safe alone."""
    return Task(replace(task.compiled, requirements=task.compiled.safety), task.plain)


def extremes(task: Task, generator: torch.Generator) -> Tensor:
    """Plans that hold each control at a low, middle or high value, piece by piece: (k, T, m)."""
    low, high = task.system.control_low, task.system.control_high
    levels = torch.stack((low, 0.5 * (low + high), high))
    shape = (PIECES, len(low))
    if 3 ** (PIECES * len(low)) <= MOST:
        pick = torch.tensor(list(product(range(3), repeat=PIECES * len(low)))).view(-1, *shape)
    else:
        pick = torch.randint(3, (MOST, *shape), generator=generator)
    pieces = levels.gather(0, pick.flatten(0, 1)).view(-1, *shape)
    return pieces.repeat_interleave(-(-task.horizon // PIECES), 1)[:, : task.horizon]
