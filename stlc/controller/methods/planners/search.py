"""`search`: local search on exact robustness with restarts, and searches that look at the requirements.

Local search runs in C if a compiler is installed. Where it finds no plan, two other searches take turns with
it: for sequences of phases, if the mission needs several steps (`stlc.controller.search.sequences`), and by
schedules of the goals, towards which Gauss-Newton steps lead (the planner `schedule`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.methods.planners.schedule import SchedulePlanner, Schedules
from stlc.controller.options import bounded
from stlc.controller.search.local_search import Searcher
from stlc.controller.search.sequences.sequences import Sequences
from stlc.controller.search.starts import extremes
from stlc.diagnostics import TraceError, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch, Solver


SEVERAL = 2
"""Least number of jumps, waits and goals of a mission for which their order is searched."""
SHARE = 2.0
"""Processor time of the searches that look at the requirements, as a multiple of that of the local search. It
grows up to this with the time of the local search."""
EQUAL = 0.05
"""Processor time of the local search at which the others have had as much, in seconds."""
LEAD = 0.02
"""Processor time of the search for phases before schedules are searched for as long, in seconds."""
RESTARTS = 4
"""Number of searches for sequences of phases from one state. Each ends when no prefix is left to extend; the
next makes twice the effort for each phase."""


@dataclass(frozen=True, slots=True)
class SearchPlanner:
    """Local search: in every generation the best of a batch of changed plans is kept.

    A change adds noise in an interval of time, shifts an interval, holds one value in an interval, or inserts
    a part of a plan that solved another initial state. The first round starts from the initial guess. Later
    rounds start alternately from a plan of a library and from the best plan found. The library contains
    piecewise constant plans; plans that solve an initial state are added.

    Attributes:
        rounds: number of rounds of local search before the searches by the order of the goals begin.
        tries: number of plans tried per initial state in the first round; each later round tries twice as
            many, up to `longest`.
        longest: maximum number of plans tried per initial state and round.
        library: maximum number of plans in the library, which all initial states share.
    """

    tries: int = bounded(2_000, 1, 10**9)
    longest: int = bounded(20_000, 1, 10**9)
    library: int = bounded(2_048, 1, 10**6)
    rounds: int = bounded(3, 1, 10**6)

    def prepare(self, task: Task) -> Solver:
        """Return a function that searches for plans by local search, with the initial library."""
        library = extremes(task, torch.Generator().manual_seed(0)).double()
        return partial(self._run, library=library, orders=_Orders(task))

    def _run(self, search: PlanSearch, library: Tensor, orders: _Orders) -> None:
        begun: dict[int, Iterator[None]] = {}
        spent = [0.0] * len(search.states)
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
            if number >= self.rounds:
                for row in search.open().tolist():
                    if row not in begun:
                        begun[row] = orders.tries(search, torch.tensor([row]))
                    local = float(search.seconds[row]) - spent[row]
                    for _ in begun[row]:
                        if float(search.seconds[row]) >= (1.0 + min(SHARE, local / EQUAL)) * local:
                            break
                    spent[row] = float(search.seconds[row]) - local


class _Orders:
    """Searches that look at the requirements of one task; they are built when they are first needed."""

    def __init__(self, task: Task) -> None:
        self._task = task

    @cached_property
    def _sequences(self) -> Sequences:
        return Sequences(self._task, self._task.sample(1, seed=0)[0].double())

    @cached_property
    def _schedules(self) -> Schedules | None:
        try:
            return Schedules(SchedulePlanner(first=1), self._task)
        except UsageError:
            return None

    def tries(self, search: PlanSearch, row: Tensor) -> Iterator[None]:
        """Search for a plan from the initial state `row`, (1,), by phases and by schedules.

        An item is yielded after each phase that is tried, and each step towards schedules.
        """
        searches: list[Iterator[None]] = []
        try:
            root = self._sequences.root(search.states[row][0])
        except TraceError:  # bounds on the robustness of a prefix need too many instants
            moves = True
        else:
            if root is not None and root.missing >= SEVERAL:
                searches.append(self._by_phases(search, row))
            moves = root is None or not root.steps
        if moves and self._schedules is not None:  # a schedule moves states, not modes
            searches.append(self._schedules.of(search, row))
        spent = {each: LEAD * i for i, each in enumerate(searches)}
        while spent:
            least = min(spent, key=spent.__getitem__)
            before = float(search.seconds[row])
            if next(least, search) is search:
                del spent[least]
            else:
                spent[least] += float(search.seconds[row]) - before
            yield

    def _by_phases(self, search: PlanSearch, row: Tensor) -> Iterator[None]:
        sequences, state = self._sequences, search.states[row][0]
        random = np.random.default_rng(int(torch.randint(2**62, (), generator=search.generator)))
        for effort in (2**i for i in range(RESTARTS)):
            plans = sequences.plans(state, random, effort)
            while bool((search.open() == row).any()):
                before = sequences.tried
                with search.charged(row):
                    found = next(plans, search)
                    if isinstance(found, Tensor):
                        search.offer(row, found[None], evaluations=0)
                    search.evaluations[row] += sequences.tried - before
                if found is search:
                    break
                yield


PLANNER = SearchPlanner
