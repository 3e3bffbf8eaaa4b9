"""A time budget as a number of steps that is planned again while training goes on.

How long a step takes is known only while it is taken: the machine may be busy, become busy, or become free.
So the number of steps is re-planned whenever the measured pace says that the budget would be missed. The
learning rate is a function of the step and of the number of steps planned at that moment, and of nothing
else: the seed and the `StepSchedule`, which every run records, decide the weights, whatever the clock said.
"""

from __future__ import annotations

import math
import os
import re
import time
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Callable


Clock = Literal["wall", "processor"]
"""Quantity that a budget counts: time that passes, or processor time as on an idle machine."""

PROVISIONAL = 10_000
"""Steps that are planned until the first of them have been timed."""
FIRST = 10
"""Steps that are timed before the first planning."""
TOLERANCE = 0.015
"""Share of the budget by which a run may be foreseen to miss it before it is planned again."""
SLACK = 0.1
"""Share of the time that is left by which a run may be foreseen to miss its budget."""
PATIENCE, HASTE, SOON = 0.05, 0.01, 0.1
"""Shares of the budget between plannings, and between those of the last share of it (`SOON`)."""
WINDOW = 0.05
"""Share of the budget over which a step is timed, and at least so many steps as `FIRST`."""
ROUNDS = 3
"""Search rounds over which the time that is spent on them is averaged."""
FIRST_SEARCH = 1.0
"""Intervals between search rounds that the first search is expected to take."""


def cores() -> int:
    """Cores that this process may use: its share, where several of this machine train together."""
    found = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, found // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def processor() -> float:
    """Seconds that this would have taken on an idle machine.

    The training thread and the search beside it take their turns with the cores: whichever of the two has
    more to do is what is waited for. So is a compiler.
    """
    ended = os.times()
    mine = max(time.thread_time(), time.process_time() / cores())
    return mine + ended.children_user + ended.children_system


def clock_of(name: Clock) -> Callable[[], float]:
    """The clock of that name, in seconds from any beginning."""
    return processor if name == "processor" else time.perf_counter


def verdict_reserve(seconds: float) -> float:
    """Seconds of a budget that are kept for the verdict on held-out states."""
    return min(0.08 * seconds, 3.0 + 0.02 * seconds)


def simulation_reserve(seconds: float) -> float:
    """Seconds of a budget that are kept for closed-loop simulations."""
    return min(0.15 * seconds, 3.0 + 0.08 * seconds)


@dataclass(frozen=True, slots=True)
class TimeBudget:
    """Time of a training by its clock.

    Attributes:
        now: the clock, in seconds.
        begun: its reading at the beginning; earlier sessions of the run count.
        allowed: seconds that the user allows; 0: any number.
        seconds: of these, those that the training is planned with.
    """

    now: Callable[[], float]
    begun: float
    allowed: float
    seconds: float

    @classmethod
    def of(
        cls,
        now: Callable[[], float],
        begun: float,
        allowed: float,
        late: Callable[[float], float] | None = None,
    ) -> TimeBudget:
        """Leave room for the seconds, `late`, by which what surrounds the training exceeds its budget."""
        over = late(allowed) if allowed and late is not None else 0.0
        return cls(now, begun, allowed, min(allowed, max(allowed - over, 0.5 * allowed)))

    @property
    def spent(self) -> float:
        """Seconds since the beginning."""
        return self.now() - self.begun


@dataclass(frozen=True, slots=True)
class Planned:
    """A planning: from `step` on, the run is meant to have `steps` steps."""

    step: int
    steps: int


_TEXT = re.compile(r"[1-9]\d{0,17}(,[1-9]\d{0,17}@(0|[1-9]\d{0,17}))*")


@dataclass(frozen=True, slots=True)
class StepSchedule:
    """The plannings of a run, in their order; with the seed it decides the weights.

    Attributes:
        plannings: the first is of step 0; of two of the same step the later one counts.
    """

    plannings: tuple[Planned, ...]

    @classmethod
    def of(cls, steps: int) -> StepSchedule:
        """So many steps, known from the start."""
        return cls((Planned(0, steps),))

    @classmethod
    def parse(cls, text: str) -> StepSchedule:
        """`1200`, or `10000,1240@10,900@455`: 10000 steps, from step 10 on 1240, from step 455 on 900.

        Raises:
            ValueError: it is no schedule, or its steps do not rise.
        """
        if not _TEXT.fullmatch(text):
            raise ValueError("it is neither a number of steps nor a schedule")
        first, *later = text.split(",")
        pairs = (part.split("@") for part in later)
        plannings = (Planned(0, int(first)), *(Planned(int(step), int(steps)) for steps, step in pairs))
        for before, after in pairwise(plannings):
            if after.step < before.step or after.step > before.steps:
                raise ValueError(f"step {after.step} is not between {before.step} and {before.steps}")
            if after.steps < after.step:
                raise ValueError(f"at step {after.step} there cannot be {after.steps} in all")
        return cls(plannings)

    def __str__(self) -> str:
        first, *later = self.plannings
        return ",".join((str(first.steps), *(f"{each.steps}@{each.step}" for each in later)))

    def with_steps(self, step: int, steps: int) -> StepSchedule:
        """The schedule with a planning more."""
        return StepSchedule((*self.plannings, Planned(step, steps)))

    @property
    def steps(self) -> int:
        """Steps of the whole run."""
        return self.plannings[-1].steps

    def at(self, step: int) -> int:
        """Steps that are planned for the run when `step` of them have been done."""
        return [each.steps for each in self.plannings if each.step <= step][-1]


