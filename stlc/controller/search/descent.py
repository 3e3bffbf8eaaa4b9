"""Descents of plans towards schedules: Gauss-Newton steps, and what each plan approaches at a step.

At first a plan approaches the schedule that it was given. The better half of the plans go on: their choices,
such as the sample at which an `eventually` holds, are made anew after each step, as those that the states
meet or are nearest to.

Some plans meet their conditions in the order of time: at first those up to a sample shortly after the first
violation, then those up to a later one. A pole that has to swing up and stay there is first brought up, then
held.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stlc.controller.search.newton import LENGTHS, GaussNewton, barrier_weight

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from stlc.controller.search.schedules import GoalScheduler

    Flags = NDArray[np.bool_]
    Instants = NDArray[np.int64]

LEVELS = np.array([1.0, 0.1, 0.01])
"""Shares of the margins of the conditions, from one to the next where that much is not possible."""
DAMPING, LEAST, MOST = 1e-4, 1e-9, 1e4
"""The first, the least and the greatest damping."""
CAUTIOUS = 1e-2
"""The first damping of a plan that approaches all of its new schedule at once."""
EASED, RAISED, LONG = 0.3, 10.0, 0.3
"""Factors of the damping after a step of more than the length `LONG`, and after one that improved nothing."""
GAIN = 0.95
"""Share of the cost that a step must leave at most; else it counts as stalled."""
PATIENCE = 4
"""Successive stalled steps after which something else is approached, or the descent is over."""
GIVEN = 6
"""Number of steps in which a plan approaches the schedule that it was given."""
AHEAD = 8
"""Samples after the first violation whose conditions are first considered, in the order of time."""


class Descent:
    """Descent of B plans from one initial state.

    Attributes:
        over: mask of the plans whose descent gains no more, (B,).
    """

    def __init__(
        self,
        scheduler: GoalScheduler,
        newton: GaussNewton,
        x0: Tensor,
        plans: Tensor,
        margins: NDArray[np.float64],
    ) -> None:
        """Begin with plans that approach the schedules that they are nearest to.

        Args:
            scheduler: scheduler with the conditions of the specification.
            newton: Gauss-Newton steps towards these conditions.
            x0: the initial state, (n,).
            plans: the plans, (B, T, m).
            margins: distances that conditions should keep from their boundaries, (conditions,).
        """
        self._scheduler, self._newton, self._x0, self._margins = scheduler, newton, x0, margins
        count, self._last = plans.shape[:2]
        self._now = newton.begin(x0, plans)
        self._needed = scheduler.nearest(self._now.distance)
        self._given, self._stalled, self._level = np.zeros((3, count), np.int64)
        self._damping = np.full(count, DAMPING)
        self._end, self._ahead = np.full(count, self._last), np.full(count, AHEAD)
        self.over = np.zeros(count, np.bool_)

    @property
    def plans(self) -> Tensor:
        """The plans, (B, T, m)."""
        return self._newton.plans(self._now.shares)

    def renew(self, index: Instants, plans: Tensor, needed: Flags, ordered: Flags) -> None:
        """Begin anew with other plans.

        Args:
            index: indices of the plans that are replaced, (k,).
            plans: the new plans, (k, T, m).
            needed: conditions of their schedules, (k, conditions, T + 1).
            ordered: True for the plans that meet them in the order of time, (k,).
        """
        self._now.put(index, self._newton.begin(self._x0, plans))
        self._needed[index], self._given[index], self._stalled[index] = needed, GIVEN, 0
        self._level[index] = np.arange(len(index)) // 2 % 2
        self._damping[index] = np.where(ordered, DAMPING, CAUTIOUS)
        self._end[index], self._ahead[index] = np.where(ordered, -1, self._last), AHEAD
        self.over[index] = False

    @np.errstate(over="ignore", invalid="ignore")  # an unstable plant may leave all bounds
    def step(self) -> None:
        """Make one step with each plan, where it gains."""
        first = self._extend()
        within = (np.arange(self._last + 1) <= self._end[:, None])[:, None]
        wanted, many, margin = self._needed & within, len(LENGTHS), self._margin
        tried = self._newton.step(self._now, wanted, margin, self._damping)
        needed = self._needed.repeat(many, 0)
        free = (self._given <= 0).repeat(many)
        if free.any():
            needed[free] = self._scheduler.nearest(tried.distance[free])
        before = self._now.cost(wanted, margin)
        weight = barrier_weight(before, self._now.shares)
        cost = tried.cost(needed & within.repeat(many, 0), margin.repeat(many, 0)).reshape(-1, many)
        whole = cost + (weight.repeat(many) * tried.barrier()).reshape(-1, many)
        best, each = np.nan_to_num(whole, nan=np.inf).argmin(1), np.arange(len(whole))
        better = whole[each, best] < before + weight * self._now.barrier()
        index, source = better.nonzero()[0], (each * many + best)[better]
        if len(index):
            self._now.put(index, self._newton.linearised(tried.shares[source], tried.states[source]))
        self._needed[index] = needed[source]
        factor = np.where(better, np.where(LENGTHS[best] > LONG, EASED, 1.0), RAISED)
        self._damping = (factor * self._damping).clip(LEAST, MOST)
        gained = better & (cost[each, best] < GAIN * before)
        self._stalled, self._given = np.where(gained, 0, self._stalled + 1), self._given - 1
        self._give_way(first)

    @property
    def _margin(self) -> NDArray[np.float64]:
        """Margin of each condition for each plan, (B, conditions)."""
        return LEVELS[self._level][:, None] * self._margins

    def _extend(self) -> Instants:
        """Consider more samples where all conditions up to the last one considered hold.

        Returns the first sample at which each plan violates a condition, T if there is none, (B,).
        """
        lost = np.any(self._needed & ~(self._now.distance >= 0.0), axis=1)
        first: Instants = np.where(lost.any(1), lost.argmax(1), self._last)
        done = (first > self._end) & (self._end < self._last)
        self._ahead = np.where(done & (self._end >= 0), self._ahead + self._ahead // 2, self._ahead)
        self._end = np.where(done, np.minimum(first + self._ahead, self._last), self._end)
        self._damping = np.where(done, np.maximum(self._damping, DAMPING), self._damping)
        self._stalled[done] = 0
        return first

    def _give_way(self, first: Instants) -> None:
        """Let plans that stall consider fewer samples, other choices or smaller margins; or end them."""
        stalled, whole = self._stalled >= PATIENCE, self._end == self._last
        sooner = stalled & ~whole & (self._ahead > 1)
        self._ahead = np.where(sooner, self._ahead // 2, self._ahead)
        self._end = np.where(sooner, np.minimum(self._end, first + self._ahead), self._end)
        other = stalled & ~sooner & (self._given > 0)
        self._given[other] = 0
        least = np.where(self._needed, self._now.distance / self._margins[:, None], np.inf).min((1, 2))
        closer = stalled & ~sooner & ~other & (self._level < len(LEVELS) - 1)
        closer &= least > -2.0 * LEVELS[self._level]
        self._level[closer] += 1
        again = sooner | other | closer
        self._damping[again], self._stalled[again] = DAMPING, 0
        cost = self._now.cost(self._needed, self._margin)
        self.over = (stalled & ~again) | ((self._given == 0) & ~other & whole & (cost > np.median(cost)))
