"""A time budget becomes a number of steps, once, in the first seconds; everything after counts steps."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from stlc.controller.trainer import Trainer

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch

    from stlc.controller.config import Engine
    from stlc.controller.task import Task

WARM_UP = 10
TIMED_STEPS = 60
LATER_LOOKS = 1.5
"""A late search round costs more than a first one: what still fails is hard, and takes the whole effort."""
RESERVE = 0.04
"""Share of the budget that is kept for the verdict on held-out states."""


def steps_within(task: Task, engine: Engine, seconds: float, device: torch.device) -> int:
    """How many steps fit into `seconds`, measured on a trainer that is thrown away.

    The real run starts afresh, so a run of the same seed and the same number of steps gives the same weights
    whether the steps were named or found here.
    """
    begun = time.perf_counter()
    trial = Trainer(task, engine, steps=10_000, device=device)
    built = time.perf_counter() - begun
    look = LATER_LOOKS * _time(trial.look, 2)  # first, so that the steps have hard states to work on
    for _ in range(WARM_UP):
        trial.advance()
    step = _time(trial.advance, TIMED_STEPS)
    left = seconds * (1.0 - RESERVE) - (time.perf_counter() - begun) - built
    return max(engine.every, int(left / (step + look / (1.5 * engine.every))))


def _time(call: Callable[[], object], times: int) -> float:
    """Mean seconds of a call."""
    begun = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - begun) / times
