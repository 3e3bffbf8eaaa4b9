"""Attempts to meet random schedules of the goals: descents of plans towards them.

A local search fails where goals are reached in the wrong order, and it can neither stop precisely nor steer
an unstable plant. Here each attempt first draws a schedule: for every part of the specification, the time at
which it shall hold and the alternative of an `or` that shall hold. Then Gauss-Newton steps change a plan
until its states meet these conditions. A local search improves the exact robustness of the best plans.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.search.descent import Descent
from stlc.controller.search.local_search import Searcher
from stlc.controller.search.newton import GaussNewton, spread_of, values_of
from stlc.controller.search.schedules import GoalScheduler, tempo
from stlc.controller.search.sequences.obligations import Obligations
from stlc.controller.search.starts import random_plans

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch

LIBRARY = 512
"""Number of random plans. An attempt begins with one of them that nearly meets its schedule."""
SAMPLES, FEWEST = 1_500, 8
"""Number of samples of all attempts that are made at the same time, and least number of these attempts."""
DRAWS, KEPT = 1_024, 16
"""Number of schedules that are drawn at a time; one in so many of them is used."""
GREED = 10.0
"""Strength of the preference for schedules that demand a low speed between goals."""
LEAST = 1e-9
"""Small number that is added to every speed, so that its logarithm is finite."""
SEEN = 0.1
"""Share of the library of random plans among which each schedule chooses, so that attempts differ."""
BEGINNINGS, FIRST = 16, 1_000
"""Number of random plans that a local search improves before the first attempt, the best of them, and number
of the changed plans that it tries for each."""
EVERY, BEST, TRIES = 6, 8, 500
"""Number of steps after which it improves plans of the attempts, and the same numbers for these."""
ORDERED = 2
"""Of the attempts after the first ones, one in so many meets its conditions in the order of time."""
AFRESH = 0.3
"""Share of the attempts that begin with the initial guess of the search."""


class Attempts:
    """The search by schedules, for plans of one task.

    A schedule fixes, for every part of the specification, the time at which the part is to hold, and the
    alternative of an `or` that is to hold. An attempt changes one plan until it meets one schedule.
    """

    def __init__(self, task: Task) -> None:
        self._obligations = Obligations(task)
        self._scheduler = lru_cache(maxsize=64)(
            partial(GoalScheduler, states=task.system.names, steps=task.horizon)
        )
        blank = torch.zeros(1, task.horizon + 1, len(task.system.names), dtype=torch.float64)
        conditions = self._scheduler(self._obligations.first).conditions
        for states in (blank, blank[:, :1]) if conditions else ():  # so that their programs are built
            values_of(task, conditions, states)

    def of(self, search: PlanSearch, row: Tensor) -> Iterator[None]:
        """Search for a plan from the initial state `row`, (1,), until the search for it ends.

        An item is yielded after each step of the attempts; none if no condition is left to meet.
        """
        with search.charged(row):
            scheduler = self._scheduler(self._obligations.at(search.states[row][0]))
            if not scheduler.conditions:
                return
            count = search.affordable(row, LIBRARY + 1) - 1
            library = torch.cat((search.start[row], random_plans(search.task, count, search.generator)))
            rho = search.offer(row, library[None])[0]
            if bool((search.open() == row).any()):
                best = library[rho.argsort(descending=True)[:BEGINNINGS]]
                _improve(search, row, best, FIRST)
        if not bool((search.open() == row).any()):
            return
        with search.charged(row):
            attempts = _Attempts(search, row, library, scheduler)
        while bool((search.open() == row).any()):
            with search.charged(row):
                attempts.step()
            yield


class _Attempts:
    """Attempts to find plans from one initial state.

    Each attempt draws a random schedule and changes a plan until the plan meets the schedule. The first one
    begins with the best plan that was found.

    Args:
        search: the search for plans.
        row: index of the initial state, (1,).
        library: plans with which attempts begin, (k, T, m).
        scheduler: scheduler with the conditions of the specification.
    """

    def __init__(self, search: PlanSearch, row: Tensor, library: Tensor, scheduler: GoalScheduler) -> None:
        self._search, self._row, self._library, self._scheduler = search, row, library, scheduler
        self._random = np.random.default_rng(int(torch.randint(2**62, (), generator=search.generator)))
        conditions, x0 = scheduler.conditions, search.states[row]
        states = search.task.rollout(x0.expand(len(library), -1), library).nan_to_num(0.0, 0.0, 0.0)
        newton = GaussNewton(search.task, conditions, spread_of(search.task, states))
        missed = values_of(search.task, conditions, states).neg().clamp(min=0.0).sqrt()
        self._missed = missed.flatten(0, 1)  # by each plan of the library: (conditions * (T + 1), k)
        places = newton.nearest(x0[0])
        self._holds = ~places.violated.numpy()
        self._goals = places.violated.nonzero()[:, 0].numpy()
        visited = torch.cat((x0, places.states[places.violated])) / newton.spread
        self._apart = torch.cdist(visited, visited).nan_to_num(0.0).numpy()
        count = max(FEWEST, SAMPLES // scheduler.steps)
        self._pool, self._begun = np.zeros((0, len(conditions), scheduler.steps + 1), np.bool_), 0
        self._steps = 0
        first = torch.cat((search.plans[row], search.start[row].expand(count - 1, -1, -1)))
        self._descent = Descent(scheduler, newton, x0[0], first, places.margins)
        self._renew(np.arange(1, count))

    def step(self) -> None:
        """Make one step of each attempt; those that gain no more give way to others."""
        search, row, descent = self._search, self._row, self._descent
        descent.step()
        self._steps += 1
        rho = search.offer(row, descent.plans[None])[0]
        if self._steps % EVERY == 0 and bool((search.open() == row).any()):
            best = descent.plans[rho.argsort(descending=True)[:BEST]]
            _improve(search, row, torch.cat((search.plans[row], best)), TRIES)
        self._renew(descent.over.nonzero()[0])

    def _renew(self, index: NDArray[np.int64]) -> None:
        """Begin the attempts `index` anew."""
        needed, search = self._drawn(len(index)), self._search
        index = index[: len(needed)]
        if not len(index):
            return
        missed = torch.from_numpy(needed).flatten(1).double() @ self._missed
        seen = torch.rand(missed.shape, generator=search.generator) < SEEN
        plans = self._library[torch.where(seen, missed, torch.inf).argmin(1)]
        afresh = torch.rand(len(plans), generator=search.generator) < AFRESH
        plans[afresh] = search.start[self._row]
        number = self._begun + np.arange(len(index))
        ordered = (number % ORDERED == 1) & (number > len(self._descent.over))
        self._begun += len(index)
        self._descent.renew(index, plans, needed, ordered)

    def _drawn(self, count: int) -> NDArray[np.bool_]:
        """Draw at most `count` schedules: where conditions are needed, (count, conditions, T + 1)."""
        if len(self._pool) < count:
            needed: NDArray[np.bool_] = self._scheduler.draw(DRAWS, self._random, self._holds)
            speed = tempo(needed[:, self._goals], self._apart)
            order = (GREED * np.log(speed + LEAST) - self._random.gumbel(size=len(speed))).argsort()
            self._pool = needed[order[: max(count, len(order) // KEPT)]]
        drawn, self._pool = self._pool[:count], self._pool[count:]
        return drawn


def _improve(search: PlanSearch, row: Tensor, plans: Tensor, tries: int) -> None:
    """Improve plans, (k, T, m), by local search, with at most `tries` changed plans for each."""
    plans = plans[: search.allowed(row, len(plans))]
    tries = max(1, search.affordable(row, tries * len(plans)) // len(plans))
    searcher = Searcher(search.task, search.generator, target=search.budget.target or TOLERANCE)
    x0 = search.states[row].expand(len(plans), -1).contiguous()
    found = searcher.repair(x0, plans, plans[:0], tries=tries, stop=search.budget.stop)
    search.offer(row, found.plans[None], evaluations=tries * len(plans))
