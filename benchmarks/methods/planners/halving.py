"""`halving`: successive halving of local searches.

Many searches begin at random plans; the best of them continue with more evaluations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.options import bounded
from stlc.controller.search.local_search import Searcher

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch, Solver


@dataclass(frozen=True, slots=True)
class Halving:
    """Local searches from random piecewise constant plans, by successive halving (Karnin et al. 2013).

    A local search from a plan that visits goals in the wrong order ends at a robustness just below 0, which
    no small change improves. Therefore each round begins many searches from different plans and continues
    only the best ones.

    Attributes:
        starts: number of searches that a round begins for each initial state.
        tries: number of plans that each search tries before the first selection.
        keep: number by which each selection divides the number of searches. Each remaining search then tries
            `keep` times as many plans as before.
        pieces: maximum number of constant pieces of a random plan.
    """

    starts: int = bounded(64, 1, 10**6)
    tries: int = bounded(64, 1, 10**6)
    keep: int = bounded(4, 1, 10**6)
    pieces: int = bounded(12, 1, 10**6)

    def prepare(self, task: Task) -> Solver:  # noqa: ARG002 - the same for all tasks
        """Return a function that searches for plans by successive halving."""
        return self._run

    def _run(self, search: PlanSearch) -> None:
        target = search.budget.target or TOLERANCE
        searcher = Searcher(search.task, search.generator, target=target)
        while len(rows := search.open()):
            for part in torch.split(rows, 512):
                plans = self._random(search, len(part))
                tries = self.tries
                while len(going := part[torch.isin(part, search.open())]):
                    plans = plans[torch.isin(part, going)]
                    part = going
                    with search.charged(part):
                        plans = self._rung(search, part, plans, searcher, tries)
                    if plans.shape[1] == 1:
                        break
                    plans, tries = plans[:, : -(-plans.shape[1] // self.keep)], tries * self.keep

    def _rung(
        self, search: PlanSearch, rows: Tensor, plans: Tensor, searcher: Searcher, tries: int
    ) -> Tensor:
        """Continue all searches from the initial states `rows`; each tries up to `tries` more plans.

        Args:
            search: the search for plans.
            rows: indices of the initial states, (k,).
            plans: present plan of each of the p searches per state, (k, p, T, m).
            searcher: the local search.
            tries: maximum number of plans that each search tries.

        Returns:
            The improved plans, (k, p, T, m), for each state in descending order of robustness; fewer than p
            if the limit of judged plans allows no more.
        """
        count = search.allowed(rows, plans.shape[1])
        plans = plans[:, :count]
        tries = max(1, search.affordable(rows, tries * count) // count)
        x0 = search.states[rows].repeat_interleave(count, 0)
        library = plans.new_zeros(0, *plans.shape[2:])
        found = searcher.repair(x0, plans.flatten(0, 1), library, tries=tries, stop=search.budget.stop)
        order = found.rho.view(-1, count).argsort(1, descending=True)
        sorted_ = found.plans.view_as(plans).gather(1, order[..., None, None].expand_as(plans))
        search.offer(rows, sorted_[:, 0], evaluations=tries * count)
        return sorted_

    def _random(self, search: PlanSearch, count: int) -> Tensor:
        """Draw piecewise constant plans with random numbers of pieces, (count, starts, T, m)."""
        system, draw = search.task.system, search.generator
        low, high = system.control_low.double(), system.control_high.double()
        steps, shape = system.horizon, (count, self.starts)
        number = torch.randint(1, self.pieces + 1, (*shape, 1), generator=draw)
        begins = torch.rand(*shape, steps, generator=draw) < number / steps
        piece = begins.cumsum(2)[..., None].expand(-1, -1, -1, len(low))
        levels = torch.rand(*shape, steps + 1, len(low), generator=draw).double()
        return low + (high - low) * levels.gather(2, piece)


PLANNER = Halving
