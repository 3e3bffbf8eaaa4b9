"""Time budget of a training run, and the number of steps that fits into it.

The duration of a step is known only from measurement, and the machine's load may change. Therefore the number
of steps is planned again whenever the measured pace would miss the budget. The learning rate depends only on
the step and on the number of steps planned at that moment. So the weights depend on the seed and on the
recorded `StepSchedule`, not on the clock.
"""

from __future__ import annotations

import heapq
import math
import os
import re
import time
from collections import deque
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from stlc.options import Clock

PROVISIONAL = 10_000
"""Planned number of steps before the first steps have been timed."""
FIRST = 10
"""Steps that are timed before the first planning."""
TOLERANCE = 0.015
"""Predicted miss of the budget that is tolerated without replanning, as a share of the budget."""
SLACK = 0.1
"""Predicted miss of the budget that is tolerated, as a share of the remaining time."""
PATIENCE, HASTE, SOON = 0.05, 0.01, 0.1
"""Shares of the budget: interval between plannings, the same in the final phase, length of this phase."""
WINDOW = 0.05
"""Time window for measuring the step duration, as a share of the budget; at least `FIRST` steps."""
ROUNDS = 3
"""Number of search rounds over which their duration is averaged."""
FIRST_SEARCH = 1.0
"""Expected duration of the first search, in intervals between search rounds."""


def processor() -> float:
    """Processor time in seconds, comparable with wall time on an idle machine.

    It is the larger of two times: the time of this thread, and the time of all threads divided by the number
    of cores. The time of child processes that have ended, such as compilers, is added to it.
    """
    from stlc.native import cores

    ended = os.times()
    mine = max(time.thread_time(), time.process_time() / cores())
    return mine + ended.children_user + ended.children_system


def clock_of(name: Clock) -> Callable[[], float]:
    """Return the function that reads the clock `name`, in seconds from an arbitrary origin."""
    return processor if name == "processor" else time.perf_counter


def verdict_reserve(seconds: float) -> float:
    """Part of a budget of `seconds` that is reserved for the evaluation on held-out states, in seconds."""
    return min(0.08 * seconds, 3.0 + 0.02 * seconds)


def simulation_reserve(seconds: float) -> float:
    """Part of a budget of `seconds` that is reserved for closed-loop simulations, in seconds."""
    return min(0.15 * seconds, 3.0 + 0.08 * seconds)


@dataclass(frozen=True, slots=True)
class TimeBudget:
    """Time budget of a training run.

    Attributes:
        now: function that reads the clock, in seconds.
        started: clock reading at the start; in a resumed run, less the time that the run took before.
        allowed: the user's budget in seconds; 0: unlimited.
        seconds: part of the budget that is available to the training.
    """

    now: Callable[[], float]
    started: float
    allowed: float
    seconds: float

    @classmethod
    def of(
        cls,
        now: Callable[[], float],
        started: float,
        allowed: float,
        late: Callable[[float], float] | None = None,
    ) -> TimeBudget:
        """Make the budget of a training run.

        Its attribute `seconds` is `allowed` less the time for other work, but at least half of `allowed`.

        Args:
            now: function that reads the clock, in seconds.
            started: clock reading at the start.
            allowed: the user's budget in seconds; 0: unlimited.
            late: function that receives `allowed`. It predicts by how many seconds the whole command would
                exceed this budget if the training used all of it; loading, for example, takes time too.
                None: the command takes no more time than the training.
        """
        over = late(allowed) if allowed and late is not None else 0.0
        return cls(now, started, allowed, min(allowed, max(allowed - over, 0.5 * allowed)))

    @property
    def spent(self) -> float:
        """Seconds since the start."""
        return self.now() - self.started


@dataclass(frozen=True, slots=True)
class Planned:
    """Entry of a schedule: from step `step` on, the run is planned to have `steps` steps in total."""

    step: int
    steps: int


@dataclass(frozen=True, slots=True)
class PlannedRound:
    """Entry of a schedule: a round of falsification after step `step` makes `simulations` simulations."""

    step: int
    simulations: int


_ROUND = "simulations="
_STEP = r"(0|[1-9]\d{0,17})"
_TEXT = re.compile(rf"[1-9]\d{{0,17}}(,({_ROUND}(0|[1-9]\d{{0,6}})|[1-9]\d{{0,17}})@{_STEP})*")


