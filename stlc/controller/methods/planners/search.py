"""`search`: local search on exact robustness with restarts; it runs in C if a compiler is installed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.guard.feasibility import extremes
from stlc.controller.options import bounded
from stlc.controller.training.local_search import Searcher

if TYPE_CHECKING:
    from stlc.controller.planning.planner import PlanSearch, Solver
    from stlc.controller.problem.task import Task


@dataclass(frozen=True, slots=True)
class SearchPlanner:
    """Local search: in every generation the best of a batch of changed plans is kept.

    A change adds noise in an interval of time, shifts an interval, holds one value in an interval, or inserts
    a part of a plan that solved another initial state. The first round starts from the initial guess. Later
    rounds start alternately from a plan of a library and from the best plan found. The library contains
    piecewise constant plans; plans that solve an initial state are added.

    Attributes:
        tries: number of plans tried per initial state in the first round; each later round tries twice as
            many, up to `longest`.
        longest: maximum number of plans tried per initial state and round.
        library: maximum number of plans in the library, which all initial states share.
    """

    tries: int = bounded(2_000, 1, 10**9)
    longest: int = bounded(20_000, 1, 10**9)
    library: int = bounded(2_048, 1, 10**6)

    def prepare(self, task: Task) -> Solver:
        """Return a function that searches for plans by local search, with the initial library."""
        return partial(self._run, library=extremes(task, torch.Generator().manual_seed(0)).double())

    def _run(self, search: PlanSearch, library: torch.Tensor) -> None:
        budget, tries, number = search.budget, self.tries, 0
        target = budget.target if budget.target else TOLERANCE
        searcher = Searcher(search.task, search.generator, enough=target)
        while len(rows := search.open()):
            with search.charged(rows):
                start = search.start[rows]
                if number % 2:
                    start = library[torch.randint(len(library), (len(rows),), generator=search.generator)]
                elif number:
                    start = search.plans[rows]
                count = search.affordable(rows, tries)
                found = searcher.repair(
                    search.states[rows], start, library, tries=count, stop=budget.stop
                ).plans
                search.offer(rows, found, evaluations=count)
                solved = search.plans[rows][search.rho[rows] >= -TOLERANCE]
                library = torch.cat((solved, library))[: self.library]
            number, tries = number + 1, min(2 * tries, self.longest)


PLANNER = SearchPlanner
