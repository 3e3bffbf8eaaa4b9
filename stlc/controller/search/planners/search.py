"""`search`: local search on exact robustness with restarts, and searches that look at the requirements.

Local search runs in C if a compiler is installed. Where it finds no plan, two other searches take turns with
it: for sequences of phases, if the mission needs several steps (`stlc.controller.search.sequences`), and by
schedules of the goals, towards which Gauss-Newton steps lead (`stlc.controller.search.attempts`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.options import bounded
from stlc.controller.search.attempts import Attempts
from stlc.controller.search.local_search import Searcher
from stlc.controller.search.sequences.sequences import LENGTHS, Sequences
from stlc.controller.search.starts import extremes

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch, Solver


SHARE, EQUAL = 2.0, 0.05
"""Greatest cost of the searches that look at the requirements, in that of the local search, and the cost of
the local search at which both are equal; see `PlanSearch.spent`."""
ORDERS = 4.0
"""This cost where the order of jumps matters: in plans longer than a phase."""
LEAD, LONG = 0.02, 0.1
"""Cost of these searches before local search begins, where a plan is to be mended; and where the order of
jumps matters or no round of local search comes first. Schedules begin that much before phases."""
COSTLY = 4_000
"""Number of plans, a limit of judged plans given, that must be left for a search for phases."""
RESTARTS = 16
"""Number of searches for sequences of phases from one state. Each ends when no prefix is left to extend."""
EFFORTS = 1, 1, 1, 2, 4, 8
"""Efforts for each phase in these searches, one after another; the last of them for the rest."""


@dataclass(frozen=True, slots=True)
class SearchPlanner:
    """Local search: in every generation the best of a batch of changed plans is kept.

    A change adds noise in an interval of time, shifts an interval, holds one value in an interval, or inserts
    a part of a plan that solved another initial state. The first round starts from the initial guess. Later
    rounds start alternately from a plan of a library and from the best plan found. The library contains
    piecewise constant plans; plans that solve an initial state are added.

    Attributes:
        version: raised with every change of the plans that are found within a budget.
        tries: number of plans tried per initial state in the first round; each later round tries twice as
            many, up to `longest`.
        longest: maximum number of plans tried per initial state and round.
        library: maximum number of plans in the library, which all initial states share.
        rounds: number of rounds after which the searches that look at the requirements begin; where the order
            of jumps matters, they begin after the first round.
    """

    version: ClassVar = 5
    tries: int = bounded(2_000, 1, 10**9)
    longest: int = bounded(20_000, 1, 10**9)
    library: int = bounded(2_048, 1, 10**6)
    rounds: int = bounded(3, 0, 10**9)

    def prepare(self, task: Task) -> Solver:
        """Return a function that searches for plans by local search, with the initial library."""
        library = extremes(task, torch.Generator().manual_seed(0)).double()
        return partial(self._run, library=library, orders=_Orders(task, self.rounds))

    def _run(self, search: PlanSearch, library: Tensor, orders: _Orders) -> None:
        orders.begin(search)
        budget, tries, number = search.budget, self.tries, 0
        target = budget.target if budget.target else TOLERANCE
        searcher = Searcher(search.task, search.generator, target=target)
        while len(search.open()):
            orders.advance(number)
            if not len(rows := search.open()):
                break
            with search.charged(rows):
                start = search.plans[rows] if number else search.start[rows]
                if number % 2:
                    start = library[torch.randint(len(library), (len(rows),), generator=search.generator)]
                count = search.affordable(rows, tries)
                found = searcher.repair(
                    search.states[rows], start, library, tries=count, stop=budget.stop
                ).plans
                search.offer(rows, found, evaluations=count)
                solved = search.plans[rows][TOLERANCE.satisfied(search.rho[rows])]
                library = torch.cat((solved, library))[: self.library]
            number, tries = number + 1, min(2 * tries, self.longest)
        orders.settle()


class _Orders:
    """Searches that look at the requirements of one task; they are built when they are first needed."""

    def __init__(self, task: Task, rounds: int) -> None:
        self._task, self._jumps = task, bool(task.system.decl.jumps)
        self._ordered = self._jumps and task.horizon > LENGTHS[1]
        self._rounds = min(rounds, 1) if self._ordered else rounds

    @cached_property
    def _sequences(self) -> Sequences:
        return Sequences(self._task, self._task.sample(1, seed=0)[0].double())

    @cached_property
    def _attempts(self) -> Attempts:
        return Attempts(self._task)

    def begin(self, search: PlanSearch) -> None:
        """Begin the searches for the states of `search`."""
        self._search = search
        self._running: dict[int, Generator[None]] = {}
        self._nearest: dict[int, Tensor] = {}
        self._own = torch.zeros(len(search.states), dtype=torch.float64)
        self._first = 0 if bool(search.evaluations.any()) else self._rounds  # 0: a plan is to be mended

    def advance(self, number: int) -> None:
        """Continue the searches from each open state for their share of what local search has cost there.

        `number`: number of rounds of local search.
        """
        search = self._search
        for row in search.open().tolist() if number >= self._first else ():
            if search.allowed(torch.tensor([row]), COSTLY) < COSTLY:
                continue
            local = float(search.spent[row] - self._own[row])
            share = ORDERS if self._ordered else min(SHARE, local / EQUAL)
            alone = not self._rounds and not self._jumps
            lead = LONG if self._ordered or alone else LEAD if self._first == 0 else 0.0
            allowed = local + max(lead, share * local)
            going, before = self._running.get(row), search.spent.clone()
            if going is None:
                going = self._running[row] = self._tries(torch.tensor([row]))
            while search.spent[row] < allowed and row in search.open() and next(going, True) is None:
                pass
            self._own += search.spent - before

    def settle(self) -> None:
        """End the searches: where no plan satisfies, one that begins with a sequence of phases is followed.

        So the next search, from a state on the way, begins where this one has ended.
        """
        search = self._search
        for running in self._running.values():
            running.close()
        for row, plan in self._nearest.items():
            if search.continued and not search.result.satisfied[row]:
                search.worth[row] = search.rho[row] = -torch.inf
                search.offer(torch.tensor([row]), plan[None], evaluations=0)

    def _tries(self, row: Tensor) -> Generator[None]:
        """Search for a plan from the initial state `row`, (1,), by phases and by schedules.

        An item is yielded after each phase that is tried, and each step towards schedules.
        """
        search = self._search
        searches: list[Iterator[None]] = []
        with search.charged(row):
            root = self._sequences.root(search.states[row][0])
        several = root is not None and self._sequences.several(root)
        motions = root is None or not (root.steps or self._jumps or self._sequences.marked(root))
        if motions:  # a schedule knows no modes and no landmarks
            searches.append(self._attempts.of(search, row))
        if root is not None and several:
            searches.append(self._by_phases(row))
        spent = {each: LONG * i for i, each in enumerate(searches)}
        while spent:
            least = min(spent, key=spent.__getitem__)
            before = float(search.spent[row])
            if next(least, search) is search:
                del spent[least]
            else:
                spent[least] += float(search.spent[row]) - before
            yield

    def _by_phases(self, row: Tensor) -> Generator[None]:
        search, sequences = self._search, self._sequences
        state = search.states[row][0]
        random = np.random.default_rng(int(torch.randint(2**62, (), generator=search.generator)))
        for number in range(RESTARTS):
            plans = sequences.plans(state, random, EFFORTS[min(number, len(EFFORTS) - 1)])
            while bool((search.open() == row).any()):
                before = sequences.tried
                with search.charged(row):
                    found = next(plans, search)
                    if isinstance(found, Tensor):
                        search.offer(row, found[None], evaluations=0)
                        self._nearest[int(row)] = found
                    search.evaluations[row] += sequences.tried - before
                if found is search:
                    break
                yield


PLANNER = SearchPlanner