@dataclass(frozen=True, slots=True)
class StepSchedule:
    """Record of how many steps a run was planned to have, and of each change of this number.

    Together with the seed, the schedule determines the weights.

    Attributes:
        plannings: entries in order. The first is at step 0. If two entries are at the same step, the later
            one applies.
        rounds: rounds of falsification in order (`--falsify`), one for each moment at which a round was due;
            0 simulations if there was no time for one.
    """

    plannings: tuple[Planned, ...]
    rounds: tuple[PlannedRound, ...] = ()

    @classmethod
    def of(cls, steps: int) -> StepSchedule:
        """Schedule of a run with a fixed total of `steps` steps."""
        return cls((Planned(0, steps),))

    @classmethod
    def parse(cls, text: str) -> StepSchedule:
        """Parse the text of a schedule.

        `1200` is a fixed number of steps. With `10000,1240@10,900@455` the planned total is 10000 at first,
        1240 after step 10, and 900 after step 455. `simulations=6@400` is a round of falsification after step
        400, with 6 simulations, each of all agents of a world.

        Raises:
            ValueError: the text is not a schedule, its steps are not in order, or a total is less than the
                number of steps already made.
        """
        if not _TEXT.fullmatch(text):
            raise ValueError("it is neither a number of steps nor a schedule")
        first, *later = text.split(",")
        plannings, rounds = [Planned(0, int(first))], list[PlannedRound]()
        for part in later:
            count, step = map(int, part.removeprefix(_ROUND).split("@"))
            if part.startswith(_ROUND):
                rounds.append(PlannedRound(step, count))
            else:
                plannings.append(Planned(step, count))
        for before, after in pairwise(plannings):
            if after.step < before.step or after.step > before.steps:
                raise ValueError(f"step {after.step} is not between {before.step} and {before.steps}")
            if after.steps < after.step:
                raise ValueError(f"at step {after.step} there cannot be {after.steps} in all")
        steps = [0, *(each.step for each in rounds), plannings[-1].steps]
        if any(after < before for before, after in pairwise(steps)) or len({*steps[1:-1]}) < len(rounds):
            raise ValueError(f"its rounds are not at rising steps from 0 to {steps[-1]}")
        return cls(tuple(plannings), tuple(rounds))

    def __str__(self) -> str:
        first, *later = self.plannings
        plannings = ((each.step, f"{each.steps}@{each.step}") for each in later)
        rounds = ((each.step, f"{_ROUND}{each.simulations}@{each.step}") for each in self.rounds)
        merged = heapq.merge(plannings, rounds, key=lambda entry: entry[0])
        return ",".join((str(first.steps), *(text for _, text in merged)))

    def with_steps(self, step: int, steps: int) -> StepSchedule:
        """This schedule up to `step`, after which the total number of steps is `steps`.

        Later entries, of a schedule that is followed again, no longer apply.
        """
        plannings = tuple(each for each in self.plannings if each.step <= step)
        rounds = tuple(each for each in self.rounds if each.step <= step)
        return StepSchedule((*plannings, Planned(step, steps)), rounds)

    def with_round(self, step: int, simulations: int) -> StepSchedule:
        """This schedule with a further round of falsification after `step`."""
        return replace(self, rounds=(*self.rounds, PlannedRound(step, simulations)))

    @property
    def steps(self) -> int:
        """Total number of steps of the run according to the latest entry."""
        return self.plannings[-1].steps

    def at(self, step: int) -> int:
        """Total number of steps that was planned for the run when `step` steps had been made."""
        return [each.steps for each in self.plannings if each.step <= step][-1]


