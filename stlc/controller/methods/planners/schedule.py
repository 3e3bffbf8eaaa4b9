"""`schedule`: random schedules of the goals, and Gauss-Newton steps that change plans to meet them.

A local search fails where goals are reached in the wrong order. Here each attempt first draws a schedule: for
every part of the specification, the time at which it shall hold and the alternative of an `or` that shall
hold. Then the attempt changes a plan until the states meet these conditions. Only the attempts that come
nearest are continued. At the end, a local search improves the exact robustness of the best plans.
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
from stlc.controller.search.local_search import Searcher
from stlc.controller.search.newton import GaussNewton, Pull, state_gradient, values_of
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


@dataclass(frozen=True, slots=True)
class SchedulePlanner:
    """Planner that draws random schedules of the goals and changes plans by Gauss-Newton steps to meet them.

    A schedule fixes, for every part of the specification, the time at which the part is to hold, and the
    alternative of an `or` that is to hold. An attempt changes one plan until it meets one schedule. The
    search runs in rounds, each with many attempts.

    Attributes:
        draws: number of schedules that are drawn per round.
        schedules: number of drawn schedules that are selected; there is one attempt for each.
            Schedules that demand a low speed between goals are preferred.
        greed: strength of this preference; 0: the schedules are selected at random.
        steps: number of Gauss-Newton steps of an attempt.
        halvings: number of times that the worse half of the attempts is dropped, in equal intervals.
        library: number of random plans. An attempt begins with one of them that nearly meets its schedule.
        rows: maximum number of conditions that a Gauss-Newton step considers; the worst ones are taken.
        margin: distance from their boundaries at which conditions shall hold, as a share of the typical range
            of the states.
        best: number of plans that a local search improves at the end of a round.
        tries: number of changed plans that the local search at the end of a round tries per plan.
        starts: number of plans, the best of the library, that a local search improves before the first round.
        first: number of changed plans that the local search before the first round tries per plan.
    """

    schedules: int = bounded(48, 1, 10**6)
    draws: int = bounded(1_024, 1, 10**6)
    steps: int = bounded(12, 1, 10**6)
    halvings: int = bounded(2, 0, 64)
    library: int = bounded(512, 1, 10**6)
    rows: int = bounded(16, 1, 10**6)
    margin: float = 0.03
    greed: float = 10.0
    best: int = bounded(8, 1, 10**6)
    tries: int = bounded(500, 1, 10**9)
    starts: int = bounded(16, 1, 10**6)
    first: int = bounded(1_000, 1, 10**9)

    def prepare(self, task: Task) -> Solver:
        """Return a function that draws random schedules and searches for plans that meet them.

        A schedule fixes, for every part of the specification, the time at which the part is to hold, and the
        alternative of an `or` that is to hold.

        Raises:
            UsageError: U101, no part of the specification is a condition on the states of a single sample,
                as `x > 1` is. Then there is nothing to schedule.
        """
        return partial(self._run, rounds=ScheduleRounds(self, task))

    def _run(self, search: PlanSearch, rounds: ScheduleRounds) -> None:
        while len(rows := search.open()):
            for _ in rounds.of(search, rows[:1]):
                pass
            search.ended[rows[:1]] = True


class ScheduleRounds:
    """The rounds of a search by schedules, for plans of one task.

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
        self._pull = state_gradient(task.system)

    def of(self, search: PlanSearch, row: Tensor) -> Iterator[None]:
        """Search for a plan from the initial state `row`, (1,), until the search for it ends.

        An item is yielded after each round; none if all conditions are decided, so that none is left to meet.
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
            attempts = _Attempts(options, search, row, library, scheduler, self._pull, random)
        while bool((search.open() == row).any()):
            attempts.round(searcher)
            yield


class _Attempts:
    """Attempts to find plans from one initial state.

    Each attempt draws a random schedule and changes a plan until the plan meets the schedule.

    Args:
        options: the planner.
        search: the search for plans.
        row: index of the initial state, (1,).
        library: plans with which attempts begin, (k, T, m).
        scheduler: scheduler with the conditions of the specification.
        pull: the function that `state_gradient` returns, for derivatives of the states.
        random: source of the random schedules.
    """

    def __init__(
        self,
        options: SchedulePlanner,
        search: PlanSearch,
        row: Tensor,
        library: Tensor,
        scheduler: GoalScheduler,
        pull: Pull,
        random: Generator,
    ) -> None:
        self._options, self._search, self._row, self._library = options, search, row, library
        self._scheduler, self._random = scheduler, random
        conditions, self._x0 = self._scheduler.conditions, search.states[row]
        states = search.task.rollout(self._x0.expand(len(library), -1), library).nan_to_num(0.0, 0.0, 0.0)
        spread = states.flatten(0, 1).std(0)
        self._newton = GaussNewton(
            search.task, conditions, spread, pull, rows=options.rows, margin=options.margin
        )
        missed = values_of(search.task, conditions, states).neg().clamp(min=0.0).sqrt()
        self._missed = missed.flatten(0, 1)  # by each plan of the library: (conditions * (T + 1), k)
        places, violated = self._newton.nearest(self._x0[0])
        self._holds = ~violated.numpy()
        self._goals = violated.nonzero()[:, 0].numpy()
        places = torch.cat((self._x0, places[violated])) / self._newton.spread
        self._apart = torch.cdist(places, places).nan_to_num(0.0).numpy()

    def round(self, searcher: Searcher) -> None:
        """Draw schedules, and change one plan per schedule until the plan meets the schedule."""
        search, row, options = self._search, self._row, self._options
        with search.charged(row):
            needed = self._drawn()
            plans = self._nearest(needed)
        cuts = {options.steps * (i + 1) // (options.halvings + 1) for i in range(options.halvings)}
        for number in range(options.steps if len(needed) else 0):
            with search.charged(row):
                plans, missing = self._newton.step(self._x0.expand(len(plans), -1), plans, needed)
                if number in cuts:
                    kept = missing.argsort()[: -(-len(plans) // 2)]
                    plans, needed = plans[kept], needed[kept]
                order = search.offer(row, plans[None])[0].argsort(descending=True)
                plans, needed = plans[order], needed[order]
            if not bool((search.open() == row).any()):
                return
        with search.charged(row):
            best = torch.cat((search.plans[row], plans[: options.best]))
            _polish(search, row, best, searcher, options.tries)

    def _drawn(self) -> Tensor:
        """Draw k schedules: True where a condition is needed at a sample, (k, conditions, T + 1).

        Schedules that demand a low speed between goals are preferred.
        """
        options, random = self._options, self._random
        needed: NDArray[np.bool_] = self._scheduler.draw(options.draws, random, self._holds)
        speed = tempo(needed[:, self._goals], self._apart)
        order = (options.greed * np.log(speed + LEAST) - random.gumbel(size=len(speed))).argsort()
        return torch.from_numpy(needed[order[: options.schedules]])

    def _nearest(self, needed: Tensor) -> Tensor:
        """Select a plan for each of the k schedules `needed`, (k, T, m).

        It is the plan nearest to meeting the schedule, among some plans of the library drawn at random.
        """
        missed = needed.flatten(1).double() @ self._missed
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