class Pace:
    """Pace of a run, and the number of steps that a budget allows at that pace.

    A search goes on beside the steps; the round after it, or a checkpoint, waits for its end. How long it
    takes is counted in steps, and so is what a round itself costs: a machine that becomes twice as slow is
    expected to be so in everything.
    """

    def __init__(self, *, every: int, searching: bool, now: float, seconds: float = 0.0) -> None:
        """A run that begins `now`.

        Args:
            every: steps between search rounds.
            searching: whether a search goes on beside the steps.
            now: seconds, by the clock that all later times are given by.
            seconds: of the budget; 0 where there is none.
        """
        self._every = every
        self._searching = searching
        self._seconds = seconds
        self._begun = now
        self._apart = 0.0
        self._since_look = 0.0
        self._marks: deque[tuple[int, float]] = deque()
        self._rounds: deque[float] = deque(maxlen=ROUNDS)
        self._search = FIRST_SEARCH * every if searching else 0.0
        self._last_look: int | None = None
        self._running = False
        self._left: float | None = None

    def stepped(self, step: int, now: float, *, search_runs: bool) -> None:
        """A gradient step has ended: the `step`-th, at `now`; whether the search still goes on beside."""
        self._marks.append((step, now - self._begun - self._apart))
        least = max(WINDOW * self._seconds, 1.0)
        while len(self._marks) > FIRST + 1 and self._marks[-1][1] - self._marks[1][1] >= least:
            self._marks.popleft()
        if not search_runs:
            self.searched(step, 0.0)

    def searched(self, step: int, waited: float) -> None:
        """The search beside the steps has ended, at `step`, after so many seconds of waiting for it."""
        self._apart += waited
        if self._running and self._last_look is not None and self.per_step > 0.0:
            self._search = step - self._last_look + waited / self.per_step
        self._running = False

    def saved(self, seconds: float) -> None:
        """A checkpoint was written."""
        self._apart += seconds
        self._since_look += seconds

    def looked(self, step: int, seconds: float) -> None:
        """A search round was made at `step`, and the search that it asks for has begun."""
        self.saved(seconds)
        if self.per_step > 0.0:
            self._rounds.append(self._since_look / self.per_step)
        self._since_look, self._last_look, self._running = 0.0, step, self._searching

    @property
    def per_step(self) -> float:
        """Seconds of a gradient step of late; 0 while none has been timed."""
        if len(self._marks) < 2:
            return 0.0
        (first, then), (last, now) = self._marks[0], self._marks[-1]
        return max(now - then, 0.0) / (last - first)

    def remaining(self, step: int, steps: int, next_look: int) -> float:
        """Seconds until a run of `steps` steps ends that has done `step`, its next search round given."""
        if steps < step:
            return 0.0
        looks = max(0, -(-(steps - next_look) // self._every))
        last = next_look + (looks - 1) * self._every
        round_ = sum(self._rounds) / max(1, len(self._rounds))
        # each round waits for the search of the one before, if that is still going on; the end does so too
        waits = max(0, looks - 1) * max(0.0, self._search - self._every)
        if looks and self._running and self._last_look is not None:
            waits += max(0.0, self._search - (next_look - self._last_look))
        if looks or self._running:
            waits += max(0.0, self._search - (steps - last))
        return self.per_step * (steps - step + round_ * looks + waits)

    def plan(self, step: int, steps: int, next_look: int, left: float) -> int:
        """Steps that the run should have, `left` seconds before it must end; `steps` where that is well.

        Never fewer than those that are done, and one at least.
        """
        cost = self.per_step
        if left > 0.0 and (cost <= 0.0 or (steps > step and not self._due(left))):
            return steps
        missed = self.remaining(step, steps, next_look) - left
        if self.planned and abs(missed) <= max(TOLERANCE * self._seconds, SLACK * left):
            return steps
        self._left = left
        low, high = step, step + math.ceil(left / cost) if left > 0.0 else step
        while low < high:
            middle = (low + high + 1) // 2
            if self.remaining(step, middle, next_look) <= left:
                low = middle
            else:
                high = middle - 1
        over = self.remaining(step, low + 1, next_look) - left
        under = left - self.remaining(step, low, next_look)
        return max(low + 1 if 0.0 < over < under else low, 1)

    @property
    def planned(self) -> bool:
        """True once a number of steps was planned for a budget."""
        return self._left is not None

    def _due(self, left: float) -> bool:
        """True once enough has been timed since the last planning to plan anew."""
        if self._left is None:
            first = self._marks[0][1]
            return len(self._marks) > FIRST or self._marks[-1][1] - first >= WINDOW * self._seconds
        return self._left - left >= (PATIENCE if left > SOON * self._seconds else HASTE) * self._seconds
