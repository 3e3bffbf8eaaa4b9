"""`schedule`: random schedules of the goals, and descents of plans towards them.

A local search fails where goals are reached in the wrong order, and it can neither stop precisely nor steer
an unstable plant. Here each attempt first draws a schedule: for every part of the specification, the time at
which it shall hold and the alternative of an `or` that shall hold. Then Gauss-Newton steps change a plan
until its states meet these conditions. A local search improves the exact robustness of the best plans.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.options import bounded
from stlc.controller.search.descent import Descent
from stlc.controller.search.local_search import Searcher
from stlc.controller.search.newton import GaussNewton, spread_of, values_of
from stlc.controller.search.schedules import GoalScheduler, tempo
from stlc.controller.search.sequences.obligations import Obligations
from stlc.diagnostics import Diagnostic, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch, Solver

PIECES = 12
"""Maximum number of constant pieces of a random plan."""
LEAST = 1e-9
"""Small number that is added to every speed, so that its logarithm is finite."""
SEEN = 0.1
"""Share of the library of random plans among which each schedule chooses, so that attempts differ."""
MODERATE = 0.6
"""Share of the control ranges in which random plans lie."""
KEPT = 16
"""One in so many of the drawn schedules is used."""
FEWEST = 8
"""Least number of attempts that are made at the same time."""
EVERY = 6
"""Number of steps after which the local search improves the best plans of the attempts."""
ORDERED = 2
"""Of the attempts after the first ones, one in so many meets its conditions in the order of time."""
AFRESH = 0.3
"""Share of the attempts that begin with the initial guess of the search."""


@dataclass(frozen=True, slots=True)
class SchedulePlanner:
    """Planner that draws random schedules of the goals and changes plans by Gauss-Newton steps to meet them.

    A schedule fixes, for every part of the specification, the time at which the part is to hold, and the
    alternative of an `or` that is to hold. An attempt changes one plan until it meets one schedule.

    Attributes:
        samples: number of samples of all attempts that are made at the same time.
        draws: number of schedules that are drawn at a time. Those that demand a low speed between goals are
            preferred.
        greed: strength of this preference; 0: the schedules are selected at random.
        library: number of random plans. An attempt begins with one of them that nearly meets its schedule.
        best: number of plans of the attempts that a local search improves from time to time.
        tries: number of changed plans that this local search tries per plan.
        starts: number of plans, the best of the library, that a local search improves before the attempts.
        first: number of changed plans that the local search before the attempts tries per plan.
    """

    samples: int = bounded(1_500, 1, 10**6)
    draws: int = bounded(1_024, 1, 10**6)
    library: int = bounded(512, 1, 10**6)
    greed: float = 10.0
    best: int = bounded(8, 1, 10**6)
    tries: int = bounded(500, 1, 10**9)
    starts: int = bounded(16, 1, 10**6)
    first: int = bounded(1_000, 1, 10**9)

    def prepare(self, task: Task) -> Solver:
        """Return a function that draws random schedules and searches for plans that meet them.

        Raises:
            UsageError: U101, no part of the specification is a condition on the states of a single sample,
                as `x > 1` is. Then there is nothing to schedule.
        """
        return partial(self._run, schedules=Schedules(self, task))

    def _run(self, search: PlanSearch, schedules: Schedules) -> None:
        while len(rows := search.open()):
            for _ in schedules.of(search, rows[:1]):
                pass
            search.ended[rows[:1]] = True


class Schedules:
    """The search by schedules, for plans of one task.

    Args:
        options: the planner.
        task: specification and system.

    Raises:
        UsageError: U101, there is nothing to schedule.
    """

    def __init__(self, options: SchedulePlanner, task: Task) -> None:
        self._options, self._obligations = options, Obligations(task)
        self._scheduler = lru_cache(maxsize=64)(
            partial(GoalScheduler, states=task.system.names, steps=task.horizon)
        )
        conditions = self._scheduler(self._obligations.first).conditions
        if not conditions:
            message = "planner `schedule` needs a condition on states, at one sample, in the specification"
            raise UsageError(Diagnostic("U101", message, help=("search plans for any task",)))
        blank = torch.zeros(1, task.horizon + 1, len(task.system.names), dtype=torch.float64)
        for states in (blank, blank[:, :1]):  # so that the programs of the conditions are built
            values_of(task, conditions, states)

    def of(self, search: PlanSearch, row: Tensor) -> Iterator[None]:
        """Search for a plan from the initial state `row`, (1,), until the search for it ends.

        An item is yielded after each step of the attempts; none if all conditions are decided, so that none
        is left to meet.
        """
        options = self._options
        random = np.random.default_rng(int(torch.randint(2**62, (), generator=search.generator)))
        searcher = Searcher(search.task, search.generator, enough=search.budget.target or TOLERANCE)
        with search.charged(row):
            others = _random_plans(search, search.affordable(row, options.library + 1) - 1)
            library = torch.cat((search.start[row], others))
            rho = search.offer(row, library[None])[0]
            if options.first and bool((search.open() == row).any()):
                best = rho.argsort(descending=True)[: options.starts]
                _polish(search, row, library[best], searcher, options.first)
        if not bool((search.open() == row).any()):
            return
        with search.charged(row):
            scheduler = self._scheduler(self._obligations.at(search.states[row][0]))
            if not scheduler.conditions:
                return
            attempts = _Attempts(options, search, row, library, scheduler, random)
        while bool((search.open() == row).any()):
            with search.charged(row):
                attempts.step(searcher)
            yield


class _Attempts:
    """Attempts to find plans from one initial state.

    Each attempt draws a random schedule and changes a plan until the plan meets the schedule. The first one
    begins with the best plan that was found.

    Args:
        options: the planner.
        search: the search for plans.
        row: index of the initial state, (1,).
        library: plans with which attempts begin, (k, T, m).
        scheduler: scheduler with the conditions of the specification.
        random: source of the random schedules.
    """

    def __init__(
        self,
        options: SchedulePlanner,
        search: PlanSearch,
        row: Tensor,
        library: Tensor,
        scheduler: GoalScheduler,
        random: Generator,
    ) -> None:
        self._options, self._search, self._row, self._library = options, search, row, library
        self._scheduler, self._random = scheduler, random
        conditions, self._x0 = self._scheduler.conditions, search.states[row]
        states = search.task.rollout(self._x0.expand(len(library), -1), library).nan_to_num(0.0, 0.0, 0.0)
        newton = GaussNewton(search.task, conditions, spread_of(search.task, states))
        missed = values_of(search.task, conditions, states).neg().clamp(min=0.0).sqrt()
        self._missed = missed.flatten(0, 1)  # by each plan of the library: (conditions * (T + 1), k)
        places = newton.nearest(self._x0[0])
        self._holds = ~places.violated.numpy()
        self._goals = places.violated.nonzero()[:, 0].numpy()
        visited = torch.cat((self._x0, places.states[places.violated])) / newton.spread
        self._apart = torch.cdist(visited, visited).nan_to_num(0.0).numpy()
        count = max(FEWEST, options.samples // scheduler.steps)
        self._pool, self._begun = np.zeros((0, len(conditions), scheduler.steps + 1), np.bool_), 0
        self._steps = 0
        first = torch.cat((search.plans[row], search.start[row].expand(count - 1, -1, -1)))
        self._descent = Descent(scheduler, newton, self._x0[0], first, places.margins)
        self._renew(np.arange(1, count))

    def step(self, searcher: Searcher) -> None:
        """Make one step of each attempt; those that gain no more give way to others."""
        search, row, descent = self._search, self._row, self._descent
        descent.step()
        self._steps += 1
        rho = search.offer(row, descent.plans[None])[0]
        if self._steps % EVERY == 0 and bool((search.open() == row).any()):
            best = descent.plans[rho.argsort(descending=True)[: self._options.best]]
            _polish(search, row, torch.cat((search.plans[row], best)), searcher, self._options.tries)
        self._renew(descent.over.nonzero()[0])

    def _renew(self, index: NDArray[np.int64]) -> None:
        """Begin the attempts `index` anew."""
        needed, search = self._drawn(len(index)), self._search
        index = index[: len(needed)]
        if not len(index):
            return
        plans = self._nearest(needed)
        afresh = torch.rand(len(plans), generator=search.generator) < AFRESH
        plans[afresh] = search.start[self._row]
        number = self._begun + np.arange(len(index))
        ordered = (number % ORDERED == 1) & (number > len(self._descent.over))
        self._begun += len(index)
        self._descent.renew(index, plans, needed, ordered)

    def _drawn(self, count: int) -> NDArray[np.bool_]:
        """Draw at most `count` schedules: where conditions are needed, (count, conditions, T + 1)."""
        if len(self._pool) < count:
            options, random = self._options, self._random
            needed: NDArray[np.bool_] = self._scheduler.draw(options.draws, random, self._holds)
            speed = tempo(needed[:, self._goals], self._apart)
            order = (options.greed * np.log(speed + LEAST) - random.gumbel(size=len(speed))).argsort()
            self._pool = needed[order[: max(count, len(order) // KEPT)]]
        drawn, self._pool = self._pool[:count], self._pool[count:]
        return drawn

    def _nearest(self, needed: NDArray[np.bool_]) -> Tensor:
        """Select a plan for each of the k schedules `needed`, (k, T, m).

        It is the plan nearest to meeting the schedule, among some plans of the library drawn at random.
        """
        missed = torch.from_numpy(needed).flatten(1).double() @ self._missed
        seen = torch.rand(missed.shape, generator=self._search.generator) < SEEN
        return self._library[torch.where(seen, missed, torch.inf).argmin(1)]


def _polish(search: PlanSearch, row: Tensor, plans: Tensor, searcher: Searcher, tries: int) -> None:
    """Improve plans, (k, T, m), from the initial state `row` by local search, each with `tries` tries."""
    count = search.allowed(row, len(plans))
    plans = plans[:count]
    tries = max(1, search.affordable(row, tries * count) // count)
    bank = plans.new_zeros(0, *plans.shape[1:])
    x0 = search.states[row].expand(count, -1).contiguous()
    found = searcher.repair(x0, plans, bank, tries=tries, stop=search.budget.stop)
    search.offer(row, found.plans[None], evaluations=tries * count)


def _random_plans(search: PlanSearch, count: int) -> Tensor:
    """Draw piecewise constant plans with random numbers of pieces, (count, T, m)."""
    system, draw = search.task.system, search.generator
    low, high = system.control_low.double(), system.control_high.double()
    number = torch.randint(1, PIECES + 1, (count, 1), generator=draw)
    begins = torch.rand(count, system.horizon, generator=draw) < number / system.horizon
    piece = begins.cumsum(1)[..., None].expand(-1, -1, len(low))
    levels = torch.rand(count, system.horizon + 1, len(low), generator=draw).double()
    return 0.5 * (low + high) + MODERATE * (high - low) * (levels.gather(1, piece) - 0.5)


PLANNER = SchedulePlanner
