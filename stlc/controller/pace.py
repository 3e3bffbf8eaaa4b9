"""A time budget becomes a number of steps; the weights depend on the seed and on that number alone.

Where states are independent draws, the first seconds tell: they are timed on a trainer that is thrown away.
On missions they do not, because search rounds get dearer and cheaper with what is visited. There the learning
rate stays at its peak until most of the time is gone, so nothing that was done so far depends on how many
steps there will be, and the number is named when the rate begins to fall.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from stlc.controller.config import cores
from stlc.controller.ranks import ALONE, Ranks
from stlc.controller.trainer import Trainer

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch

    from stlc.controller.config import Clock, Engine
    from stlc.controller.task import Task

TIMED = 3
"""Intervals between search rounds that are timed; a round goes on beside the steps of the one after it."""
RESERVE = 0.04
"""Share of the budget that is kept for the verdict on held-out states."""


def processor() -> float:
    """Seconds that this would have taken on an idle machine.

    The training thread and the search beside it take their turns with the cores: whichever of the two has
    more to do is what is waited for.
    """
    return max(time.thread_time(), time.process_time() / cores())


def clock_of(name: Clock) -> Callable[[], float]:
    """The clock of that name, in seconds from any beginning."""
    return processor if name == "processor" else time.perf_counter


def steps_within(
    task: Task, engine: Engine, seconds: float, device: torch.device, ranks: Ranks = ALONE
) -> int:
    """How many steps fit into `seconds`, measured on a trainer that is thrown away.

    The real run starts afresh, so a run of the same seed and the same number of steps gives the same weights
    whether the steps were named or found here.
    """
    now = clock_of(engine.clock)
    begun = now()
    trial = Trainer(task, engine, steps=10_000, device=device, ranks=ranks)
    built = now() - begun
    trial.look()
    _interval(trial)  # what is slow once only
    cost = min(_interval(trial) for _ in range(TIMED - 1)) / engine.every
    left = seconds * (1.0 - RESERVE) - (now() - begun) - built
    return int(ranks.agree(max(engine.every, int(left / cost))))


def _interval(trainer: Trainer) -> float:
    """Seconds of the steps up to the next search round, and of the round as far as it is waited for."""
    now = clock_of(trainer.engine.clock)
    begun = now()
    for _ in range(trainer.engine.every):
        trainer.advance()
    trainer.look()
    return now() - begun


class OpenEnd:
    """How many steps a budget is worth, said again at every look until the schedule has to know.

    Attributes:
        settled: whether the number of steps is final.
    """

    def __init__(self, seconds: float, begun: float) -> None:
        """`seconds` from `begun`, by the clock of the engine."""
        self.settled = False
        self._end = begun + seconds * (1.0 - RESERVE)
        self._marks: list[tuple[int, float]] = []

    def mark(self, trainer: Trainer, now: float) -> None:
        """Take note of the time `now` and set the steps of `trainer`; to be called at every look.

        A step is taken to cost what the later half of them did. The rate falls over the last steps and must
        have been at its peak so far, so there are never fewer than that allows.
        """
        if self.settled:
            return
        self._marks.append((trainer.step, now))
        hold, soon = trainer.engine.hold, 2 * trainer.engine.every
        step, then = [mark for mark in self._marks if 2 * mark[0] <= trainer.step][-1]
        cost = (now - then) / max(trainer.step - step, 1)
        steps = trainer.step + int((self._end - now) / cost) if cost > 0 else trainer.steps
        self.settled = trainer.step > 0 and trainer.step + soon > hold * steps
        trainer.steps = max(steps, math.ceil((trainer.step if self.settled else trainer.step + soon) / hold))
