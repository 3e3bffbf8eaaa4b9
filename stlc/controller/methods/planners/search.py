"""`search`: local search on the exact robustness, with restarts, in C where there is a compiler."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.guard.feasibility import extremes
from stlc.controller.training.local_search import Searcher

if TYPE_CHECKING:
    from stlc.controller.planning.planner import PlanSearch, Solver
    from stlc.controller.problem.task import Task


@dataclass(frozen=True, slots=True)
class Search:
    """Local search: the best of a batch of changed plans is kept, generation by generation.

    Changes are noise over a stretch of time, a shift of a stretch, a stretch held at one level, and parts of
    plans that solved other starts. Each round restarts from such plans, alternating with the best so far.

    Attributes:
        tries: plans of a start in the first round; each later round has twice as many, up to `longest`.
        longest: plans of a start in a round at most.
        library: plans of solved starts that are kept for the other starts.
    """

    tries: int = 2_000
    longest: int = 20_000
    library: int = 2_048

    def prepare(self, task: Task) -> Solver:
        """The library of piecewise constant plans, common to all starts."""
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


PLANNER = Search