class Pace:
    """Measured durations in a run, and the number of steps that fit into its budget.

    A search round (validation) judges the policy's plans from new states, and starts a search for better
    plans. The search runs concurrently with the steps. The next round waits for the end of the search, and so
    does the end of training. The durations of searches and rounds are measured in units of one step, because
    all of these durations grow by the same factor when the machine becomes slower.
    """

    def __init__(self, *, every: int, searching: bool, now: float, seconds: float = 0.0) -> None:
        """Start measuring at `now`.

        Args:
            every: steps between search rounds.
            searching: whether searches run concurrently with the steps.
            now: reading of the clock used for all times, in seconds.
            seconds: the budget; 0 if there is none.
        """
        self._every = every
        self._searching = searching
        self._seconds = seconds
        self._started = now
        self._apart = 0.0
        self._since_validation = 0.0
        self._marks: deque[tuple[int, float]] = deque()
        self._rounds: deque[float] = deque(maxlen=ROUNDS)
        self._search = FIRST_SEARCH * every if searching else 0.0
        self._last_validation: int | None = None
        self._running = False
        self._left: float | None = None

    def stepped(self, step: int, now: float, *, search_runs: bool) -> None:
        """Record the end of gradient step `step` at time `now`.

        `search_runs`: whether the concurrent search is still running.
        """
        self._marks.append((step, now - self._started - self._apart))
        least = max(WINDOW * self._seconds, 1.0)
        while len(self._marks) > FIRST + 1 and self._marks[-1][1] - self._marks[1][1] >= least:
            self._marks.popleft()
        if not search_runs:
            self.searched(step, 0.0)

    def searched(self, step: int, waited: float) -> None:
        """Record that the search had ended by `step`, and that training waited `waited` seconds for it."""
        self._apart += waited
        if self._running and self._last_validation is not None and self.per_step > 0.0:
            self._search = step - self._last_validation + waited / self.per_step
        self._running = False

    def saved(self, seconds: float) -> None:
        """Record that writing a checkpoint took `seconds`."""
        self._apart += seconds
        self._since_validation += seconds

    def irregular(self, seconds: float) -> None:
        """Record that work which few steps need took `seconds`, such as a round of falsification."""
        self._apart += seconds

    def validated(self, step: int, seconds: float) -> None:
        """Record that a search round at `step` took `seconds`, and that its search, if any, runs now."""
        self.saved(seconds)
        if self.per_step > 0.0:
            self._rounds.append(self._since_validation / self.per_step)
        self._since_validation, self._last_validation, self._running = 0.0, step, self._searching

    @property
    def per_step(self) -> float:
        """Duration of the latest gradient steps in seconds per step; 0 before one was measured."""
        if len(self._marks) < 2:
            return 0.0
        (first, then), (last, now) = self._marks[0], self._marks[-1]
        return max(now - then, 0.0) / (last - first)

    def remaining(self, step: int, steps: int, next_validation: int) -> float:
        """Predicted seconds from `step` to the end of the run.

        Args:
            step: number of completed steps.
            steps: total number of steps of the run.
            next_validation: step of the next search round.
        """
        if steps < step:
            return 0.0
        rounds = max(0, -(-(steps - next_validation) // self._every))
        last = next_validation + (rounds - 1) * self._every
        round_ = sum(self._rounds) / max(1, len(self._rounds))
        # each round, and the end, waits for the search of the round before, if that still runs
        waits = max(0, rounds - 1) * max(0.0, self._search - self._every)
        if rounds and self._running and self._last_validation is not None:
            waits += max(0.0, self._search - (next_validation - self._last_validation))
        if rounds or self._running:
            waits += max(0.0, self._search - (steps - last))
        return self.per_step * (steps - step + round_ * rounds + waits)

    def plan(self, step: int, steps: int, next_validation: int, left: float) -> int:
        """Plan the total number of steps of the run, so that it ends when the remaining time is over.

        Args:
            step: number of completed steps.
            steps: total number of steps planned at present.
            next_validation: step of the next search round.
            left: remaining seconds.

        Returns:
            The total number of steps, at least 1 and at least `step`. It is `steps`, unchanged, if that
            number is predicted to fit, or if it is too early to plan again.
        """
        cost = self.per_step
        if left > 0.0 and (cost <= 0.0 or (steps > step and not self._due(left))):
            return steps
        missed = self.remaining(step, steps, next_validation) - left
        if self.planned and abs(missed) <= max(TOLERANCE * self._seconds, SLACK * left):
            return steps
        self._left = left
        low, high = step, step + math.ceil(left / cost) if left > 0.0 else step
        while low < high:
            middle = (low + high + 1) // 2
            if self.remaining(step, middle, next_validation) <= left:
                low = middle
            else:
                high = middle - 1
        over = self.remaining(step, low + 1, next_validation) - left
        under = left - self.remaining(step, low, next_validation)
        return max(low + 1 if 0.0 < over < under else low, 1)

    @property
    def planned(self) -> bool:
        """True once the number of steps has been planned from measured durations."""
        return self._left is not None

    def _due(self, left: float) -> bool:
        """True if enough steps were timed, or enough of the budget has passed since the last planning."""
        if self._left is None:
            first = self._marks[0][1]
            return len(self._marks) > FIRST or self._marks[-1][1] - first >= WINDOW * self._seconds
        return self._left - left >= (PATIENCE if left > SOON * self._seconds else HASTE) * self._seconds
